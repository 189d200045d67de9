"""What the Train page says of a dataset that nobody has labelled yet."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from tests.app.conftest import settle
from tests.backend.annotations.conftest import context_for, small_episode
from touchdown.app.train.reading import ModelInUse, TrainingReader
from touchdown.app.train.text import (
    autonomy_text,
    figure_rows,
    model_in_use_text,
    promotion_question,
    run_row,
)
from touchdown.backend.annotations import Dataset, Label
from touchdown.backend.bench.assembly import model_in_use
from touchdown.backend.learning.registry import HARDWARE_PROBES, SHIPPED_MODEL, ModelRegistry
from touchdown.widgets.base.theme import Theme, load_resources
from touchdown.widgets.forms.training_form import TrainingForm
from touchdown.widgets.lists.tables import FigureTable, TrainingRow


def test_labels_that_would_count_are_named_with_the_way_to_them(tmp_path):
    reading = TrainingReader(ModelRegistry(tmp_path / "models"))
    form = replace(TrainingForm(), data=str(tmp_path / "data"), labels="approved")

    def told(labels="approved"):
        return reading.look(replace(form, labels=labels), refresh=True).trouble

    with Dataset.open(tmp_path / "data", person="ann") as dataset:
        assert told() == (
            "No label counts yet. Accept labels in Label (Ctrl+2); somebody else approves them "
            "there."
        )
        context = context_for(dataset)
        uuids = [
            dataset.record(
                small_episode(), Label(k, 0, 0, 9), source="measured", context=context
            ).uuid
            for k in range(3)
        ]
        assert told().startswith(
            "No label counts yet. Labels 'All, with drafts' would give 3 episodes. Accept"
        )
        assert told("drafts") == ""
        dataset.labels.accept("ann", uuids[0])
        assert "Labels 'Approved and submitted' would give 1 episode." in told()
        dataset.labels.approve("bob", uuids[0])
        assert told() == ""


@pytest.mark.parametrize("began_ns", [60_000_000_000, 1_795_700_000_000_000_000])
def test_two_trainings_of_one_minute_have_different_names(began_ns):
    def name(started_ns):
        about = SimpleNamespace(params={}, started_ns=started_ns)
        run = SimpleNamespace(about=about, best_epoch=0, card=None, curves={}, uuid="", piece="pot",
                              state="finished", value=lambda *_: float("nan"))  # fmt: skip
        return run_row(run, None, {}).cells[0]

    assert name(began_ns) != name(began_ns + 1_000_000_000)


def test_a_promoted_model_can_be_rolled_back_without_data(tmp_path):
    registry = ModelRegistry(tmp_path / "models")
    reading, form = TrainingReader(registry), replace(TrainingForm(), data=str(tmp_path / "none"))
    assert reading.look(form, refresh=True).in_use is None
    registry.promote(model_in_use("pot", None))
    looked = reading.look(form, refresh=True)
    assert looked.trouble
    assert looked.in_use is not None
    assert (looked.in_use.piece, looked.in_use.before) == ("pot", SHIPPED_MODEL)


def trained(piece, **bottoms):
    figures = {name: {"iou": iou, "point_accuracy": 0.9} for name, iou in bottoms.items()}
    whole = {"iou": sum(bottoms.values()) / len(bottoms), "point_accuracy": 0.9}
    card = SimpleNamespace(metrics={"validation": {**whole, "bottoms": figures}})
    return SimpleNamespace(card=card, piece=piece, about=SimpleNamespace(params={"piece": piece}))


def test_trainings_of_one_piece_are_compared_bottom_by_bottom():
    rows = figure_rows([trained("pot", short=0.5, long=0.7), trained("pot", short=0.6)])
    assert rows == [
        ("long", "70.0 / 90.0", "\N{EN DASH}"),
        ("short", "50.0 / 90.0", "60.0 / 90.0"),
        ("all", "60.0 / 90.0", "60.0 / 90.0"),
    ]


def test_trainings_of_two_pieces_name_them():
    rows = figure_rows([trained("pot", short=0.5), trained("barrel", short=0.6)])
    assert [row[0] for row in rows] == ["barrel, all", "barrel, short", "pot, all", "pot, short"]
    assert rows[3] == ("pot, short", "50.0 / 90.0", "\N{EN DASH}")


@pytest.mark.parametrize(
    ("iou", "held_out", "asked"),
    [(0.25, 6, "It is worse."), (0.8, 6, "few probes"), (0.8, 1200, ""), (0.7, 1200, "worse")],
)
def test_a_model_that_is_worse_or_hardly_tested_is_questioned_with_its_figures(
    iou, held_out, asked
):
    def card(iou, held_out):
        metrics = {"validation": {"iou": iou}}
        return SimpleNamespace(piece="pot", metrics=metrics, data={"held_out": held_out})

    said = promotion_question(card(iou, held_out), card(0.75, 1200))
    assert bool(said) == bool(asked)
    assert asked in said
    if asked:
        assert f"{100 * iou:.0f} % on {held_out:,} probes" in said
        assert "75 % on 1,200 probes" in said


@pytest.mark.parametrize("probes", [None, 0, HARDWARE_PROBES - 1, HARDWARE_PROBES])
def test_a_model_of_simulations_says_what_it_lacks(probes):
    said = autonomy_text(probes)
    assert (said == "") == (probes is None)
    if probes is not None:
        assert ("approve or step mode only" in said) == (probes < HARDWARE_PROBES)
        assert str(probes) in said


@pytest.mark.promise("W9")
def test_rows_of_a_table_follow_the_text_down_as_well_as_up(qapp, qtbot):
    load_resources()
    theme, heights = Theme(), []
    table = FigureTable(theme, "Figures", ("bottom", "IoU"))
    qtbot.addWidget(table)
    table.show_rows([("short", "0.5")])
    for scale in (0.8, 2.0, 0.8):
        theme.scale = scale
        table.fit_to_theme()
        heights.append(table.rowHeight(0))
    assert heights[0] == heights[2] < heights[1]


def test_the_table_of_trainings_fits_a_window_of_1280_px(live):
    live.window.resize(1280, 720)
    live.go("train")
    settle(live)
    table = live.workspaces["train"].page.runs
    table.show_runs([TrainingRow("a", ("B 19:51:30 barrel", "finished", "FT+Tac", "40.1"))])
    settle(live)
    assert table.isVisible()
    assert table.horizontalScrollBar().maximum() == 0


@pytest.mark.parametrize("before", [None, SHIPPED_MODEL])
def test_the_model_in_use_is_named_with_its_iou_where_probes_were_held_out(before):
    def said(held_out):
        card = SimpleNamespace(metrics={"validation": {"iou": 0.75}}, data={"held_out": held_out})
        return model_in_use_text(ModelInUse("pot", "", before, 0, card=card))

    assert ", IoU 75 %" in said(1200)
    assert "IoU" not in said(0)
    assert "IoU" not in model_in_use_text(ModelInUse("pot", "", before, 0))

"""What the Train page says of a dataset that nobody has labelled yet."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
from PySide6.QtCore import QPoint
from PySide6.QtGui import QFontMetrics
from PySide6.QtWidgets import QApplication

from tests.app.conftest import settle
from tests.backend.annotations.conftest import context_for, small_episode
from tests.widgets.views.test_belief import is_colour, pixels
from touchdown.app.train.reading import ModelInUse, TrainingReader
from touchdown.app.train.text import (
    autonomy_text,
    figure_rows,
    model_in_use_text,
    next_step,
    promotion_question,
    run_row,
)
from touchdown.backend.annotations import Dataset, Label
from touchdown.backend.bench.assembly import model_in_use
from touchdown.backend.config import StabilitySettings
from touchdown.backend.learning.registry import HARDWARE_PROBES, SHIPPED_MODEL, ModelRegistry
from touchdown.widgets.base.theme import Theme, load_resources, ui_font
from touchdown.widgets.forms.training_form import TrainingButtons, TrainingForm
from touchdown.widgets.lists.tables import FigureTable, TrainingRow


def test_labels_that_would_count_are_named_with_the_way_to_them(tmp_path):
    reading = TrainingReader(ModelRegistry(tmp_path / "models"))
    form = replace(TrainingForm(), data=str(tmp_path / "data"), labels="approved")

    def told(labels="approved"):
        return reading.look(replace(form, labels=labels), refresh=True).trouble

    with Dataset.open(tmp_path / "data", person="ann") as dataset:
        assert told() == (
            "No approved label yet. Accept some in Label (Ctrl+2); another person approves them."
        )
        context = context_for(dataset)
        uuids = [
            dataset.record(
                small_episode(), Label(k, 0, 0, 9), source="measured", context=context
            ).uuid
            for k in range(3)
        ]
        assert told().endswith("To train alone, choose Labels 'All, with drafts': 3 episodes.")
        assert told("drafts") == ""
        dataset.labels.accept("ann", uuids[0])
        assert told().endswith("choose Labels 'Approved and submitted': 1 episode.")
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


def card(iou, held_out=1200, probes=2000, **fields):
    """A card of a network as large as that of the shipped models."""
    data = {"held_out": held_out, "episodes": {"short": probes}, "mountings": probes // 50}
    usual = {"piece": "pot", "weights_sha256": "x", "modality": "FT+Tac",
             "hyper": SimpleNamespace(layers=2, hidden=256)}  # fmt: skip
    metrics = {"validation": {"iou": iou}}
    return SimpleNamespace(**usual | fields, metrics=metrics, data=data)


FLAT = (0.6, 0.4, 0.4, 0.41)


def a_run(card, held_out=FLAT, train=FLAT):
    sides = {"train_loss": train, "validation_loss": held_out}
    curves = {name: list(enumerate(losses, 1)) for name, losses in sides.items()}
    return SimpleNamespace(card=card, curves=curves)


def test_trainings_are_compared_with_the_model_in_use_as_by_promote():
    def step(*cards, used):
        use = ModelInUse("pot", "used", None, 0, card=used)
        return next_step([a_run(one) for one in cards], use)

    used = card(0.75)
    assert step(card(0.8), used=used).text == "Not below the model in use: Promote puts it in use."
    several = step(card(0.8), card(0.4), card(0.8, 6), used=used)
    assert several.text.startswith("Not below the model in use: A, C. Choose one")
    assert several.button == ""
    assert step(card(0.4), used=used).text.startswith("Below the model in use. Next: ")
    other = card(0.4, piece="mug"), card(0.75, weights_sha256="used")
    assert step(None, *other, used=used) is None
    assert step(card(0.4), used=card(0.75, 0)) is step(card(0.4), used=None) is None
    assert next_step([a_run(card(0.4))], None) is None


SMALL = SimpleNamespace(layers=2, hidden=12)


IN_USE = {"modality": "FT+Tac", "layers": 2, "hidden": 256}


@pytest.mark.parametrize(
    ("worse", "curves", "said", "changes"),
    [
        ({}, {"held_out": (0.7, 0.65, 0.6, 0.56)},
         "train 8 epochs, as the held-out loss of {} still falls.", {"epochs": 8}),
        ({}, {"held_out": (0.7, 0.5, 0.5, 0.44)}, "keep that, as {}", {}),
        ({"probes": 100}, {"train": (0.6, 0.4, 0.3, 0.2)},
         "collect more mountings, as {} fits its 100 probes of 2 mountings (loss 0.20) better than "
         "held-out ones (0.41). In use: 2,000 probes of 40 mountings.", {}),
        ({"probes": 100}, {},
         "collect more mountings, as {} has 100 probes of 2 mountings, that 2,000 probes of 40 "
         "mountings.", {}),
        ({"modality": "FT"}, {}, "train like it, with 'Touch + wrench' and 2 layers", IN_USE),
        ({"hyper": SMALL}, {}, "train like it, with 'Touch + wrench' and 2 layers", IN_USE),
        ({}, {}, "keep that, as {} has as many probes", {}),
    ],
)  # fmt: skip
def test_the_next_step_follows_from_losses_data_and_network(worse, curves, said, changes):
    use = ModelInUse("pot", "used", None, 0, card=card(0.75))
    best, less = a_run(card(0.6, **worse), **curves), a_run(card(0.5, **worse))
    for runs, mark in (([best], "this training"), ([less, best], "B")):
        step = next_step(runs, use)
        assert step.text.startswith(f"Below the model in use. Next: {said.format(mark)}")
        assert step.changes == changes
        assert step.run is (best if changes else None)
        told = "Train as advised" if changes else "Go to Collect"
        assert step.button == ("" if "keep" in said else told)
    if changes == IN_USE:
        # Another of them has tried it.
        assert next_step([a_run(card(0.5)), best], use).changes == {}
    assert next_step([best, a_run(card(0.8))], use).button == ""


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


def test_a_row_with_a_cross_has_the_colour_of_an_error_in_every_theme(qapp, qtbot):
    load_resources()
    theme = Theme()
    table = FigureTable(theme, "Figures", ("quantity", "value"))
    qtbot.addWidget(table)
    table.resize(300, 200)
    table.show_rows([("\N{MULTIPLICATION X} noise", "888"), ("drift", "888")])
    for name in ("dark", "light"):
        theme.tokens = Theme(name).tokens
        red = is_colour(pixels(table.viewport()), theme.tokens.colour("bad")).any(axis=1)
        rows = [table.rowViewportPosition(row) for row in range(2)]
        assert red[rows[0] : rows[1]].any()
        assert not red[rows[1] :].any()


def test_the_panels_of_a_page_without_labels_begin_at_one_height(live):
    live.window.resize(1280, 720)
    live.go("train")
    settle(live)
    page = live.workspaces["train"].page
    for words in range(1, 40):
        page.form.show_buttons(
            TrainingButtons(start=False, cancel=False, resume=False, why_not="label " * words)
        )
        QApplication.processEvents()
        tops = {one.mapToGlobal(QPoint()).y() for one in (page.form, page.curves_panel)}
        assert len(tops) == 1, words


def test_the_table_of_trainings_fits_a_window_of_1280_px(live):
    live.window.resize(1280, 720)
    live.go("train")
    settle(live)
    table = live.workspaces["train"].page.runs
    table.show_runs([TrainingRow("a", ("B 19:51:30 barrel", "finished", "Touch + wrench", "40.1"))])
    settle(live)
    assert table.isVisible()
    assert table.horizontalScrollBar().maximum() == 0


def test_support_and_reliability_are_named_in_words_that_fit_1280_px(live):
    live.window.resize(1280, 720)
    live.go("train")
    settle(live)
    page = live.workspaces["train"].page
    detail, plot = page.form.detail, page.reliability
    assert detail.text() == f"Support above {100 * StabilitySettings().delta:.0f} %"
    assert "probability of contact" in detail.toolTip()
    assert detail.width() >= detail.sizeHint().width()
    assert plot.accessibleName() == "True over predicted contact"
    assert "Share of points in contact over the predicted probability" in plot.toolTip()
    width = QFontMetrics(ui_font(live.theme.scale, 0.85, 500)).horizontalAdvance(plot.name)
    assert width < plot.width() - 2.6 * plot.fontMetrics().height()


@pytest.mark.parametrize("before", [None, SHIPPED_MODEL])
def test_the_model_in_use_is_named_with_its_iou_where_probes_were_held_out(before):
    def said(held_out):
        card = SimpleNamespace(metrics={"validation": {"iou": 0.75}}, data={"held_out": held_out})
        return model_in_use_text(ModelInUse("pot", "", before, 0, card=card))

    assert ", IoU 75 %" in said(1200)
    assert "IoU" not in said(0)
    assert "IoU" not in model_in_use_text(ModelInUse("pot", "", before, 0))

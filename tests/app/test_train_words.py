"""What the Train page says of trainings side by side, and of a model's right to decide alone."""

from types import SimpleNamespace

import pytest

from touchdown.app.train.text import autonomy_text, figure_rows
from touchdown.backend.learning.registry import HARDWARE_PROBES
from touchdown.widgets.base.theme import Theme, load_resources
from touchdown.widgets.lists.tables import FigureTable


def trained(piece, **bottoms):
    figures = {name: {"iou": iou, "point_accuracy": 0.9} for name, iou in bottoms.items()}
    whole = {"iou": sum(bottoms.values()) / len(bottoms), "point_accuracy": 0.9}
    card = SimpleNamespace(metrics={"validation": {**whole, "bottoms": figures}})
    return SimpleNamespace(card=card, about=SimpleNamespace(params={"piece": piece}))


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

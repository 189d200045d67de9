"""What the Train page says of trainings side by side, and of a model's right to decide alone."""

from types import SimpleNamespace

import pytest

from app.train.words import alone_words, figure_rows
from backend.learning.alone import HARDWARE_PROBES


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
    said = alone_words(probes)
    assert (said == "") == (probes is None)
    if probes is not None:
        assert ("approve or step mode only" in said) == (probes < HARDWARE_PROBES)
        assert str(probes) in said

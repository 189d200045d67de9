"""The picture of displacement sizes: peaks where they are, nothing where markers are lost."""

from itertools import combinations

import numpy as np
import pytest

from tests.app.stand_in import REST, StandInBench
from touchdown.backend.core.values import MarkerField, MarkerState
from touchdown.widgets.base.theme import Theme, colour_table
from touchdown.widgets.views.tactile import (
    FULL_PX,
    LOOKS,
    TactileView,
    magnitude_picture,
    magnitude_px,
)


def field(shift, lost=()):
    state = np.zeros(63, dtype=np.uint8)
    state[list(lost)] = MarkerState.LOST
    return MarkerField("left", 1, 0.0, REST + shift, shift, state, 1.0)


def test_the_peak_is_at_the_marker_that_moved():
    shift = np.zeros((63, 2))
    shift[31] = (FULL_PX, 0.0)
    picture = magnitude_picture(field(shift), "grey")[:, :, 0]
    v, u = np.unravel_index(int(picture.argmax()), picture.shape)
    assert (u, v) == pytest.approx(tuple(REST[31]), abs=1.0)
    assert picture.max() >= 250
    assert picture[0, 0] == 0


def test_halfway_between_two_markers_is_their_mean():
    shift = np.zeros((63, 2))
    shift[30] = shift[31] = (0.0, 6.0)
    picture = magnitude_picture(field(shift), "grey")[:, :, 0]
    u, v = np.rint((REST[30] + REST[31]) / 2).astype(int)
    assert picture[v, u] == pytest.approx(255 * 6.0 / FULL_PX, abs=2)


def test_a_lost_marker_makes_no_peak_and_all_lost_is_level():
    shift = np.full((63, 2), (3.0, 0.0))
    shift[10] = (90.0, 0.0)
    assert magnitude_px(field(shift, lost=[10])) == pytest.approx(np.full((7, 9), 3.0))
    assert magnitude_px(field(shift, lost=range(63))).max() == 0.0


def test_colours_are_those_of_the_map_in_the_order_of_the_camera():
    full = np.full((63, 2), (FULL_PX, 0.0))
    picture = magnitude_picture(field(full), "cividis")
    assert picture.shape == (240, 320, 3)
    assert tuple(picture[120, 160][::-1]) == tuple(colour_table("cividis")[255])


def test_every_look_draws_something_else(qtbot):
    bench = StandInBench()
    bench.press = 1.0
    bench.turn(0.04)
    view = TactileView(Theme(), "left")
    qtbot.addWidget(view)
    view.resize(320, 240)
    view.show_frame(bench.frames["left"].newest(), bench.fields["left"].newest())
    view.show_age(view._age.FRESH, 0.0, "")
    pictures = []
    for look, _ in LOOKS:
        view.show_look(look)
        pictures.append(view.grab().toImage())
    assert not any(one == other for one, other in combinations(pictures, 2))

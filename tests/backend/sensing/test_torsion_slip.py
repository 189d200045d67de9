"""Torsion slip is a simultaneous rotation of both gels, and nothing else (reliability G1)."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.streams import Stream
from touchdown.backend.core.values import FINGERS, MARKERS, MarkerField, MarkerState
from touchdown.backend.sensing.slip import TorsionSlipDetector
from touchdown.backend.simulation.finger_camera import load_gel_appearance

REST_PX = load_gel_appearance().rest_px
PERIOD_S = 0.04


class Gels:
    """Two fingers whose markers rotate about their centre by given angles, and shift."""

    def __init__(self):
        self.fields = {finger: Stream[MarkerField](finger, 256) for finger in FINGERS}
        self.watch = TorsionSlipDetector(self.fields)
        self._count = 0

    def show(self, left_rad, right_rad, lost=0):
        """Process one frame of each finger; return True if a rotation was detected."""
        for finger, angle in zip(FINGERS, (left_rad, right_rad), strict=True):
            t_s = PERIOD_S * self._count + (0.02 if finger == "right" else 0.0)
            turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
            middle = REST_PX.mean(axis=0)
            moved = (REST_PX - middle) @ turn.T + middle - REST_PX + [0.1, -0.4 * self._count]
            state = np.full(MARKERS, MarkerState.SEEN, np.uint8)
            moved[:lost], state[:lost] = 50.0, MarkerState.LOST
            field = MarkerField(finger, self._count, t_s, REST_PX + moved, moved, state, 1.0)
            self.fields[finger].put(t_s, field)
        self._count += 1
        return self.watch.update()


@pytest.fixture
def gels():
    made = Gels()
    for _ in range(5):
        assert not made.show(0.0, 0.0)
    return made


@pytest.mark.promise("G1")
@pytest.mark.parametrize("angle", [-0.05, -0.0055, 0.0055, 0.05])
def test_a_piece_that_turns_is_seen_in_the_next_picture(gels, angle):
    assert gels.show(angle, -angle)
    assert gels.watch.turned_rad == pytest.approx(abs(angle), rel=1e-6)


def test_one_that_turns_over_some_pictures_is_seen_as_well(gels):
    assert any(gels.show(0.0027 * k, 0.0027 * k) for k in range(1, 5))


@pytest.mark.promise("G1")
def test_a_press_that_turns_the_gels_slowly_is_none(gels):
    assert not any(gels.show(0.0009 * k, 0.0009 * k) for k in range(40))


def test_one_gel_alone_is_no_piece(gels):
    assert not any(gels.show(0.02 * (k % 2), 0.0) for k in range(20))


def test_gels_that_jump_one_after_the_other_are_no_piece(gels):
    seen = [gels.show(0.02, 0.0) for _ in range(10)] + [gels.show(0.02, 0.02) for _ in range(10)]
    assert not any(seen)


def test_markers_that_are_lost_turn_nothing(gels):
    assert not any(gels.show(0.0, 0.0, lost=9 * (k % 3)) for k in range(20))
    assert gels.show(0.01, 0.01, lost=9)
    assert gels.watch.turned_rad == pytest.approx(0.01, rel=0.05)

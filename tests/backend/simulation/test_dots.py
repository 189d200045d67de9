"""The dot mask against its definition: moved as a whole, cut at the border, largest on overlap."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.values import MARKERS
from touchdown.backend.simulation.finger_camera import DotRenderer, load_gel_appearance

STILL = np.zeros((MARKERS, 2))


@pytest.fixture
def dots():
    return DotRenderer(load_gel_appearance(), np.random.default_rng(4))


def drawn(dots, displacement):
    dots.draw(np.asarray(displacement, dtype=np.float64))
    return dots.mask.copy()


@pytest.mark.parametrize(("du", "dv"), [(30, 0), (-41, 0), (0, 25), (-7, -33)])
def test_a_shift_moves_the_mask_and_cuts_it_at_the_border(dots, du, dv):
    still = drawn(dots, STILL)
    moved = drawn(dots, STILL + np.array([du, dv]))
    here = np.s_[max(dv, 0) : 240 + min(dv, 0), max(du, 0) : 320 + min(du, 0)]
    there = np.s_[max(-dv, 0) : 240 + min(-dv, 0), max(-du, 0) : 320 + min(-du, 0)]
    assert still[there].max() > 0.9
    assert moved[here] == pytest.approx(still[there], abs=1e-4)


def test_where_two_dots_meet_the_larger_counts(dots):
    """Two dots at one position: no darker than the darker of both."""
    gone = STILL + 1e4
    rest = load_gel_appearance().rest_px
    single = []
    for marker in (30, 31):
        alone = gone.copy()
        alone[marker] = rest[31] - rest[marker]
        single.append(dots_alone(dots, alone))
    both = gone.copy()
    both[30], both[31] = rest[31] - rest[30], 0.0
    together = dots_alone(dots, both)
    assert together == pytest.approx(np.maximum(*single), abs=1e-6)
    assert single[0].max() > 0.8
    assert np.abs(single[0] - single[1]).max() > 0.05


def dots_alone(dots, displacement):
    """Draw round dots: the neighbours that are out of sight must not stretch them."""
    dots._slopes = np.zeros_like(dots._slopes)
    return drawn(dots, displacement)


def test_nothing_is_left_of_the_frame_before(dots):
    first = drawn(dots, STILL)
    assert drawn(dots, STILL + 1e4).max() == 0.0
    assert np.array_equal(drawn(dots, STILL), first)


def test_dots_that_hardly_moved_look_as_they_did_and_creep_adds_up():
    exact, still = (
        DotRenderer(load_gel_appearance(), np.random.default_rng(4), still_px)
        for still_px in (0.0, 0.01)
    )
    first = drawn(still, STILL)
    assert (first == drawn(exact, STILL)).all()
    for creep_px in (0.004, 0.008):
        assert (drawn(still, STILL + creep_px) == first).all()
    assert (drawn(still, STILL + 0.012) == drawn(exact, STILL + 0.012)).all()

"""The jaws: closing times, squeezing, release, and halting."""

from __future__ import annotations

import pytest

from touchdown.backend.simulation.gripper import (
    CLOSING_TIME_S,
    SQUEEZE_TIME_S,
    JawEvents,
    SimulatedJaws,
)

STEP_S = 0.01


def run(jaws, seconds):
    changes = [jaws.step(STEP_S) for _ in range(round(seconds / STEP_S))]
    return [change for change in changes if change != JawEvents()]


def test_closing_takes_the_piece_once_with_the_force_asked_for():
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.close(10.0)
    assert run(jaws, CLOSING_TIME_S - 0.02) == []
    assert jaws.force_n == 0.0
    assert run(jaws, SQUEEZE_TIME_S + 0.05) == [JawEvents(taken=True)]
    assert (jaws.width_mm, jaws.force_n, jaws.holding) == (30.0, 10.0, True)
    assert not jaws.moving


def test_a_firmer_grip_of_a_held_piece_does_not_take_it_again():
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.close(10.0)
    run(jaws, 1.0)
    jaws.close(14.0)
    assert run(jaws, 1.0) == []
    assert jaws.force_n == 14.0


def test_without_a_piece_the_jaws_close_on_nothing():
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.piece_present = False
    jaws.close(10.0)
    assert run(jaws, 2.0) == []
    assert (jaws.width_mm, jaws.force_n, jaws.holding, jaws.moving) == (0.0, 0.0, False, False)


def test_opening_lets_go_just_beyond_the_width_of_the_piece():
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.close(10.0)
    run(jaws, 1.0)
    jaws.open_to(34.0, 5.0)
    steps = 0
    while jaws.step(STEP_S) == JawEvents():
        assert jaws.holding
        steps += 1
    assert jaws.width_mm == pytest.approx(30.1, abs=0.06)
    assert not jaws.holding
    run(jaws, 2.0)
    assert jaws.width_mm == 34.0
    assert not jaws.moving


@pytest.mark.parametrize("halt_after_s", [0.0, 0.2, CLOSING_TIME_S + 0.5 * SQUEEZE_TIME_S])
def test_a_halted_grip_can_be_taken_up_again(halt_after_s):
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.close(10.0)
    run(jaws, halt_after_s)
    jaws.halt()
    width = jaws.width_mm
    assert run(jaws, 1.0) == []
    assert jaws.width_mm == width
    assert not jaws.holding
    jaws.close(10.0)
    assert run(jaws, 1.0) == [JawEvents(taken=True)]
    assert jaws.holding


def test_a_halted_release_keeps_what_is_still_held():
    jaws = SimulatedJaws(50.0, 30.0)
    jaws.close(10.0)
    run(jaws, 1.0)
    jaws.open_to(34.0, 5.0)
    jaws.step(STEP_S)
    jaws.halt()
    assert run(jaws, 1.0) == []
    assert jaws.holding

"""Motion in air until a contact, from samples of known steps; ends of moves."""

import numpy as np
import pytest

from touchdown.backend.core import FaultError
from touchdown.backend.devices.protocols import CommandedMotion
from touchdown.backend.devices.streamed.arm import AirTare
from touchdown.backend.devices.streamed.motion_programs import CycleInput, TravelProgram

STEP_N = np.array([0.1, -0.2, 0.3])


def descended(until_s, block=7):
    """Air of one second at 1 kHz, then blocks on the way down; the sensor steps at 1.2 s."""
    t_s = np.arange(0.0, until_s, 1e-3)
    force_n = 5.0 + np.where(t_s[:, None] >= 1.2, STEP_N, 0.0)
    zero = AirTare(t_s[:1000], force_n[:1000])
    for first in range(1000, len(t_s), block):
        zero.feed(t_s[first : first + block], force_n[first : first + block])
    return zero


def test_the_air_before_the_onset_counts_and_not_the_contact():
    assert descended(2.0).moved_n(1.8) == pytest.approx(STEP_N)
    # From 1.05 to 1.25 s: a quarter of the window is after the step.
    assert descended(2.0).moved_n(1.3) == pytest.approx(0.25 * STEP_N, abs=0.01)
    assert descended(1.3).start_n == pytest.approx(np.full(3, 5.0))


def test_a_contact_soon_after_the_start_has_the_air_before_it():
    assert descended(1.1).moved_n(1.05) == pytest.approx(np.zeros(3))


def test_with_too_few_samples_nothing_is_said():
    silent = AirTare(np.array([0.0, 0.001]), np.ones((2, 3)))
    silent.feed(np.empty(0), np.empty((0, 3)))
    assert silent.moved_n(5.0) == pytest.approx(np.zeros(3))
    # What is older than a second is forgotten; its air is not told of a later onset.
    assert descended(3.5).moved_n(2.0) == pytest.approx(np.zeros(3))


@pytest.mark.promise("R16")
@pytest.mark.parametrize(("away_mm", "code"), [(0.01, ""), (0.3, ""), (3.0, "ARM-STALLED")])
def test_a_move_whose_arm_stands_elsewhere_has_failed(away_mm: float, code: str) -> None:
    motion, end_mm = CommandedMotion({}), np.array([0.0, 0.0, 60.0])
    program, none = TravelProgram(motion, end_mm, 20.0), np.empty(0)
    command_mm = end_mm - [0.0, 0.0, 3.0]
    measured_mm = end_mm - [0.0, 0.0, away_mm]
    for k in range(200):
        felt = CycleInput(k * 3.5e-3, 3.5e-3, command_mm, measured_mm, none, np.empty((0, 3)))
        command_mm = program.next_mm(felt)
    assert motion.done
    if code:
        with pytest.raises(FaultError) as raised:
            motion.result()
        assert raised.value.fault.code == code
    else:
        motion.result()

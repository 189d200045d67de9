"""Compliant presses on an emulated arm against springs: onset, force, swing, trip, unloading."""

import threading
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.emulated_arm import Rig
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.devices.protocols import PressCommand
from touchdown.backend.devices.streamed.arm import ContactStiffnessEstimate
from touchdown.backend.devices.streamed.compliance import OscillationDetector, damping

TOUCH_MM = 59.0
PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 3.0, (30.0, 30.0, 15.0))


def ready(stiffness_n_mm, noise_n=0.1):
    rig = Rig()
    rig.noise_n = noise_n
    rig.contact = lambda pivot: np.array([0, 0, stiffness_n_mm * max(TOUCH_MM - pivot[2], 0.0)])
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.7)
    return rig


def finish(rig, motion, limit_s=6.0):
    for _ in range(round(limit_s / 0.0035)):
        if motion.done:
            return
        rig.wires.advance(3500)
    raise AssertionError("the motion does not end")


@pytest.mark.parametrize("stiffness_n_mm", [3.0, 8.0])
def test_a_press_counts_from_first_touch_and_holds_the_force_of_springs_in_series(stiffness_n_mm):
    rig = ready(stiffness_n_mm)
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    motion.result()
    press = rig.arm.poses.window(0.0, rig.wires.clock.now_s())
    touched_mm = float(np.interp(motion.onset_s, press.t_s, press.values[:, 2]))
    assert touched_mm == pytest.approx(TOUCH_MM, abs=0.1)
    steady_n = 1.5 * 15.0 * stiffness_n_mm / (15.0 + stiffness_n_mm)
    force_n = stiffness_n_mm * (TOUCH_MM - rig.true_mm[2])
    assert force_n == pytest.approx(steady_n, abs=0.15)
    assert rig.wrench.since(0).values[:, 2].max() < steady_n * 1.08 + 0.5
    unload = rig.arm.unload(1.0, 2.0)
    finish(rig, unload)
    unload.result()
    rig.rest(0.2)
    assert 0.3 <= stiffness_n_mm * (TOUCH_MM - rig.true_mm[2]) <= 2.0


def test_what_the_sensor_drifts_on_the_way_down_is_no_force_of_the_contact():
    rig = ready(8.0)
    spring = rig.contact
    drift_n = np.array([0.0, 0.0, 0.7])
    rig.contact = lambda pivot: spring(pivot) + (drift_n if pivot[2] < TOUCH_MM + 0.9 else 0.0)
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    motion.result()
    steady_n = 1.5 * 15.0 * 8.0 / (15.0 + 8.0)
    assert 8.0 * (TOUCH_MM - rig.true_mm[2]) == pytest.approx(steady_n, abs=0.1)
    # What is told of the force counts as the tare of a run does, which is from before the descent.
    assert rig.arm._orders.level.press_n() == pytest.approx(steady_n + 0.7, abs=0.3)


@pytest.mark.promise("G5", "G6")
def test_a_contact_that_is_too_stiff_is_found_and_calmed():
    """Ten times the stiffness that the damping is made for."""
    rig = ready(300.0)
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code == "CONTACT-SWINGS"
    found_s = rig.wires.clock.now_s() - motion.onset_s
    assert found_s <= 12.0 * rig.arm._orders.level.loop.delay_s
    assert rig.wrench.since(0).values[:, 2].max() < 40.0
    rig.rest(1.0)
    felt = rig.wrench.window(rig.wires.clock.now_s() - 0.3, rig.wires.clock.now_s()).values[:, 2]
    assert np.ptp(felt) < 2.0


@pytest.mark.promise("G3")
def test_a_force_over_the_trip_draws_the_arm_back():
    rig = ready(8.0)
    motion = rig.arm.press(PRESS)
    rig.rest(1.2)
    assert motion.onset_s is not None
    height = rig.true_mm[2]
    rig.contact = lambda pivot: np.array([0.0, 0.0, 45.0 if pivot[2] < height + 1.0 else 0.0])
    finish(rig, motion)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code == "FT-TRIP"
    rig.rest(1.0)
    assert rig.true_mm[2] > height + 1.0


@pytest.mark.parametrize("stiffness_n_mm", [25.0, 60.0])
def test_the_stiffness_of_the_contact_is_found_and_damped_for(stiffness_n_mm):
    rig = ready(stiffness_n_mm)
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    motion.result()
    press = rig.arm._orders.level._press
    assert press.stiffness.found_n_mm == pytest.approx(stiffness_n_mm, rel=0.15)
    designed = 100.0 if stiffness_n_mm > 30.0 else 30.0
    wanted = damping(rig.arm._orders.level.loop.delay_s, designed)
    assert press.compliance.law.damping == pytest.approx(wanted)
    steady_n = 1.5 * 15.0 * stiffness_n_mm / (15.0 + stiffness_n_mm)
    assert stiffness_n_mm * (TOUCH_MM - rig.true_mm[2]) == pytest.approx(steady_n, abs=0.25)


def slope_of(stiffness_n_mm):
    """A contact seen as it is commanded: the force answers 20 ms later."""
    seen = ContactStiffnessEstimate(0.020)
    for k in range(600):
        t_s = 0.0035 * k
        seen.feed(t_s, -0.001 * k, max(0.0, stiffness_n_mm * 0.001 * (t_s - 0.020) / 0.0035))
    return seen.found_n_mm


def test_the_slope_is_that_of_the_spring():
    assert slope_of(200.0) == pytest.approx(200.0, rel=1e-3)
    assert slope_of(9.0) == pytest.approx(9.0, rel=1e-3)
    assert slope_of(8.0) is None


@pytest.mark.promise("G6")
@pytest.mark.parametrize("stiff_n_mm", [150.0, 200.0])
def test_a_contact_without_a_gel_is_drawn_back_from(stiff_n_mm):
    rig = ready(stiff_n_mm)
    motion = rig.arm.press(PRESS)
    finish(rig, motion)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code == "CONTACT-STIFF"
    assert rig.wrench.since(0).values[:, 2].max() < 40.0
    height_mm = rig.true_mm[2]
    rig.rest(1.0)
    assert rig.true_mm[2] > height_mm + 1.0


def test_no_wrench_no_press():
    rig = ready(8.0)
    rig.wrench.clear()
    with pytest.raises(FaultError) as raised:
        rig.arm.press(PRESS)
    assert raised.value.fault.code == "FT-STALE"
    with pytest.raises(FaultError) as raised:
        rig.arm.unload(1.0, 2.0)
    assert raised.value.fault.code == "NOT-PRESSING"


@pytest.mark.parametrize("speed_mm_s", [13.0, 0.0])
def test_an_approach_that_could_trip_is_refused(speed_mm_s):
    rig = ready(8.0)
    with pytest.raises(RefusedError) as raised:
        rig.arm.press(replace(PRESS, approach_mm_s=speed_mm_s))
    assert raised.value.reason == "APPROACH-SPEED"
    before = rig.true_mm[2]
    rig.rest(0.1)
    assert rig.true_mm[2] == pytest.approx(before, abs=1e-3)


@pytest.mark.promise("P1")
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, 1e308])
def test_a_press_with_a_senseless_number_cannot_be_made(bad):
    for name in ("depth_mm", "ramp_s", "hold_s", "approach_mm_s", "threshold_n", "max_travel_mm"):
        with pytest.raises(ValueError, match=name):
            replace(PRESS, **{name: bad})
    with pytest.raises(ValueError, match="stiffness_n_mm"):
        replace(PRESS, stiffness_n_mm=(30.0, bad, 15.0))


@pytest.mark.promise("S7")
def test_the_arm_stands_while_the_wrench_is_no_number():
    rig = ready(8.0)
    motion = rig.arm.press(PRESS)
    rig.rest(1.2)
    assert motion.onset_s is not None
    rig.contact = lambda pivot: np.full(3, np.nan)
    rig.rest(0.15)
    give = rig.arm.describe()["z_mm"] - rig.arm._orders.level._press.compliance.reference_mm[2]
    rig.rest(0.1)
    after = rig.arm.describe()["z_mm"] - rig.arm._orders.level._press.compliance.reference_mm[2]
    assert after == pytest.approx(give, abs=1e-9)


def swing(amplitude_n, period_s, delay_s=0.0237, lasts_s=1.0):
    detector = OscillationDetector(delay_s)
    times = np.arange(0.0, lasts_s, 0.0035)
    return [t for t in times if detector.feed(t, amplitude_n * np.sin(2 * np.pi * t / period_s))]


@pytest.mark.promise("G5")
def test_the_detector_knows_a_swing_from_a_press():
    assert swing(1.0, 0.142)[0] < 0.4
    assert swing(0.45, 0.142) == []
    assert swing(1.0, 0.5) == []
    detector = OscillationDetector(0.0237)
    ramp = np.linspace(0.0, 20.0, 300)
    noise = np.random.default_rng(1).normal(0.0, 0.1, 300)
    assert not any(detector.feed(0.0035 * k, f) for k, f in enumerate(ramp + noise))


def ended_by(motion):
    with pytest.raises(FaultError) as raised:
        motion.result()
    return raised.value.fault.code


@pytest.mark.promise("S6")
def test_a_wrist_that_falls_silent_on_the_way_down_ends_the_descent():
    rig = ready(8.0)
    motion = rig.arm.press(PRESS)
    rig.rest(0.2)
    rig.wires.also = rig.wires.clock.advance
    silent_s, here_mm = rig.wires.clock.now_s(), rig.true_mm[2]
    finish(rig, motion)
    assert ended_by(motion) == "FT-STALE"
    assert rig.wires.clock.now_s() - silent_s <= 0.105
    rig.rest(0.3)
    assert here_mm - rig.true_mm[2] == pytest.approx(0.2, abs=0.05)


@pytest.mark.promise("S4")
def test_in_contact_the_arm_stands_without_a_wrench_and_then_draws_back():
    rig = ready(8.0)
    motion = rig.arm.press(PRESS)
    rig.rest(1.2)
    assert motion.onset_s is not None
    rig.wires.also = rig.wires.clock.advance
    silent_s = rig.wires.clock.now_s()
    finish(rig, motion)
    assert ended_by(motion) == "FT-STALE"
    assert rig.wires.clock.now_s() - silent_s <= 0.105
    rig.rest(0.05)
    stood_mm = rig.true_mm[2]
    rig.rest(0.1)
    assert rig.true_mm[2] == pytest.approx(stood_mm, abs=0.01)
    rig.rest(0.6)
    assert rig.true_mm[2] == pytest.approx(stood_mm + 2.0, abs=0.05)

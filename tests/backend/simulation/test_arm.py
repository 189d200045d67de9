"""Arm programs against closed forms: profile, press law, unloading."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.simulation.arm import (
    ArmCycle,
    ArmDrive,
    PressLaw,
    SimPress,
    SimTravel,
    SimUnload,
    travelled_mm,
)

LAW = PressLaw(1.5, 1.5, 2.0, 2.0, 1.0, 11.0)
CYCLE_S = 0.01


def cycle(k, force_n=None):
    """Cycle k; ``force_n(t)`` gives the samples of the cycle before, None for a silent sensor."""
    start = k * CYCLE_S
    t_s = start - CYCLE_S + 0.001 * np.arange(1, 11)
    if force_n is None:
        return ArmCycle(start, start + CYCLE_S, np.empty(0), np.empty(0))
    return ArmCycle(start, start + CYCLE_S, t_s, force_n(t_s))


@pytest.mark.parametrize(("length", "speed"), [(10.0, 20.0), (0.3, 20.0), (3.0, 50.0), (0.0, 5.0)])
def test_profile_is_smooth_monotone_and_ends_at_the_target(length, speed):
    total = length / speed + speed / 500.0 + 1.0
    t = np.linspace(0.0, total, 4001)
    way = np.array([travelled_mm(float(x), length, speed, 500.0) for x in t])
    assert way[-1] == length
    assert np.all(np.diff(way) >= -1e-12)
    velocity = np.gradient(way, t)
    assert velocity.max() <= speed * (1.0 + 1e-6)
    assert np.abs(np.gradient(velocity, t)).max() <= 500.0 * 1.01


def test_travel_takes_the_time_of_a_trapezoid():
    start, target = np.array([1.0, 2.0, 3.0]), np.array([4.0, 6.0, 3.0])
    drive, travel = ArmDrive(start), SimTravel(start, target, 20.0)
    drive.run(travel)
    k, seen = 0, []
    while not travel.done:
        seen.append(drive.step(cycle(k), stalled=False))
        k += 1
    assert k == int(np.ceil((5.0 / 20.0 + 20.0 / 500.0) / CYCLE_S - 1e-9))
    assert drive.command_mm.tolist() == target.tolist()
    line = np.array(seen) - start
    assert line == pytest.approx(np.outer(line[:, 0] / 3.0, [3.0, 4.0, 0.0]))


def test_a_stalled_arm_stands_still_and_goes_on_afterwards():
    drive = ArmDrive(np.zeros(3))
    travel = SimTravel(np.zeros(3), np.array([0.0, 0.0, 5.0]), 20.0)
    drive.run(travel)
    for k in range(10):
        drive.step(cycle(k), stalled=False)
    before = drive.command_mm
    for k in range(10, 30):
        drive.step(cycle(k), stalled=True)
    assert drive.command_mm.tolist() == before.tolist()
    for k in range(30, 60):
        drive.step(cycle(k), stalled=False)
    assert travel.done
    assert drive.command_mm[2] == 5.0


def pressed(stiffness_n_mm, start_mm=3.0, noise=0.0, offset=14.7):
    """Press onto a spring whose surface is z = 0; returns the program, times and heights."""
    rng = np.random.default_rng(1)
    air_s = np.arange(-450, 1) * 1e-3
    air = air_s, offset + noise * rng.standard_normal(len(air_s))
    drive, press = ArmDrive(np.array([0.0, 0.0, start_mm])), SimPress(LAW, start_mm, 0.0, air)
    drive.run(press)
    ends, heights = [0.0], [start_mm]

    def force(t_s):
        z = np.interp(t_s, ends, heights)
        pushed = stiffness_n_mm * np.maximum(-z, 0.0)
        return offset + pushed + noise * rng.standard_normal(len(t_s))

    k = 0
    while not press.done and k < 2000:
        drive.step(cycle(k, force), stalled=False)
        ends.append((k + 1) * CYCLE_S)
        heights.append(float(drive.command_mm[2]))
        k += 1
    return press, np.array(ends), np.array(heights)


@pytest.mark.parametrize("stiffness", [3.0, 5.2, 12.0, 30.0])
def test_onset_is_back_dated_to_the_touch(stiffness):
    press, _, _ = pressed(stiffness, noise=0.1)
    assert press.onset_s == pytest.approx(1.5, abs=0.05)
    assert press.detected_s - press.onset_s == pytest.approx(1.0 / (2.0 * stiffness), abs=0.04)


@pytest.mark.parametrize("start_mm", [0.1, 0.3, 0.7])
@pytest.mark.parametrize("stiffness", [5.2, 12.0])
def test_a_contact_soon_after_the_start_is_told_from_the_air_before_it(stiffness, start_mm):
    press, _, z_mm = pressed(stiffness, start_mm, noise=0.1)
    touched_s = start_mm / 2.0
    assert press.onset_s == pytest.approx(touched_s, abs=0.05)
    assert press.detected_s - touched_s == pytest.approx(1.0 / (2.0 * stiffness), abs=0.05)
    assert z_mm[-1] == pytest.approx(-1.5, abs=0.1)


def test_command_follows_the_law_and_never_rises():
    press, t_s, z_mm = pressed(5.2)
    assert np.all(np.diff(z_mm) <= 1e-12)
    down = t_s < 1.5
    assert z_mm[down] == pytest.approx(3.0 - 2.0 * t_s[down])
    zero = 3.0 - 2.0 * press.onset_s
    acted = np.ceil((press.detected_s + 1e-9) / CYCLE_S) * CYCLE_S
    after = t_s > acted + 0.3
    ramp = zero - 1.5 * np.minimum(1.0, (t_s - press.onset_s) / 1.5)
    assert z_mm[after] == pytest.approx(ramp[after])
    assert z_mm[-1] == pytest.approx(zero - 1.5)
    assert t_s[-1] == pytest.approx(press.onset_s + 2.0, abs=0.0101)


def test_what_the_descent_overshot_is_kept():
    press, t_s, z_mm = pressed(3.0)
    zero = 3.0 - 2.0 * press.onset_s
    overshoot = zero - 2.0 * (np.ceil(press.detected_s / CYCLE_S) * CYCLE_S - press.onset_s)
    waiting = (t_s > press.detected_s + 0.03) & (t_s < press.onset_s + (zero - overshoot) - 0.02)
    assert waiting.any()
    assert np.ptp(z_mm[waiting]) == 0.0


@pytest.mark.parametrize("force", [None, lambda t: np.full(len(t), np.nan)])
def test_without_a_sensor_the_press_ends_after_its_travel(force):
    drive, press = (
        ArmDrive(np.array([0.0, 0.0, 40.0])),
        SimPress(LAW, 40.0, 0.0, (np.empty(0), np.empty(0))),
    )
    drive.run(press)
    for k in range(700):
        drive.step(cycle(k, force), stalled=False)
    assert press.done
    assert press.failure is not None
    assert press.failure.code == "NO-CONTACT"
    assert 40.0 - drive.command_mm[2] <= 11.0


def test_unload_stops_at_the_force_and_waits_while_nothing_is_heard():
    drive = ArmDrive(np.array([0.0, 0.0, -1.5]))
    unload = SimUnload(1.0, 14.7, 2.0, -1.5)
    drive.run(unload)
    for k in range(20):
        drive.step(cycle(k), stalled=False)
    assert drive.command_mm[2] == -1.5
    k = 20
    while not unload.done:
        z = float(drive.command_mm[2])
        drive.step(
            cycle(k, lambda t, z=z: np.full(len(t), 14.7 + 5.2 * max(-z, 0.0))), stalled=False
        )
        k += 1
    assert unload.failure is None
    assert 5.2 * -drive.command_mm[2] == pytest.approx(1.0, abs=0.11)


def test_unload_gives_up_when_the_force_does_not_fall():
    drive = ArmDrive(np.zeros(3))
    unload = SimUnload(1.0, 0.0, 2.0, 0.0)
    drive.run(unload)
    for k in range(600):
        drive.step(cycle(k, lambda t: np.full(len(t), 20.0)), stalled=False)
    assert unload.failure is not None
    assert unload.failure.code == "NOT-UNLOADED"


def test_drop_stands_still():
    drive = ArmDrive(np.zeros(3))
    drive.run(SimTravel(np.zeros(3), np.array([0.0, 0.0, 50.0]), 20.0))
    drive.step(cycle(0), stalled=False)
    drive.drop()
    before = drive.command_mm
    drive.step(cycle(1), stalled=False)
    assert not drive.moving
    assert drive.command_mm.tolist() == before.tolist()

"""The part of the contract that every arm is held to: moves, presses, jogs, stops."""

from __future__ import annotations

import sys
import threading
import time
import tomllib
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from tests.backend.devices.contract_bench import EVERY, DevicesUnderTest
from tests.backend.devices.contract_bench import PRESS as CONTRACT_BENCH_PRESS
from tests.backend.devices.waiting import until
from tests.backend.rig.ticking import TickingRig
from touchdown.backend.bench.emulator_registry import bench_toml, emulate
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.core.faults import FaultError, InputError, RefusedError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices import registry
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock, Limits
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S
from touchdown.backend.devices.protocols import (
    STILL,
    ArmStatus,
    DeviceState,
    Identity,
    PressCommand,
    RetreatingArm,
    RobotMode,
    SafetyMode,
)
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.emulation.fault_plan import Faults, add_noise, apply_faults
from touchdown.backend.emulation.server import PtyServer, TcpServer
from touchdown.backend.emulation.serving import EmulationChoice
from touchdown.backend.rig.connection import reconnect


@EVERY
def test_a_move_arrives_reports_what_was_sent_and_keeps_its_speed(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    start = bench.arm.pose(0.1)
    target = Pose(start.x_mm + 6.0, start.y_mm - 2.0, start.z_mm + 10.0)
    begun_s = bench.now_s()
    motion = bench.arm.move_to(target, 20.0)
    with pytest.raises(ValueError, match="under way"):
        motion.result()
    bench.rest(0.05)
    assert bench.arm.status().robot_mode is RobotMode.MOVING
    bench.finish(motion)
    motion.result()
    assert motion.sent["speed_mm_s"] == 20.0
    assert motion.sent["z_mm"] == target.z_mm
    end = bench.arm.pose(0.1)
    assert (end.x_mm, end.y_mm, end.z_mm) == pytest.approx(
        (target.x_mm, target.y_mm, target.z_mm), abs=0.05
    )
    length = float(np.sqrt(6.0**2 + 2.0**2 + 10.0**2))
    assert bench.now_s() - begun_s >= length / 20.0
    poses = bench.arm.poses.window(begun_s, bench.now_s())
    speed = np.linalg.norm(np.diff(poses.values, axis=0), axis=1) / np.diff(poses.t_s)
    assert speed.max() <= 20.0 * 1.05
    bench.hear()
    assert bench.arm.status().robot_mode is RobotMode.READY
    assert bench.arm.status().safety_mode is SafetyMode.NORMAL


@EVERY
def test_a_press_finds_contact_holds_and_unloads(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    samples = bench.force_torque.samples
    air = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)
    motion = bench.arm.press(CONTRACT_BENCH_PRESS)
    assert motion.onset_s is None
    assert motion.sent["depth_mm"] == 1.5
    bench.finish(motion)
    motion.result()
    assert motion.onset_s is not None
    assert motion.detected_s is not None
    assert motion.onset_s <= motion.detected_s
    assert bench.now_s() == pytest.approx(motion.onset_s + CONTRACT_BENCH_PRESS.hold_s, abs=0.011)
    held = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 4.0 < held[2] < 11.0
    unload = bench.arm.unload(1.0, 2.0)
    bench.finish(unload)
    unload.result()
    bench.rest(0.2)
    left = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 0.3 <= left[2] <= 2.0
    assert unload.sent["force_n"] == 1.0


@pytest.mark.promise("G4")
@EVERY
def test_a_press_into_nothing_fails_with_a_fault(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 20.0), 20.0))
    motion = bench.arm.press(CONTRACT_BENCH_PRESS)
    bench.finish(motion)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code == "NO-CONTACT"
    assert motion.onset_s is None


@pytest.mark.promise("R14")
@EVERY
@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.5, 2.5])
def test_stop_ends_a_press_in_every_phase(bench: DevicesUnderTest, after_s: float) -> None:
    bench.lifted_and_gripped()
    motion = bench.arm.press(CONTRACT_BENCH_PRESS)
    bench.rest(after_s)
    assert not motion.done
    bench.arm.stop()
    bench.hear()
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    bench.rest(bench.still_s)
    still = bench.arm.pose(0.1)
    bench.rest(0.5)
    after = bench.arm.pose(0.1)
    assert (still.x_mm, still.y_mm, still.z_mm) == pytest.approx(
        (after.x_mm, after.y_mm, after.z_mm), abs=bench.still_mm
    )
    assert bench.gripper.status().holding


@pytest.mark.promise("R14")
@EVERY
def test_stop_is_legal_in_every_state(bench: DevicesUnderTest) -> None:
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()
    bench.connect()
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()
        stop()
    grip = bench.gripper.grip(10.0)
    bench.rest(0.1)
    bench.gripper.stop()
    bench.hear()
    with pytest.raises(FaultError):
        grip.result()
    assert not bench.gripper.status().holding
    for device in bench.all:
        device.close()
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()


@EVERY
def test_stop_comes_through_from_another_thread(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.2)
    thread = threading.Thread(target=bench.arm.stop)
    thread.start()
    thread.join(60.0)
    bench.hear()
    assert motion.done
    bench.rest(1.0)
    assert bench.arm.pose(0.1).z_mm < here.z_mm + 10.0


@EVERY
def test_a_newer_command_ends_the_older_one(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    first = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 30.0), 20.0)
    bench.rest(0.1)
    second = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 5.0), 20.0)
    bench.hear()
    with pytest.raises(FaultError):
        first.result()
    bench.finish(second)
    second.result()


@EVERY
def test_closing_the_connection_stops_motion_and_keeps_the_grip(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.1)
    bench.arm.close()
    bench.gripper.close()
    bench.hear()
    assert motion.done
    assert bench.holds()


@pytest.mark.promise("P1")
@EVERY
@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_numbers_are_refused(bench: DevicesUnderTest, speed: float) -> None:
    bench.lifted_and_gripped()
    with pytest.raises(bench.senseless):
        bench.arm.move_to(Pose(0.0, 0.0, 50.0), speed)
    with pytest.raises(bench.senseless):
        bench.arm.move_to(Pose(float("nan"), 0.0, 50.0), 10.0)
    with pytest.raises(bench.senseless):
        bench.gripper.open_to(50.0, speed)


@EVERY
def test_a_jog_ends_by_itself_and_a_renewal_is_the_same_motion(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    first = bench.arm.jog((0.0, 0.0, 10.0), 0.14)
    bench.rest(0.1)
    assert bench.arm.jog((0.0, 0.0, 10.0), 0.14) is first
    assert bench.arm.status().robot_mode is RobotMode.MOVING
    bench.rest(0.4)
    assert first.done
    first.result()
    assert bench.arm.status().robot_mode is RobotMode.READY
    gone = bench.arm.pose(0.1).z_mm - before.z_mm
    assert gone == pytest.approx(0.24 * 10.0, abs=0.2)


@EVERY
def test_a_jog_turns_without_an_end_and_stop_ends_it(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    motion = bench.arm.jog((20.0, 0.0, 0.0), 0.14)
    bench.rest(0.1)
    assert bench.arm.jog((0.0, 20.0, 0.0), 0.14) is motion
    bench.rest(0.1)
    bench.arm.stop()
    bench.rest(bench.still_s)
    after = bench.arm.pose(0.1)
    assert motion.done
    assert after.x_mm - before.x_mm > 1.0
    assert after.y_mm - before.y_mm > 0.5
    bench.rest(0.2)
    still = bench.arm.pose(0.1)
    assert (still.x_mm, still.y_mm, still.z_mm) == pytest.approx(
        (after.x_mm, after.y_mm, after.z_mm), abs=bench.still_mm
    )


@EVERY
@pytest.mark.parametrize("velocity", [(float("nan"), 0.0, 0.0), (float("inf"), 0.0, 0.0)])
def test_a_jog_without_a_number_is_refused(
    bench: DevicesUnderTest, velocity: tuple[float, float, float]
) -> None:
    bench.connect()
    with pytest.raises(bench.senseless):
        bench.arm.jog(velocity, 0.1)
    assert bench.arm.rotates in (True, False)


@EVERY
def test_halt_ends_a_move_and_the_next_one_begins_at_once(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.3)
    bench.arm.halt()
    bench.hear()
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    bench.rest(0.2)
    still = bench.arm.pose(0.02)
    bench.rest(0.1)
    assert bench.arm.pose(0.02).z_mm == pytest.approx(still.z_mm, abs=1e-3)
    before_s = bench.now_s()
    again = bench.arm.move_to(here, 20.0)
    assert bench.now_s() == before_s
    bench.rest(0.1)
    assert bench.arm.pose(0.02).z_mm < still.z_mm - 0.5
    assert not again.done


def high(bench: DevicesUnderTest) -> Pose:
    """Connect and go up to where the hand may turn."""
    bench.connect()
    bench.rest(0.1)
    here = bench.arm.pose(0.1)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 30.0), 50.0))
    bench.rest(0.1)
    return bench.arm.pose(0.1)


def vector(pose: Pose) -> tuple[float, float, float]:
    return (pose.rx_rad, pose.ry_rad, pose.rz_rad)


@EVERY
def test_the_hand_turns_on_the_way_and_back_and_presses_only_unturned(
    bench: DevicesUnderTest,
) -> None:
    up = high(bench)
    assert bench.arm.rotates
    begun_s = bench.now_s()
    there = Pose(up.x_mm + 5.0, up.y_mm, up.z_mm, 0.10, -0.05, 0.2)
    motion = bench.arm.move_to(there, 20.0, 0.2)
    bench.finish(motion)
    motion.result()
    assert bench.now_s() - begun_s >= float(np.linalg.norm(vector(there))) / 0.2
    bench.rest(0.1)
    pose = bench.arm.pose(0.1)
    assert vector(pose) == pytest.approx(vector(there), abs=1e-4)
    assert (pose.x_mm, pose.y_mm, pose.z_mm) == pytest.approx(
        (there.x_mm, there.y_mm, there.z_mm), abs=0.05
    )
    with pytest.raises(RefusedError, match="level it first"):
        bench.arm.press(CONTRACT_BENCH_PRESS)
    level = bench.arm.move_to(up, 20.0, 0.2)
    bench.finish(level)
    level.result()
    bench.rest(0.1)
    assert vector(bench.arm.pose(0.1)) == (0.0, 0.0, 0.0)


@EVERY
def test_a_turning_jog_keeps_its_pivot_and_ends_by_itself(bench: DevicesUnderTest) -> None:
    up = high(bench)
    first = bench.arm.jog(STILL, 0.14, (0.0, 0.1, 0.0))
    bench.rest(0.1)
    assert bench.arm.jog(STILL, 0.14, (0.0, 0.1, 0.0)) is first
    bench.rest(0.5)
    assert first.done
    first.result()
    pose = bench.arm.pose(0.1)
    # 2 rad/s^2 up to 0.1 rad/s, 0.24 s of it, and as much way down as was missed going up.
    assert vector(pose) == pytest.approx((0.0, 0.024, 0.0), abs=0.002)
    assert (pose.x_mm, pose.y_mm, pose.z_mm) == pytest.approx((up.x_mm, up.y_mm, up.z_mm), abs=0.02)


@EVERY
def test_a_joint_jog_turns_that_joint_alone_and_stop_ends_it(bench: DevicesUnderTest) -> None:
    high(bench)
    before = bench.arm.joints_rad(0.1)
    speeds = (0.0, 0.0, 0.0, 0.0, 0.0, 0.2)
    motion = bench.arm.jog_joints(speeds, 0.14)
    bench.rest(0.1)
    assert bench.arm.jog_joints(speeds, 0.14) is motion
    bench.rest(0.1)
    bench.arm.stop()
    bench.hear()
    assert motion.done
    bench.rest(bench.still_s)
    after = bench.arm.joints_rad(0.1)
    assert after[:5] == pytest.approx(before[:5], abs=1e-5)
    assert 0.005 < after[5] - before[5] < 0.04
    told, pose = bench.arm.place_of(after), bench.arm.pose(0.1)
    assert vector(told) == pytest.approx(vector(pose), abs=1e-5)
    assert (told.x_mm, told.y_mm, told.z_mm) == pytest.approx(
        (pose.x_mm, pose.y_mm, pose.z_mm), abs=0.02
    )
    bench.rest(0.3)
    assert bench.arm.joints_rad(0.1) == pytest.approx(after, abs=1e-5)


@EVERY
def test_joints_go_to_their_ends_and_never_beyond_their_range(bench: DevicesUnderTest) -> None:
    high(bench)
    before = bench.arm.joints_rad(0.1)
    target = (*before[:4], before[4] + 0.05, before[5] - 0.1)
    motion = bench.arm.move_joints(target, 0.2)
    bench.finish(motion)
    motion.result()
    bench.rest(0.1)
    assert bench.arm.joints_rad(0.1) == pytest.approx(target, abs=1e-4)
    beyond = (*target[:5], bench.arm.joint_limits_rad[5][1] + 0.01)
    refused = bench.arm.move_joints(beyond, 6.0)
    bench.finish(refused)
    with pytest.raises(FaultError) as raised:
        refused.result()
    assert raised.value.fault.code == "JOINT-RANGE"
    low, high_rad = bench.arm.joint_limits_rad[5]
    assert low <= bench.arm.joints_rad(0.1)[5] <= high_rad


@EVERY
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_turn_without_a_number_is_refused(bench: DevicesUnderTest, bad: float) -> None:
    bench.connect()
    with pytest.raises(bench.senseless):
        bench.arm.jog(STILL, 0.1, (0.0, bad, 0.0))
    with pytest.raises(bench.senseless):
        bench.arm.jog_joints((bad,) * 6, 0.1)
    with pytest.raises(bench.senseless):
        bench.arm.move_joints((0.0,) * 6, bad)


@EVERY
def test_servo_off_ends_motion_and_moves_nothing_until_it_is_on(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.3)
    bench.arm.servo(False)
    bench.hear()
    assert motion.done
    bench.rest(0.3)
    assert bench.arm.status().robot_mode is RobotMode.SERVO_OFF
    still = bench.arm.pose(0.2)
    with pytest.raises(FaultError):
        bench.finish(bench.arm.move_to(here, 20.0))
    bench.rest(0.2)
    assert bench.arm.pose(0.2).z_mm == pytest.approx(still.z_mm, abs=0.02)
    bench.arm.servo(True)
    bench.rest(0.2)
    back = bench.arm.move_to(here, 20.0)
    bench.finish(back)
    back.result()
    bench.hear()
    assert bench.arm.status().robot_mode is RobotMode.READY


@pytest.mark.promise("G3")
@EVERY
def test_a_retreat_draws_back_from_contact_once_and_stands(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    assert isinstance(bench.arm, RetreatingArm)
    samples = bench.force_torque.samples
    air_n = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)[2]
    motion = bench.arm.press(CONTRACT_BENCH_PRESS)
    bench.finish(motion)
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    bench.arm.retreat()
    bench.rest(1.0)
    after = bench.arm.pose(0.1)
    assert 1.0 < after.z_mm - before.z_mm < 2.6
    assert (after.x_mm, after.y_mm) == pytest.approx((before.x_mm, before.y_mm), abs=0.6)
    left_n = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0)[2] - air_n
    assert abs(left_n) < 1.0
    assert bench.gripper.status().holding
    assert bench.arm.status().robot_mode is RobotMode.READY
    bench.rest(0.3)
    assert bench.arm.pose(0.1).z_mm == pytest.approx(after.z_mm, abs=0.02)


@EVERY
def test_a_retreat_ends_a_move_that_runs_into_something_and_stop_ends_a_retreat(
    bench: DevicesUnderTest,
) -> None:
    bench.lifted_and_gripped()
    assert isinstance(bench.arm, RetreatingArm)
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm + 20.0, here.y_mm, here.z_mm + 5.0), 20.0)
    bench.rest(0.3)
    bench.arm.retreat()
    bench.hear()
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    bench.rest(0.1)
    bench.arm.stop()
    bench.rest(bench.still_s)
    stopped = bench.arm.pose(0.1)
    bench.rest(0.5)
    # Two millimetres take 0.2 s: it was stopped on its way.
    assert bench.arm.pose(0.1).z_mm == pytest.approx(stopped.z_mm, abs=bench.still_mm)


LOAD = (1.0, -2.0, -10.5, 0.1, -0.2, 0.05)
TREMBLE = (0.03, 0.03, 0.03, 0.003, 0.003, 0.003)
EMULATED = {}  # emulated sensors of installed packages: name of the driver -> class(wrench)


def emulated_makes():
    """Return the emulator name of each wrist sensor by the name of its driver."""
    makes = registry.emulated_makes().items()
    return {make.name: name for name, make in makes if make.kind == "force_torque"}


RATE_HZ = {**dict.fromkeys(emulated_makes(), 1000.0), "ft300": 100.0, "melfa": 1.0 / CYCLE_S}


def emulation_of(kind, folder, wrench):
    """Return the emulated sensor, on a pseudo terminal with a fixed name if it has one."""
    choice = EmulationChoice(emulated_makes()[kind], wrench=wrench)
    if sys.platform != "win32":
        with suppress(InputError):
            return emulate(replace(choice, tty=folder / "sensor"))
    return emulate(choice)


class Wired:
    """A driver and its emulated sensor."""

    def __init__(self, kind, folder):
        self.kind = kind
        load = add_noise(lambda now_s: LOAD, TREMBLE)
        if kind in EMULATED:
            self.faults = Faults("force_torque")
            sensor = EMULATED[kind](apply_faults(load, self.faults))
            serial = sys.platform != "win32"
            self.front = (
                PtyServer(sensor, faults=self.faults, link=folder / "sensor")
                if serial
                else TcpServer(sensor, faults=self.faults)
            )
            self._served = [self.front]
            tables = {"ft": {"driver": kind, "address": self.front.url}}
        else:
            emulation = emulation_of(kind, folder, load)
            self._served, self.front = list(emulation.fronts), emulation.fronts[0]
            self.faults = self.front.faults
            tables = tomllib.loads(bench_toml(emulation.bench))
        self.driver = make_force_torque(HardwareSettings.model_validate(tables), time.monotonic)
        for front in self._served:
            front.start()

    behind = 0
    """So many samples may be in the stream that the health does not count yet."""

    @property
    def condition(self):
        # What the rig tells of a device comes a moment after the device itself.
        return self.driver.describe().get("condition", "")

    def connect(self):
        self.driver.connect(5.0, threading.Event())

    def newest(self, count):
        """Values of the next ``count`` samples."""
        begin = self.driver.samples.count
        until(lambda: self.driver.samples.count >= begin + count)
        return self.driver.samples.since(begin).values

    def close(self):
        self.driver.close()
        for front in self._served:
            front.close()


class OverTheLink(Wired):
    """The same driver inside a rig."""

    behind = 2000

    def __init__(self, kind, folder):
        super().__init__(kind, folder)
        self._rig = TickingRig(time.monotonic, force_torque=self.driver)
        self.driver = self._rig.force_torque

    def close(self):
        super().close()
        self._rig.close()


@pytest.fixture(params=[*sorted(emulated_makes()), "leptrino over the link"])
def wired(request, tmp_path):
    kind, _, link = request.param.partition(" ")
    made = (OverTheLink if link else Wired)(kind, tmp_path)
    yield made
    made.close()


def test_every_make_has_an_emulated_sensor():
    # The link of ``ur`` is a package: test_ur_sensor.py holds it to a module like it.
    makes = {make.name for make in registry.MAKES if make.kind == "force_torque"}
    assert set(emulated_makes()) == makes - {"ur"}


def test_it_delivers_what_the_sensor_feels_in_order_at_its_rate(wired):
    driver = wired.driver
    assert driver.state is DeviceState.CLOSED
    assert driver.identity is None
    wired.connect()
    assert driver.state is DeviceState.READY
    assert driver.identity.maker
    assert driver.identity.serial
    assert np.all(driver.rated > 0)
    values = wired.newest(40)
    assert np.abs(values.mean(axis=0) - LOAD).max() < 0.1
    assert np.all(np.abs(values[:, 3:].mean(axis=0) - LOAD[3:]) < 0.01)
    run = driver.samples.since(0)
    assert np.all(np.diff(run.t_s) > 0)
    period_s = 1.0 / (RATE_HZ.get(wired.kind) or driver.describe()["usual_hz"])
    span_s = run.t_s[-1] - run.t_s[10]
    assert span_s / (len(run.t_s) - 11) == pytest.approx(period_s, rel=0.3)
    assert driver.samples.count - driver.health.received in range(wired.behind + 1)
    assert wired.condition in ("good", "slow")
    assert all(isinstance(value, str | float | int) for value in driver.describe().values())


@pytest.mark.promise("S1")
def test_garbage_is_refused_counted_and_overcome(wired):
    wired.connect()
    wired.front.inject("garbage", 0.2, share=0.2)
    wired.front.inject("flip", 0.2, share=0.1)
    until(lambda: not wired.faults.names(time.monotonic()))
    if wired.driver.state is DeviceState.FAULT:
        reconnect(wired.driver, 5.0, threading.Event())
    values = wired.newest(20)
    assert np.abs(values.mean(axis=0) - LOAD).max() < 0.2


@pytest.mark.promise("S6")
def test_a_frozen_sensor_gives_no_measurement(wired):
    wired.connect()
    wired.newest(5)
    wired.front.inject("freeze")
    until(lambda: wired.condition == "stuck")
    assert np.isnan(wired.newest(3)).all()
    wired.faults.clear()
    until(lambda: np.isfinite(wired.newest(2)).all())
    assert wired.driver.state is DeviceState.READY


@pytest.mark.promise("S7")
def test_the_end_of_the_range_is_a_fault_and_no_number(wired):
    wired.connect()
    begin = wired.driver.samples.count
    wired.front.inject("saturate")
    until(lambda: wired.driver.fault is not None)
    assert wired.driver.fault.code in ("FT-OVERLOAD", "FT-SENSOR")
    assert wired.driver.state is DeviceState.FAULT
    # Over the link the word of the fault may come before the last samples.
    until(lambda: not np.isfinite(wired.driver.samples.since(begin).values).all())
    values = wired.driver.samples.since(begin).values
    finite = values[np.isfinite(values).all(axis=1)]
    assert not len(finite) or np.abs(finite - LOAD).max() < 1.0


@pytest.mark.promise("S4")
def test_unplugged_it_is_a_fault_and_plugged_in_again_it_heals(wired):
    wired.connect()
    first = wired.driver.identity
    wired.front.inject("unplug")
    until(lambda: wired.driver.state is DeviceState.FAULT)
    assert wired.driver.fault.code == "FT-LINK"
    wired.faults.clear()

    def back():
        try:
            reconnect(wired.driver, 2.0, threading.Event())
        except FaultError:
            return False
        return True

    until(back)
    assert wired.driver.identity == first
    assert np.abs(wired.newest(20).mean(axis=0) - LOAD).max() < 0.2


def test_connecting_can_be_cancelled_and_closing_twice_is_allowed(wired):
    cancel = threading.Event()
    cancel.set()
    with pytest.raises(FaultError, match="cancelled"):
        wired.driver.connect(5.0, cancel)
    wired.driver.close()
    wired.driver.close()
    assert wired.driver.state is DeviceState.CLOSED


@pytest.mark.promise("S5")
def test_a_gripper_in_place_of_a_wrist_sensor_is_refused():
    front = TcpServer(EmulatedWsg())
    settings = {"ft": {"driver": "leptrino", "address": front.url}}
    driver = make_force_torque(HardwareSettings.model_validate(settings), time.monotonic)
    front.start()
    words = "This is a WSG gripper that speaks its binary protocol, expected a force/torque sensor"
    with pytest.raises(FaultError, match=words):
        driver.connect(2.0, threading.Event())
    assert driver.state is DeviceState.CLOSED
    front.close()


SURFACE_MM = 40.0
HERE = Pose(12.0, -7.0, 90.0)
LEANT = replace(HERE, rx_rad=0.1, ry_rad=-0.05)
PRESS = PressCommand(1.5, 0.5, 2.0, 2.0, 1.0, 10.0, (5.0, 7.0, 19.0))
JOINTS = (0.1, -0.2, 0.3, 0.0, 0.5, -0.4)
GOAL = (0.5, -0.2, 0.3, 0.0, 0.5, -0.4)
"""From ``JOINTS`` the first joint turns by 0.4 rad."""


class NotedArm:
    """Stands at ``here``; ``leans_at``: angle of the first joint at which the hand leans far."""

    name, rotates = "arm", True
    here = HERE
    leans_at: float | None = None

    def __init__(self) -> None:
        self.orders: list[tuple[object, ...]] = []

    def status(self) -> ArmStatus:
        return ArmStatus(RobotMode.READY, SafetyMode.NORMAL, 1.0, 0)

    def pose(self, max_age_s: float) -> Pose:
        return self.here

    def joints_rad(self, max_age_s: float) -> tuple[float, ...]:
        return JOINTS

    def place_of(self, joints_rad: tuple[float, ...]) -> Pose:
        far = self.leans_at is not None and abs(joints_rad[0] - self.leans_at) < 1e-6
        return replace(HERE, rx_rad=0.5) if far else HERE

    def stop(self) -> None:
        self.orders.append(("stop",))

    def __getattr__(self, order: str) -> object:
        return lambda *told: self.orders.append((order, *told))


class Guard:
    """The guarded arm with a live lease, no force at the wrist, and a known surface."""

    def __init__(self, **limits: float) -> None:
        self.noted, self.interlock = NotedArm(), Interlock(Limits(**limits))
        self.interlock.renew_lease(3.0)
        self.arm = GuardedArm(
            self.noted,  # type: ignore[arg-type]
            self.interlock,
            lambda: 3.0,
            lambda: 0.0,
            lambda: SURFACE_MM,
        )

    def refusal(self, order: str, *told: object) -> str | None:
        """Return why ``order`` was refused; None if it reached the arm, and it alone."""
        self.noted.orders.clear()
        try:
            getattr(self.arm, order)(*told)
        except RefusedError as cause:
            assert self.noted.orders == []
            return cause.reason
        assert [name for name, *_ in self.noted.orders] == [order]
        return None


MOTIONS = {
    "move_to": (replace(HERE, z_mm=95.0), 20.0),
    "jog": ((3.0, -4.0, 5.0), 0.2),
    "jog_joints": ((0.02, 0.0, 0.0, 0.0, 0.0, 0.0), 0.2),
    "move_joints": (GOAL, 0.2),
    "press": (PRESS,),
    "unload": (1.0, 2.0),
}


@pytest.mark.parametrize("order", MOTIONS)
def test_every_motion_needs_a_lease_and_no_latch(order: str) -> None:
    guard = Guard()
    assert guard.refusal(order, *MOTIONS[order]) is None
    guard.interlock.drop_lease()
    assert guard.refusal(order, *MOTIONS[order]) == "NO-LEASE"
    guard.interlock.renew_lease(3.0)
    guard.interlock.stop("operator")
    assert guard.refusal(order, *MOTIONS[order]) == "STOPPED"


@pytest.mark.parametrize("at", [0.2, 0.3, 0.4, 0.5])
def test_a_turn_of_joints_is_refused_for_a_quarter_of_its_way_that_is_not_allowed(
    at: float,
) -> None:
    guard = Guard()
    assert guard.refusal("move_joints", GOAL, 0.2) is None
    guard.noted.leans_at = at
    assert guard.refusal("move_joints", GOAL, 0.2) == "TILT"


def test_the_override_slows_every_move() -> None:
    guard = Guard()
    guard.interlock.override_speed(0.4)
    there = Pose(15.0, -11.0, 80.0)
    guard.arm.move_to(there, 30.0)
    turned = replace(there, ry_rad=0.1)
    guard.arm.move_to(turned, 30.0, 0.2)
    guard.arm.move_joints(GOAL, 0.2)
    assert guard.noted.orders == [
        ("move_to", there, pytest.approx(12.0)),
        ("move_to", turned, pytest.approx(12.0), pytest.approx(0.08)),
        ("move_joints", GOAL, pytest.approx(0.08)),
    ]


def test_the_nominal_force_of_a_press_is_that_along_z() -> None:
    guard = Guard(probe_n=30.0)
    hard = replace(PRESS, stiffness_n_mm=(5.0, 7.0, 20.1))
    assert guard.refusal("press", hard) == "PRESS-FORCE"
    assert guard.refusal("press", replace(hard, stiffness_n_mm=(25.0, 30.0, 19.9))) is None


def test_a_press_approaches_no_faster_than_contact_allows() -> None:
    guard = Guard()
    assert guard.refusal("press", replace(PRESS, approach_mm_s=2.0)) is None
    assert guard.refusal("press", replace(PRESS, approach_mm_s=2.01)) == "APPROACH-SPEED"
    assert guard.refusal("press", replace(PRESS, approach_mm_s=0.0)) == "APPROACH-SPEED"


def test_a_turned_hand_is_not_jogged_down_to_the_surface() -> None:
    guard = Guard(turn_clear_mm=20.0)
    down = ((1.0, -2.0, -3.0), 0.2)
    for height_mm, refusal in ((61.0, None), (60.0, "LIMIT"), (50.0, "LIMIT")):
        guard.noted.here = replace(LEANT, z_mm=height_mm)
        assert guard.refusal("jog", *down) == refusal
        assert guard.refusal("jog", (1.0, -2.0, 3.0), 0.2) is None
        guard.noted.here = replace(HERE, z_mm=height_mm)
        assert guard.refusal("jog", *down) is None


class Plugged:
    """A device whose serial number changes with each connection."""

    def __init__(self, *serials):
        self.name, self._serials, self.state = "tactile_left", list(serials), DeviceState.CLOSED
        self.identity, self.closes = None, 0

    def connect(self, timeout_s, cancel):
        self.identity = Identity("m", "m", self._serials.pop(0), "1")
        self.state = DeviceState.READY

    def close(self):
        self.closes += 1
        self.state = DeviceState.CLOSED


def test_the_same_one_is_taken():
    device = Plugged("A", "A")
    device.connect(1.0, threading.Event())
    reconnect(device, 1.0, threading.Event())
    assert device.state is DeviceState.READY
    assert device.closes == 1


@pytest.mark.promise("C1")
def test_another_one_is_refused_and_named():
    device = Plugged("A", "B")
    device.connect(1.0, threading.Event())
    with pytest.raises(FaultError, match="Serial number B answers instead of A"):
        reconnect(device, 1.0, threading.Event())
    assert device.state is DeviceState.CLOSED

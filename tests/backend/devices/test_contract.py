"""One contract for every set of devices: whoever implements the Protocols is held to this."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pytest

from backend.config.simulation import SimulationSettings
from backend.core.faults import FaultError, StaleSampleError
from backend.core.flow import FINGERS, Finger, Pose
from backend.devices.protocols import (
    Arm,
    Device,
    DeviceState,
    ForceTorqueSensor,
    Gripper,
    Motion,
    PressCommand,
    RobotMode,
    SafetyMode,
    TactileSensor,
)
from backend.devices.sim.bench import SimulatedBench
from backend.objects.catalogue import load_catalogue
from backend.objects.tower import Tower
from backend.simulation.scene import Scene

PRESS = PressCommand(1.5, 1.5, 2.0, 2.0, 1.0, 11.0, (30.0, 30.0, 15.0))


@dataclass
class DevicesUnderTest:
    """A full set of devices, and the way its time passes."""

    arm: Arm
    gripper: Gripper
    force_torque: ForceTorqueSensor
    tactile: Mapping[Finger, TactileSensor]
    now_s: Callable[[], float]
    advance: Callable[[int], None]

    @property
    def all(self) -> list[Device]:
        return [self.arm, self.gripper, self.force_torque, *self.tactile.values()]

    def connect(self) -> None:
        for device in self.all:
            device.connect(1.0, threading.Event())

    def rest(self, seconds: float) -> None:
        self.advance(round(seconds * 1e6))

    def finish(self, motion: Motion, limit_s: float = 20.0) -> None:
        until_s = self.now_s() + limit_s
        while not motion.done:
            assert self.now_s() < until_s, "the motion does not end"
            self.advance(10_000)

    def lifted_and_gripped(self) -> None:
        self.connect()
        self.finish(self.gripper.grip(10.0))
        self.rest(0.3)


def simulated() -> DevicesUnderTest:
    catalogue = load_catalogue()
    bottoms = Tower((catalogue.bottom("short").body(),))
    settings = SimulationSettings(preset="mixed")
    bench = SimulatedBench(Scene(catalogue.top("pot"), bottoms, (6.0, 3.0), 11, settings))
    return DevicesUnderTest(
        bench.arm,
        bench.gripper,
        bench.force_torque,
        bench.tactile,
        bench.clock.now_s,
        bench.advance,
    )


@pytest.fixture(params=[simulated], ids=["simulated"])
def bench(request: pytest.FixtureRequest) -> DevicesUnderTest:
    made: DevicesUnderTest = request.param()
    return made


def test_connections_open_and_close_any_number_of_times(bench: DevicesUnderTest) -> None:
    for device in bench.all:
        assert device.state is DeviceState.CLOSED
        assert device.identity is None
        device.close()
        for _ in range(2):
            device.connect(1.0, threading.Event())
            assert device.state is DeviceState.READY
        assert device.identity is not None
        assert device.identity.serial
        assert device.name
        for _ in range(2):
            device.close()
            assert device.state is DeviceState.CLOSED


def test_names_are_those_the_bench_looks_them_up_by(bench: DevicesUnderTest) -> None:
    assert [device.name for device in bench.all] == [
        "arm",
        "gripper",
        "force_torque",
        "tactile_left",
        "tactile_right",
    ]
    assert [sensor.finger for sensor in bench.tactile.values()] == list(FINGERS)


def test_describe_gives_words_and_numbers(bench: DevicesUnderTest) -> None:
    bench.connect()
    for device in bench.all:
        fields = device.describe()
        assert fields
        assert all(isinstance(value, str | float | int) for value in fields.values())


def test_a_closed_device_delivers_nothing_and_refuses_commands(bench: DevicesUnderTest) -> None:
    bench.rest(0.5)
    assert bench.force_torque.samples.count == 0
    assert all(sensor.frames.count == 0 for sensor in bench.tactile.values())
    assert bench.arm.status().robot_mode is RobotMode.DISCONNECTED
    for command in (
        lambda: bench.arm.move_to(Pose(0.0, 0.0, 50.0), 10.0),
        lambda: bench.arm.press(PRESS),
        lambda: bench.gripper.grip(10.0),
        lambda: bench.gripper.open_to(50.0, 5.0),
    ):
        with pytest.raises(FaultError):
            command()


def test_there_is_no_pose_before_the_first_and_none_too_old(bench: DevicesUnderTest) -> None:
    bench.arm.connect(1.0, threading.Event())
    with pytest.raises(StaleSampleError):
        bench.arm.pose(max_age_s=10.0)
    bench.rest(0.1)
    assert bench.arm.pose(max_age_s=0.05).z_mm > 0.0
    bench.arm.close()
    bench.rest(0.5)
    with pytest.raises(StaleSampleError):
        bench.arm.pose(max_age_s=0.2)


def test_streams_run_in_order_of_time_at_their_rates(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(4.0)
    samples = bench.force_torque.samples.since(0)
    assert np.all(np.diff(samples.t_s) > 0.0)
    assert samples.values.shape == (len(samples.t_s), 6)
    assert np.isfinite(samples.values).all()
    assert samples.t_s[-1] <= bench.now_s()
    assert bench.force_torque.health.rate_hz == pytest.approx(1000.0, rel=0.02)
    for sensor in bench.tactile.values():
        frames, _, lost = sensor.frames.since(0)
        assert lost == 0
        t_s = np.array([frame.t_s for frame in frames])
        assert np.all(np.diff(t_s) > 0.0)
        assert np.all(np.diff([frame.sequence for frame in frames]) >= 1)
        assert len(frames) == pytest.approx(100, abs=4)
        assert sensor.health.rate_hz == pytest.approx(25.0, abs=2.0)
        assert sensor.health.received == len(frames)
        assert sensor.health.lost == frames[-1].sequence - frames[0].sequence + 1 - len(frames)
        assert 0.0 <= sensor.health.age_s < 0.1


def test_frames_are_read_only_pictures_of_the_right_kind(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.3)
    for finger, sensor in bench.tactile.items():
        frame = sensor.frames.newest()
        assert frame is not None
        assert frame.finger == finger
        assert frame.image.shape == (240, 320, 3)
        assert frame.image.dtype == np.uint8
        with pytest.raises(ValueError, match="read-only"):
            frame.image[0, 0, 0] = 1


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
    assert bench.arm.status().robot_mode is RobotMode.READY
    assert bench.arm.status().safety_mode is SafetyMode.NORMAL


def test_a_press_finds_contact_holds_and_unloads(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    samples = bench.force_torque.samples
    air = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)
    motion = bench.arm.press(PRESS)
    assert motion.onset_s is None
    assert motion.sent["depth_mm"] == 1.5
    bench.finish(motion)
    motion.result()
    assert motion.onset_s is not None
    assert motion.detected_s is not None
    assert motion.onset_s <= motion.detected_s
    assert bench.now_s() == pytest.approx(motion.onset_s + PRESS.hold_s, abs=0.011)
    held = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 4.0 < held[2] < 11.0
    unload = bench.arm.unload(1.0, 2.0)
    bench.finish(unload)
    unload.result()
    bench.rest(0.2)
    left = samples.window(bench.now_s() - 0.1, bench.now_s()).values.mean(axis=0) - air
    assert 0.3 <= left[2] <= 2.0
    assert unload.sent["force_n"] == 1.0


def test_a_press_into_nothing_fails_with_a_fault(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    bench.finish(bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 20.0), 20.0))
    motion = bench.arm.press(PRESS)
    bench.finish(motion)
    with pytest.raises(FaultError) as raised:
        motion.result()
    assert raised.value.fault.code == "NO-CONTACT"
    assert motion.onset_s is None


@pytest.mark.parametrize("after_s", [0.0, 0.02, 0.5, 2.5])
def test_stop_ends_a_press_in_every_phase(bench: DevicesUnderTest, after_s: float) -> None:
    bench.lifted_and_gripped()
    motion = bench.arm.press(PRESS)
    bench.rest(after_s)
    assert not motion.done
    bench.arm.stop()
    assert motion.done
    with pytest.raises(FaultError):
        motion.result()
    bench.rest(0.02)
    still = bench.arm.pose(0.1)
    bench.rest(0.5)
    after = bench.arm.pose(0.1)
    assert (still.x_mm, still.y_mm, still.z_mm) == pytest.approx(
        (after.x_mm, after.y_mm, after.z_mm), abs=1e-3
    )
    assert bench.gripper.status().holding


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
    with pytest.raises(FaultError):
        grip.result()
    assert not bench.gripper.status().holding
    for device in bench.all:
        device.close()
    for stop in (bench.arm.stop, bench.gripper.stop):
        stop()


def test_stop_comes_through_from_another_thread(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.2)
    thread = threading.Thread(target=bench.arm.stop)
    thread.start()
    thread.join(5.0)
    assert motion.done
    bench.rest(1.0)
    assert bench.arm.pose(0.1).z_mm < here.z_mm + 10.0


def test_a_newer_command_ends_the_older_one(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    first = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 30.0), 20.0)
    bench.rest(0.1)
    second = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 5.0), 20.0)
    with pytest.raises(FaultError):
        first.result()
    bench.finish(second)
    second.result()


def test_the_gripper_takes_the_piece_and_lets_it_go(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.05)
    wide = bench.gripper.status()
    assert not wide.holding
    grip = bench.gripper.grip(10.0)
    assert grip.sent == {"force_n": 10.0}
    bench.finish(grip)
    grip.result()
    held = bench.gripper.status()
    assert held.holding
    assert held.width_mm < wide.width_mm
    assert held.force_n == pytest.approx(10.0, abs=1.5)
    bench.finish(bench.arm.press(PRESS))
    bench.finish(bench.arm.unload(1.0, 2.0))
    opening = bench.gripper.open_to(held.width_mm + 4.0, 5.0)
    bench.finish(opening)
    opening.result()
    assert not bench.gripper.status().holding
    assert bench.gripper.status().width_mm == pytest.approx(held.width_mm + 4.0, abs=0.1)


def test_closing_the_connection_stops_motion_and_keeps_the_grip(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    here = bench.arm.pose(0.1)
    motion = bench.arm.move_to(Pose(here.x_mm, here.y_mm, here.z_mm + 60.0), 20.0)
    bench.rest(0.1)
    bench.arm.close()
    bench.gripper.close()
    assert motion.done
    assert bench.gripper.status().holding


@pytest.mark.parametrize("speed", [0.0, -1.0, float("nan"), float("inf")])
def test_senseless_numbers_are_refused(bench: DevicesUnderTest, speed: float) -> None:
    bench.lifted_and_gripped()
    with pytest.raises(ValueError, match="finite"):
        bench.arm.move_to(Pose(0.0, 0.0, 50.0), speed)
    with pytest.raises(ValueError, match="finite"):
        bench.arm.move_to(Pose(float("nan"), 0.0, 50.0), 10.0)
    with pytest.raises(ValueError, match="finite"):
        bench.gripper.open_to(50.0, speed)


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


def test_a_jog_turns_without_an_end_and_stop_ends_it(bench: DevicesUnderTest) -> None:
    bench.connect()
    bench.rest(0.1)
    before = bench.arm.pose(0.1)
    motion = bench.arm.jog((20.0, 0.0, 0.0), 0.14)
    bench.rest(0.1)
    assert bench.arm.jog((0.0, 20.0, 0.0), 0.14) is motion
    bench.rest(0.1)
    bench.arm.stop()
    bench.rest(0.02)
    after = bench.arm.pose(0.1)
    assert motion.done
    assert after.x_mm - before.x_mm > 1.0
    assert after.y_mm - before.y_mm > 0.5
    bench.rest(0.2)
    assert bench.arm.pose(0.1) == after


@pytest.mark.parametrize("velocity", [(float("nan"), 0.0, 0.0), (float("inf"), 0.0, 0.0)])
def test_a_jog_without_a_number_is_refused(
    bench: DevicesUnderTest, velocity: tuple[float, float, float]
) -> None:
    bench.connect()
    with pytest.raises(ValueError, match="finite"):
        bench.arm.jog(velocity, 0.1)
    assert bench.arm.rotates in (True, False)

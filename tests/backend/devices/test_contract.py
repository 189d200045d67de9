"""One contract for every set of devices: whoever implements the Protocols is held to this."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from tests.backend.devices.contract_bench import EVERY, ONLY_SIMULATED, PRESS, DevicesUnderTest
from touchdown.backend.core.faults import FaultError, StaleSampleError
from touchdown.backend.core.values import FINGERS, Pose
from touchdown.backend.devices.protocols import DeviceState, RobotMode


@EVERY
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


@EVERY
def test_names_are_those_the_bench_looks_them_up_by(bench: DevicesUnderTest) -> None:
    assert [device.name for device in bench.all] == [
        "arm",
        "gripper",
        "force_torque",
        "tactile_left",
        "tactile_right",
    ]
    assert [sensor.finger for sensor in bench.tactile.values()] == list(FINGERS)


@EVERY
def test_describe_gives_words_and_numbers(bench: DevicesUnderTest) -> None:
    bench.connect()
    for device in bench.all:
        fields = device.describe()
        assert fields
        assert all(isinstance(value, str | float | int) for value in fields.values())


@EVERY
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


@EVERY
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


@ONLY_SIMULATED
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


@ONLY_SIMULATED
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


@ONLY_SIMULATED
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

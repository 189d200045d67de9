"""The part of the contract that arms are held to which draw back from a contact."""

from __future__ import annotations

import pytest

from tests.backend.devices.contract_bench import EVERY, PRESS, DevicesUnderTest
from touchdown.backend.core import FaultError, Pose
from touchdown.backend.devices.protocols import RetreatingArm, RobotMode


@pytest.mark.promise("G3")
@EVERY
def test_a_retreat_draws_back_from_contact_once_and_stands(bench: DevicesUnderTest) -> None:
    bench.lifted_and_gripped()
    assert isinstance(bench.arm, RetreatingArm)
    samples = bench.force_torque.samples
    air_n = samples.window(bench.now_s() - 0.2, bench.now_s()).values.mean(axis=0)[2]
    motion = bench.arm.press(PRESS)
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

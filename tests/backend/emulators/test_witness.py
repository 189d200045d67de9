"""Observations of the emulated devices on a driver that violates the rules."""

import json
from dataclasses import asdict

import numpy as np
import pytest

from touchdown.backend.bench.emulated_scene import (
    REST_ROWS,
    DriverMonitor,
    DriverObservations,
    TruthServer,
)
from touchdown.backend.config.hardware import MelfaSettings
from touchdown.backend.devices.melfa.emulated_controller import SPEEDS_RAD_S
from touchdown.backend.devices.melfa.emulator import EmulatedMelfa
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    AxisValues,
    BlockKind,
    MxtCommand,
    MxtRequest,
    encode_mxt_request,
)
from touchdown.backend.devices.wsg import protocol
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.devices.wsg.protocol import WsgCommand as Word


def move(joints_rad) -> bytes:
    target = AxisValues(BlockKind.JOINT, (*map(float, joints_rad), 0.0, 0.0))
    return encode_mxt_request(MxtRequest(MxtCommand.MOVE, target, (2, 0, 0, 0), 0))


@pytest.fixture
def melfa():
    made = EmulatedMelfa(MelfaSettings(), streaming=True)
    made.controller.advance(1.0)
    return made


def test_a_command_after_an_emergency_stop_is_seen_with_its_delay(melfa):
    here = melfa.controller.joints.command_rad
    assert melfa.stream.receive(1.0, move(here)) is not None
    melfa.controller.press_emergency_stop()
    assert DriverMonitor(melfa).observations(0.0).late_command_s == 0.0
    assert "no command after an error" in str(DriverMonitor(melfa).observations(0.0))
    melfa.stream.receive(1.25, move(here))
    melfa.stream.receive(
        1.75, encode_mxt_request(MxtRequest(MxtCommand.NONE, None, (2, 0, 0, 0), 0))
    )
    assert DriverMonitor(melfa).observations(0.0).late_command_s == pytest.approx(0.25)
    assert "250 ms after an error" in str(DriverMonitor(melfa).observations(0.0))


def test_a_step_is_seen_as_a_share_of_the_top_speed(melfa):
    here = melfa.controller.joints.command_rad.copy()
    here[0] += 0.8 * SPEEDS_RAD_S[0] * CYCLE_S
    melfa.stream.receive(1.0, move(here))
    assert DriverMonitor(melfa).observations(0.0).step_share == pytest.approx(0.8)


def test_force_counts_from_what_hangs_on_the_sensor(melfa):
    monitor = DriverMonitor(melfa)
    hanging = np.tile([0.0, 0.0, -14.7, 0.0, 0.0, 0.0], (REST_ROWS, 1))
    monitor.add_samples(hanging)
    monitor.add_samples(hanging + np.array([0.0, 3.0, 4.0, 9.0, 9.0, 9.0]))
    assert monitor.observations(0.0).force_n == pytest.approx(5.0)


def test_a_motion_asked_of_a_gripper_in_a_fault_is_seen(melfa):
    gripper = EmulatedWsg()
    gripper.closed(0.0)  # without a word: the fast stop is latched
    home = protocol.encode_request(protocol.WsgRequest(int(Word.HOME), (1,)))
    gripper.receive(0.1, home)
    assert gripper.barred == 1


def test_truth_and_witness_are_told_line_by_line(melfa):
    seen = DriverObservations(0.1, 0.0, 0.0, 1, 0, 8.0)

    class Joined:
        def driver_observations(self):
            return seen

    observations = TruthServer(Joined()).receive(0.0, b"seen\nseen\n")
    assert [json.loads(line) for line in observations.splitlines()] == [asdict(seen)] * 2

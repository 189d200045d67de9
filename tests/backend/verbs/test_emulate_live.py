"""Faults that are typed while an emulated device serves."""

import io
import os
import time

import pytest

from touchdown.backend.cli.emulate import FaultPrompt
from touchdown.backend.devices.wsg.emulator import EmulatedWsg
from touchdown.backend.emulation.fault_plan import Faults
from touchdown.backend.emulation.server import TcpServer


@pytest.fixture
def fronts():
    """A gripper and a sensor, begun but with no thread."""
    made = [TcpServer(EmulatedWsg(), faults=Faults(name)) for name in ("gripper", "force_torque")]
    for front in made:
        front.faults.begin(time.monotonic())
    yield made
    for front in made:
        front.close()


def on(front):
    return front.faults.names(time.monotonic())


def test_a_kind_alone_strikes_the_main_device_and_a_named_one_its_own(fronts):
    typed = FaultPrompt(fronts, io.StringIO())
    assert typed.obey("part_lost 60") == "gripper: part_lost for 60 s."
    assert "until 'clear'" in typed.obey("force_torque freeze")
    assert (on(fronts[0]), on(fronts[1])) == (("part_lost",), ("freeze",))
    typed.obey("clear")
    assert (on(fronts[0]), on(fronts[1])) == ((), ())


@pytest.mark.parametrize("line", ["dark", "part_lost soon", "part_lost -1", "gripper"])
def test_what_is_no_fault_is_said_and_does_nothing(fronts, line):
    assert "is no fault" in FaultPrompt(fronts, io.StringIO()).obey(line)
    assert on(fronts[0]) == ()


def test_a_wrong_word_is_answered_with_the_kinds_there_are(fronts):
    typed = FaultPrompt(fronts, io.StringIO())
    assert "use one of lost, flip" in typed.obey("help")
    assert "'hz', how many samples a second, belongs to 'slow'" in typed.obey("force_torque slow")


def test_lines_come_as_they_are_typed_and_end(fronts):
    read, write = os.pipe()
    with os.fdopen(read) as source:
        typed = FaultPrompt(fronts, source)
        assert typed.take(0.0) == ""
        os.write(write, b"silent 9\n")
        assert typed.take(1.0) == "gripper: silent for 9 s."
        os.write(write, b"part_lost 9\nforce_torque freeze 9\nsil")
        assert typed.take(1.0) == "gripper: part_lost for 9 s."
        assert typed.take(0.0) == "force_torque: freeze for 9 s."
        assert typed.take(1.0) == ""
        os.write(write, b"ent 8\n")
        assert typed.take(1.0) == "gripper: silent for 8 s."
        os.close(write)
        assert typed.take(1.0) == ""
        assert not typed.listens


def test_where_nobody_can_type_nothing_is_waited_for(fronts):
    assert not FaultPrompt(fronts, io.StringIO()).listens

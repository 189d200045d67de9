"""A computer that does not keep the time of the stream is known before the arm is switched on."""

import threading

import pytest

from tests.backend.devices.emulated_arm import CYCLE_US, Rig
from touchdown.backend.core.faults import FaultError
from touchdown.backend.devices.protocols import DeviceState

LAB, HERE = "192.168.0.20", "127.0.0.1"


def checked(host: str, cycles: int) -> Rig:
    """Return a bench whose driver gets no processor for so many cycles, amid the check."""
    rig = Rig(host=host, idle_check_s=0.5)
    go_on, begun_us = rig.wires.also, []
    watch = rig.wires.watch_anew

    def watch_anew() -> None:
        begun_us.append(rig.wires.clock.now_us)
        watch()

    def stall(step_us: int) -> None:
        go_on(step_us)
        if begun_us:
            into = (rig.wires.clock.now_us - begun_us[0]) // CYCLE_US - 50
            rig.wires.stalled = 0 <= into < cycles

    rig.wires.watch_anew, rig.wires.also = watch_anew, stall
    return rig


@pytest.mark.promise("P4")
@pytest.mark.parametrize(("cycles", "told"), [(0, False), (8, False), (12, True), (27, True)])
def test_a_starved_rig_is_warned_of_from_35_ms_on(cycles, told):
    rig = checked(LAB, cycles)
    rig.arm.connect(1.0, threading.Event())
    notice = rig.arm.describe().get("notice", "")
    assert rig.arm.state is DeviceState.READY
    assert bool(notice) is told
    assert not told or f"for {3.5 * (cycles + 1):.0f} ms" in notice


@pytest.mark.promise("P4")
def test_on_hardware_a_gap_over_101_ms_is_refused_before_the_servo_goes_on():
    rig = checked(LAB, 40)
    with pytest.raises(FaultError, match="for 144 ms") as refused:
        rig.arm.connect(1.0, threading.Event())
    assert refused.value.fault.code == "RIG-STARVED"
    assert not rig.device.controller.servo
    assert not [data for _, data in rig.wires.packets if data[:2] == b"\x01\x00"]


def test_an_emulated_arm_is_connected_with_a_warning():
    rig = checked(HERE, 40)
    rig.arm.connect(1.0, threading.Event())
    assert "144 ms" in rig.arm.describe()["notice"]


def test_cancelling_ends_the_check():
    rig = Rig(host=LAB, idle_check_s=60.0)
    cancel, go_on = threading.Event(), rig.wires.also

    def also(step_us: int) -> None:
        go_on(step_us)
        if rig.wires.clock.now_s() > 1.0:
            cancel.set()

    rig.wires.also = also
    with pytest.raises(FaultError, match="cancelled"):
        rig.arm.connect(1.0, cancel)
    assert rig.wires.clock.now_s() < 2.0

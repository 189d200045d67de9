"""A fault of a device in a scene latches the interlock."""

from dataclasses import dataclass, replace

from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.core.faults import Fault
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import SceneChoice

POWER = Fault("WSG-DEVICE", "Its supply voltage is out of range.", "It stands.", "Look at it.")


@dataclass
class Failing:
    """Gripper that reports a fault."""

    state: DeviceState = DeviceState.READY
    fault: Fault | None = None


def test_a_fault_of_a_device_is_latched_with_the_next_step():
    session = simulated_session(SimulatedBenchChoice(), keep=RecordingOptions(None))
    session.prepare(SceneChoice("pot", ("short",), 1))
    gripper = Failing()
    devices = {**session.devices, "gripper": gripper}
    session._stage = replace(session._stage, devices=devices)
    session.advance()
    assert not session.interlock.latched
    gripper.state, gripper.fault = DeviceState.FAULT, POWER
    session.advance()
    assert [fault.code for fault in session.interlock.faults] == ["WSG-DEVICE"]
    session.close()

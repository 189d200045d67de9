"""What can be wrong with a WSG gripper, in the operator's words."""

from __future__ import annotations

from backend.core.faults import Fault
from backend.wire.wsg_words import Command, Status, SystemFlag

NAME = "gripper"
DEVICE_FAULTS = {
    SystemFlag.TEMP_FAULT: "it is too hot",
    SystemFlag.POWER_FAULT: "its supply voltage is out of range",
    SystemFlag.CURR_FAULT: "its motor takes too much current",
    SystemFlag.FINGER_FAULT: "a finger reports a failure",
}
_STANDS = "The gripper stands still; it was not opened."
_REASONS = {
    Status.NOT_INITIALIZED: ("WSG-NOT-HOMED", "The gripper does not know where its jaws are"),
    Status.ALREADY_RUNNING: ("WSG-BUSY", "The gripper is still moving"),
    Status.RANGE_ERROR: ("WSG-RANGE", "The gripper cannot go there"),
    Status.INVALID_PARAMETER: ("WSG-RANGE", "The gripper cannot do that"),
    Status.INDEX_OUT_OF_BOUNDS: ("WSG-RANGE", "The gripper cannot do that"),
    Status.AXIS_BLOCKED: ("WSG-BLOCKED", "Something blocks the jaws"),
    Status.CMD_ABORTED: ("WSG-ABORTED", "The gripper broke the motion off"),
    Status.CMD_FAILED: ("WSG-NO-PART", "The jaws met no piece"),
    Status.TIMEOUT: ("WSG-TIMEOUT", "The gripper did not end its motion in time"),
    Status.CHECKSUM_ERROR: ("WSG-FRAME", "The gripper read a damaged command twice"),
}
_STEPS = {
    "WSG-NOT-HOMED": "Take the piece out by hand, then home the gripper.",
    "WSG-NO-PART": "Put the piece between the jaws and grip again.",
    "WSG-BLOCKED": "Look between the jaws, then try again.",
}


def refusal(command: int, status: int, flags: SystemFlag) -> Fault:
    """Return the fault of a command that was answered with ``status``."""
    if status == Status.ACCESS_DENIED and SystemFlag.FAST_STOP in flags:
        return fast_stop_fault()
    name = Command(command).name.lower().replace("_", " ")
    unknown = ("WSG-REFUSED", f"The gripper refuses '{name}' (code {status})")
    code, what = _REASONS.get(Status(status), unknown) if status in _KNOWN else unknown
    return Fault(code, f"{what}.", _STANDS, _STEPS.get(code, "Look at the gripper."), NAME)


_KNOWN = frozenset(int(status) for status in Status)


def fast_stop_fault() -> Fault:
    """Return the fault of a latched fast stop."""
    return Fault(
        "WSG-FAST-STOP",
        "The gripper is in fast stop.",
        "It takes no motion; the grip is as it was.",
        "Look at the piece, then acknowledge the fast stop.",
        NAME,
    )


def device_fault(flags: SystemFlag) -> Fault | None:
    """Return the fault that the system flags tell, None if all is well."""
    for flag, why in DEVICE_FAULTS.items():
        if flag in flags:
            return Fault(
                "WSG-DEVICE",
                f"The gripper reports a fault: {why}.",
                _STANDS,
                "Remove the cause, then acknowledge it.",
                NAME,
            )
    return fast_stop_fault() if SystemFlag.FAST_STOP in flags else None


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "WSG-LINK",
        what,
        "Whether the piece is still held is not known.",
        "Look at the piece; check cable and power of the gripper, then connect it again.",
        NAME,
    )


def stopped_fault() -> Fault:
    """Return the fault of a motion that was stopped."""
    return Fault("STOPPED", "The motion was stopped.", _STANDS, "Look at the bench.", NAME)


def replaced_fault() -> Fault:
    """Return the fault of a motion that another command took the place of."""
    return Fault(
        "REPLACED",
        "Another command took the place of this motion.",
        "The gripper follows the newer command.",
        "Wait for a motion to end before the next command.",
        NAME,
    )


def not_connected_fault() -> Fault:
    """Return the fault of a command to a gripper that is not there."""
    return Fault(
        "NOT-CONNECTED",
        "The gripper is not connected.",
        "Nothing was moved.",
        "Connect it first.",
        NAME,
    )

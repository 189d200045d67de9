"""Faults of the connection to a MELFA controller, in the operator's language."""

from __future__ import annotations

from enum import Enum

from touchdown.backend.core import Fault
from touchdown.backend.devices.melfa import r3_protocol
from touchdown.backend.devices.protocols import HELD, NOTHING_MOVED, VOID_PRESS, arm_fault

START = arm_fault(
    "MXT-START",
    "The controller's program runs, but no real-time reply comes.",
    "Check the address of this computer in the program TDMXT, and the firewall.",
    NOTHING_MOVED,
)

UNLIMITED = arm_fault(
    "MXTTOUT",
    "The controller does not end a real-time stream that falls silent (MXTTOUT is -1).",
    "Set MXTTOUT to 57 in the controller, or allow it with melfa.mxt.allow_unlimited.",
    NOTHING_MOVED,
)

VOID = arm_fault(
    VOID_PRESS,
    "Replies of the controller stayed away for 35 ms during a press.",
    "Press again. If it happens often, look at the load of this computer and at the network.",
    "The arm stood still meanwhile; the episode does not count.",
)


def lost_fault(cycles: int) -> Fault:
    """Return the fault of a stream without replies."""
    return arm_fault(
        "MXT-LOST",
        f"The arm sent no real-time reply for {cycles} cycles.",
        "Check the cable and the load of this computer, press Reset, then connect the arm again.",
        f"The stream was ended. {HELD}",
    )


class Refusal(Enum):
    """Reason why a datagram of the real-time port is not used, and the step for the operator."""

    UNREADABLE = (
        "The data on the real-time port cannot be read.",
        "Check which device or program sends to this computer, and melfa.mxt.port.",
    )
    OTHER_DATA = (
        "The real-time replies carry other data than requested.",
        "Check that the program TDMXT runs in the controller, and no other one.",
    )
    OUT_OF_RANGE = (
        "The real-time replies carry joint angles that no arm can have.",
        "Check melfa.robot_type, and the type of the controller.",
    )


def link_fault(what: str) -> Fault:
    """Return the fault of a missing or lost command channel."""
    return arm_fault(
        "ARM-LINK",
        what,
        "Check cable, address and the controller's port settings, then connect the arm again.",
        "The arm is not commanded.",
    )


def controller_fault(number: int, text: str = "") -> Fault:
    """Return the fault of an error number of the controller."""
    said = f"The controller reports error {number}" + (f": {text}." if text else ".")
    if number in r3_protocol.EMERGENCY_ERRORS:
        step = "Release the emergency stop, press Reset, then connect the arm again."
        return arm_fault("HW-STOP", said, step, "The hardware has stopped the arm.")
    code, step = "CONTROLLER", "Look at the controller, press Reset, then connect the arm again."
    if number in r3_protocol.OUT_OF_RANGE_ERRORS:
        code, step = "OUT-OF-RANGE", "Move the arm back with the teaching box, then press Reset."
    elif number in r3_protocol.NOT_READY_ERRORS:
        code, step = "NOT-READY", "Automatic mode? Remote operation? Servo on? Then connect again."
    elif number in r3_protocol.REJECTED_ERRORS:
        code, step = "REJECTED", "Load the programs of resources/melfa into the controller."
    return arm_fault(code, said, step)


def oversize_fault(cycles: int) -> Fault:
    """Return the fault of a motion with too large steps in several cycles in a row."""
    return arm_fault(
        "STEPS-TOO-LARGE",
        f"A motion asked for steps too large for its speed, {cycles} cycles in a row.",
        "This is an error of the program: keep its log, press Reset, then connect the arm again.",
    )


def starved_fault(gap_s: float, watched_s: float) -> Fault:
    """Return the fault of a computer that is too busy for a stream."""
    return arm_fault(
        "RIG-STARVED",
        f"This computer left the arm without a cycle for {1e3 * gap_s:.0f} ms, watched for "
        f"{watched_s:g} s before the stream was opened.",
        "End what else keeps it busy, or allow real-time priority; then connect the arm again.",
        NOTHING_MOVED,
    )


def other_arm_fault(found: str, wanted: str) -> Fault:
    """Return the fault of another robot type at this address."""
    return arm_fault(
        "OTHER-ARM",
        f"The controller says its arm is {found}, not {wanted}.",
        "Correct the address, or melfa.robot_type in the bench file.",
        NOTHING_MOVED,
    )

"""What can be wrong with a Universal Robots arm, in the operator's words."""

from __future__ import annotations

from backend.core.faults import Fault
from backend.devices.streamed.motion import ARM, HELD, NOTHING_MOVED


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "UR-LINK",
        what,
        "The controller stops the arm by itself; the gripper was not opened.",
        "Check cable, address and remote control of the robot, then connect it again.",
        ARM,
    )


def robot_fault(what: str, code: str = "UR-STOPPED") -> Fault:
    """Return the fault that the robot itself tells of."""
    return Fault(
        code,
        f"{what}.",
        HELD,
        "Clear it at the teach pendant, then connect the arm again.",
        ARM,
    )


def leaning_fault(degrees: float) -> Fault:
    """Return the fault of a hand that does not point straight down."""
    return Fault(
        "TILTED",
        f"The hand leans {degrees:.1f}° away from straight down.",
        NOTHING_MOVED,
        "Point it down with the teach pendant, then connect again.",
        ARM,
    )

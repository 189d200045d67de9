"""A press in progress on the arm, and the faults that its commands end with."""

from __future__ import annotations

from backend.core.faults import Fault, RefusedError
from backend.devices.motion import CommandedMotion

ARM = "arm"
HELD = "The arm stands still; the gripper was not opened."
NOTHING_MOVED = "Nothing was moved."


class ArmPress(CommandedMotion):
    """A press with its contact times on the bench clock."""

    detected_s: float | None = None
    onset_s: float | None = None


STOPPED = Fault(
    "STOPPED", "The motion was stopped.", HELD, "Look at the bench, then press Reset.", ARM
)
REPLACED = Fault(
    "REPLACED",
    "Another command took the place of this motion.",
    "The arm follows the newer command.",
    "Wait for a motion to end before the next command.",
    ARM,
)
NOT_CONNECTED = Fault(
    "NOT-CONNECTED",
    "The device 'arm' is not connected.",
    NOTHING_MOVED,
    "Connect the device first.",
    ARM,
)
NO_WRENCH = Fault(
    "FT-STALE",
    "No force was measured within the last second.",
    NOTHING_MOVED,
    "Check the force/torque sensor, then press again.",
    ARM,
)


def refused_fault(error: RefusedError) -> Fault:
    """Return the fault of a motion whose next command may not go out."""
    return Fault(error.reason, error.detail, HELD, "Choose another way or place.", ARM)

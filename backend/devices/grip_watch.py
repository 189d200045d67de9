"""Tells a piece that is lost from one that is let go (reliability G1).

Jaws that stop holding without an order to open have lost their piece; jaws that move while they
hold are losing it. Either ends motion: no probe of it is recorded and nothing is let go on it.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from backend.core.faults import Fault
from backend.devices.protocols import DeviceState, Gripper

MOVED_MM = 0.3
"""So much the width may change while a piece is held."""
STANDS_S = 0.3
"""After the jaws began to hold they still close on the gels for this long."""


@runtime_checkable
class Ordered(Protocol):
    """A gripper that knows what it was ordered: how often to grip, and whether to let go since."""

    grips: int
    letting_go: bool


class GripWatch:
    """Watches one gripper from the moment at which it holds something."""

    def __init__(self, gripper: Gripper | None = None) -> None:
        self._gripper = gripper
        self._grips = 0
        self._since_s: float | None = None
        self._width_mm = 0.0

    def check(self, now_s: float) -> Fault | None:
        """Return the fault of a piece that is lost, once; None if all is well."""
        gripper = self._gripper
        if gripper is None or gripper.state is not DeviceState.READY:
            self._since_s = None
            return None
        if isinstance(gripper, Ordered):
            if gripper.letting_go or gripper.grips != self._grips:
                # A newer grip may close it further; what is let go may leave.
                self._since_s = None
            self._grips = gripper.grips
            if gripper.letting_go:
                return None
        status = gripper.status()
        if self._since_s is None:
            self._since_s = now_s if status.holding else None
            self._width_mm = status.width_mm
            return None
        if not status.holding:
            self._since_s = None
            return _lost("The gripper holds no piece any more, and nobody opened it.")
        if now_s - self._since_s <= STANDS_S:
            self._width_mm = status.width_mm
            return None
        moved_mm = status.width_mm - self._width_mm
        if not abs(moved_mm) <= MOVED_MM:
            self._since_s = None
            return _lost(f"The jaws moved by {moved_mm:+.1f} mm while they held the piece.")
        return None


def _lost(what: str) -> Fault:
    return Fault(
        "PIECE-LOST",
        what,
        "Motion stopped; the probe in progress is void and nothing was let go.",
        "Take the piece out or grip it again by hand, then press Reset.",
        "gripper",
    )

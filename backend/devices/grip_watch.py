"""Tells a piece that is lost from one that is let go (reliability G1).

Jaws that stop holding without an order to open have lost their piece; jaws that move while they
hold, or whose force falls, are losing it. Each ends motion: no probe of it is recorded and nothing
is let go on it. A width that is no number, or none that jaws can have, is no reading: the last one
holds, and ages.
"""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from backend.core.faults import Fault
from backend.devices.protocols import DeviceState, Gripper

MOVED_MM = 0.3
"""So much the width may change while a piece is held."""
WEAK_SHARE, WEAK_S = 0.5, 0.1
"""A force below this share of the grip's, for so long, holds no more what was measured with it."""
STANDS_S = 0.3
"""After the jaws began to hold they still close on the gels for this long."""
LEAST_MM, MOST_MM = -1.0, 1000.0
"""No jaws have another width."""


@runtime_checkable
class Ordered(Protocol):
    """A gripper that knows what it was ordered: how often to grip, and whether to let go since."""

    grips: int
    letting_go: bool


class GripWatch:
    """Watches one gripper from the moment at which it holds something."""

    def __init__(self, gripper: Gripper | None = None) -> None:
        self._gripper = gripper
        # Asked once: in every step it takes as long as the rest of the watch.
        asked: object = gripper
        self._ordered = asked if isinstance(asked, Ordered) else None
        self._grips = 0
        self._since_s: float | None = None
        self._width_mm = self._force_n = 0.0
        self._weak_s: float | None = None
        self.seen_s = float("-inf")
        """When the gripper last told a width that is one."""

    @property
    def holds(self) -> bool:
        """Whether something was held when it was last seen."""
        return self._since_s is not None

    def check(self, now_s: float) -> Fault | None:
        """Return the fault of a piece that is lost, once; None if all is well."""
        gripper = self._gripper
        if gripper is None:
            return None
        status = gripper.status()
        told = LEAST_MM <= status.width_mm <= MOST_MM
        self.seen_s = now_s if told else self.seen_s
        if gripper.state is not DeviceState.READY:
            self._since_s = None
            return None
        if self._lets_go() or not told:
            return None
        if self._since_s is None:
            self._since_s = now_s if status.holding else None
            self._width_mm = status.width_mm
            return None
        if not status.holding:
            self._since_s = None
            return _lost("The gripper holds no piece any more, and nobody opened it.")
        if now_s - self._since_s <= STANDS_S:
            self._width_mm, self._force_n, self._weak_s = status.width_mm, status.force_n, None
            return None
        if self._weak(status.force_n, now_s):
            self._since_s = None
            return _lost(f"The grip force fell from {self._force_n:.1f} to {status.force_n:.1f} N.")
        moved_mm = status.width_mm - self._width_mm
        if not abs(moved_mm) <= MOVED_MM:
            self._since_s = None
            return _lost(f"The jaws moved by {moved_mm:+.1f} mm while they held the piece.")
        return None

    def _weak(self, force_n: float, now_s: float) -> bool:
        """Whether the grip has been weak for too long; no number is no change."""
        if force_n < WEAK_SHARE * self._force_n:
            self._weak_s = now_s if self._weak_s is None else self._weak_s
        elif force_n >= WEAK_SHARE * self._force_n:
            self._weak_s = None
        return self._weak_s is not None and now_s - self._weak_s >= WEAK_S - 1e-6

    def _lets_go(self) -> bool:
        """Whether what is held may leave now. A newer grip is watched from its own beginning."""
        ordered = self._ordered
        if ordered is None:
            return False
        if ordered.letting_go or ordered.grips != self._grips:
            # A newer grip may close it further; what is let go may leave.
            self._since_s = None
        self._grips = ordered.grips
        return ordered.letting_go


def _lost(what: str) -> Fault:
    return Fault(
        "PIECE-LOST",
        what,
        "Motion stopped; the probe in progress is void and nothing was let go.",
        "Take the piece out or grip it again by hand, then press Reset.",
        "gripper",
    )

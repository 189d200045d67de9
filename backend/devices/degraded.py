"""A device that is late or slow: no fault yet, but nothing new begins on what it says.

It ends by itself when the device delivers again; silence that goes on becomes a fault (reliability
sections 6.1 and 6.3).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from backend.core.faults import Fault, RefusedError

LATE_SHARE = {"force_torque": 1 / 3, "tactile_left": 0.24, "tactile_right": 0.24}
"""Late at this share of the age that is a fault: 100 of 300 ms, pictures 120 of 500 ms."""
GRIP_LATE_S, GRIP_LOST_S = 0.3, 1.0
"""A gripper that holds a piece is late, and a fault, after this long without a reading."""
SLOW_SHARE = 0.5
"""Slow below this share of the usual rate, or of the best that the sensor had so far."""
RATE_WINDOW_S = 1.0
NAMES = {
    "force_torque": "wrist sensor",
    "tactile_left": "left tactile camera",
    "tactile_right": "right tactile camera",
    "gripper": "gripper",
}


@dataclass(frozen=True, slots=True)
class Degraded:
    """``device`` is silent or slow since ``since_s`` of the bench clock."""

    device: str
    how: Literal["silent", "slow"]
    since_s: float

    def what(self, now_s: float) -> str:
        """Say which device, how, and for how long at ``now_s`` of the bench clock."""
        name, for_s = NAMES[self.device], f"{now_s - self.since_s:.1f} s"
        if self.how == "silent":
            return f"The {name} has been silent for {for_s}."
        return f"The {name} has delivered less than half of its samples for {for_s}."


class Rate:
    """Samples per second of a sensor by their own stamps, beside the best it had."""

    def __init__(self) -> None:
        self._best_hz = 0.0
        self._begun_s: float | None = None
        self._count = 0
        self.slow_since_s: float | None = None
        """When the sensor became slow; None while it is not."""

    def begin(self) -> None:
        """Count anew: what came before is of another scene. The best rate is kept."""
        self._begun_s, self._count, self.slow_since_s = None, 0, None

    def note(
        self, newest_s: float, count: int, usual_hz: Callable[[], float] = lambda: 0.0
    ) -> None:
        """Take ``count`` samples, the newest stamped ``newest_s``; judged once a second.

        ``usual_hz``: the rate that the sensor itself tells, 0 where it tells none.
        """
        if self._begun_s is None:
            self._begun_s = newest_s
            return
        self._count += count
        span_s = newest_s - self._begun_s
        if span_s < RATE_WINDOW_S:
            return
        rate_hz = self._count / span_s
        self._best_hz = max(self._best_hz, rate_hz)
        if rate_hz >= SLOW_SHARE * max(self._best_hz, usual_hz()):
            self.slow_since_s = None
        elif self.slow_since_s is None:
            self.slow_since_s = self._begun_s
        self._begun_s, self._count = newest_s, 0


def refuse_degraded(degraded: tuple[Degraded, ...], now_s: float) -> None:
    """Raise ``RefusedError`` while a device is degraded: nothing new begins on it."""
    for one in degraded:
        raise RefusedError("DEGRADED", f"{one.what(now_s)} Start again once it delivers.")


def pause_fault(degraded: Degraded, now_s: float) -> Fault:
    """Return what to say of a run that pauses because of ``degraded``."""
    return Fault(
        "DEGRADED",
        degraded.what(now_s),
        "The run is paused, the arm stands lifted; every probe so far is safe.",
        "Check the device and its cable; resume (P) once the state is no longer DEGRADED.",
        degraded.device,
    )

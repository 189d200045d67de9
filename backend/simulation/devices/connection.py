"""Base of the simulated devices: state, identity, and counts of received samples."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices import CommandedMotion, DeviceState, Health, Identity, replaced_fault

RATE_WINDOW_S = 1.0


class SimDevice:
    """Connection of one device; ``now_s`` is the bench clock."""

    def __init__(self, name: str, model: str, now_s: Callable[[], float]) -> None:
        self.name, self._model, self._now_s = name, model, now_s
        self.state = DeviceState.CLOSED
        self.identity: Identity | None = None  # None before the first connection
        self._received, self._lost, self._recent = 0, 0, 0
        self._newest_s = float("-inf")
        self._arrivals: deque[tuple[float, int]] = deque()
        self._counting, self._lock = threading.Lock(), threading.Lock()
        self._motion: CommandedMotion | None = None

    @property
    def ready(self) -> bool:
        """True if the device is connected."""
        return self.state is DeviceState.READY

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately; no effect if connected."""
        with self._counting:
            if self.ready:
                return
            self.identity = Identity("Touchdown", self._model, f"SIM-{self.name}", "simulated")
            self._received, self._lost, self._recent = 0, 0, 0
            self._newest_s = float("-inf")
            self._arrivals.clear()
            self.state = DeviceState.READY

    def close(self) -> None:
        """Close; no effect if closed."""
        self.state = DeviceState.CLOSED

    def arrived(self, t_s: float, count: int, lost: int = 0) -> None:
        """Count ``count`` samples, the newest stamped ``t_s``, and ``lost`` before them."""
        with self._counting:
            self._received += count
            self._lost += lost
            self._recent += count
            self._newest_s = t_s
            self._arrivals.append((t_s, count))
            self._forget(t_s)

    @property
    def health(self) -> Health:
        """Rate over the last second of bench time, age of the newest sample, counts."""
        now_s = self._now_s()
        with self._counting:
            self._forget(now_s)
            newest_s, recent = self._newest_s, self._recent
            received, lost = self._received, self._lost
        span_s = min(RATE_WINDOW_S, max(now_s, 1e-6))
        return Health(recent / span_s, now_s - newest_s, received, lost)

    def _forget(self, now_s: float) -> None:
        """Remove arrivals older than the rate window."""
        while self._arrivals and self._arrivals[0][0] <= now_s - RATE_WINDOW_S:
            self._recent -= self._arrivals.popleft()[1]

    def _end_motion(self, fault: Fault | None = None) -> None:
        if self._motion is not None:
            self._motion.end(fault)
            self._motion = None

    def _start_motion(self, motion: CommandedMotion) -> CommandedMotion:
        self._end_motion(replaced_fault(self.name))
        self._motion = motion
        return motion

    def require_ready(self) -> None:
        """Raise ``FaultError`` unless connected."""
        if not self.ready:
            raise FaultError(
                Fault(
                    "NOT-CONNECTED",
                    f"The device '{self.name}' is not connected.",
                    "Nothing was moved.",
                    "Connect the device first.",
                    self.name,
                )
            )

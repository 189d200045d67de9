"""Base of the simulated devices: state, identity, and counts of received samples."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

from touchdown.backend import devices
from touchdown.backend.core import Fault, FaultError


class SimDevice:
    """Connection of one device; ``now_s`` is the bench clock."""

    def __init__(self, name: str, model: str, now_s: Callable[[], float]) -> None:
        self.name, self._model, self._now_s = name, model, now_s
        self.state = devices.DeviceState.CLOSED
        self.identity: devices.Identity | None = None  # None before the first connection
        self._arrivals, self._lost = devices.ArrivalCounter(), 0
        self._counting, self._lock = threading.Lock(), threading.Lock()
        self._motion: devices.CommandedMotion | None = None

    @property
    def ready(self) -> bool:
        """True if the device is connected."""
        return self.state is devices.DeviceState.READY

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately; no effect if connected."""
        with self._counting:
            if self.ready:
                return
            self.identity = devices.Identity(
                "Touchdown", self._model, f"SIM-{self.name}", "simulated"
            )
            self._arrivals, self._lost = devices.ArrivalCounter(), 0
            self.state = devices.DeviceState.READY

    def close(self) -> None:
        """Close; no effect if closed."""
        self.state = devices.DeviceState.CLOSED

    def arrived(self, t_s: float, count: int, lost: int = 0) -> None:
        """Count ``count`` samples, the newest stamped ``t_s``, and ``lost`` before them."""
        with self._counting:
            self._arrivals.note(t_s, count)
            self._lost += lost

    @property
    def health(self) -> devices.Health:
        """Rate over the last second of bench time, age of the newest sample, counts."""
        now_s = self._now_s()
        health = self._arrivals.health(now_s, self._lost)
        # Just after the start of the bench clock, the rate is that since the start.
        return replace(health, rate_hz=health.rate_hz / min(1.0, max(now_s, 1e-6)))

    def _end_motion(self, fault: Fault | None = None) -> None:
        if self._motion is not None:
            self._motion.end(fault)
            self._motion = None

    def _start_motion(self, motion: devices.CommandedMotion) -> devices.CommandedMotion:
        self._end_motion(devices.replaced_fault(self.name))
        self._motion = motion
        return motion

    def require_ready(self) -> None:
        """Raise ``FaultError`` unless connected."""
        if not self.ready:
            raise FaultError(devices.not_connected_fault(self.name))

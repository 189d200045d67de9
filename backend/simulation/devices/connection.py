"""Connection of a simulated device: state, identity, and counts of received samples."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices import DeviceState, Health, Identity

RATE_WINDOW_S = 1.0


class SimConnection:
    """State and counts of one device; ``now_s`` is the bench clock."""

    def __init__(self, name: str, model: str, now_s: Callable[[], float]) -> None:
        self.name, self._model, self._now_s = name, model, now_s
        self._state = DeviceState.CLOSED
        self._identity: Identity | None = None
        self._received, self._lost, self._recent = 0, 0, 0
        self._newest_s = float("-inf")
        self._arrivals: deque[tuple[float, int]] = deque()
        self._lock = threading.Lock()

    @property
    def state(self) -> DeviceState:
        """Closed or ready."""
        return self._state

    @property
    def ready(self) -> bool:
        """True if the device is connected."""
        return self._state is DeviceState.READY

    @property
    def identity(self) -> Identity | None:
        """Identity, None before the first connection."""
        return self._identity

    def open(self) -> None:
        """Connect; no effect if connected."""
        with self._lock:
            if self.ready:
                return
            self._identity = Identity("Touchdown", self._model, f"SIM-{self.name}", "simulated")
            self._received, self._lost, self._recent = 0, 0, 0
            self._newest_s = float("-inf")
            self._arrivals.clear()
            self._state = DeviceState.READY

    def close(self) -> None:
        """Close; no effect if closed."""
        self._state = DeviceState.CLOSED

    def arrived(self, t_s: float, count: int, lost: int = 0) -> None:
        """Count ``count`` samples, the newest stamped ``t_s``, and ``lost`` before them."""
        with self._lock:
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
        with self._lock:
            self._forget(now_s)
            newest_s, recent = self._newest_s, self._recent
            received, lost = self._received, self._lost
        span_s = min(RATE_WINDOW_S, max(now_s, 1e-6))
        return Health(recent / span_s, now_s - newest_s, received, lost)

    def _forget(self, now_s: float) -> None:
        """Remove arrivals older than the rate window."""
        while self._arrivals and self._arrivals[0][0] <= now_s - RATE_WINDOW_S:
            self._recent -= self._arrivals.popleft()[1]

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


class SimDevice:
    """Common base of the simulated devices."""

    def __init__(self, connection: SimConnection) -> None:
        self._connection = connection

    @property
    def name(self) -> str:
        """Name of the device."""
        return self._connection.name

    @property
    def state(self) -> DeviceState:
        """State of the connection."""
        return self._connection.state

    @property
    def identity(self) -> Identity | None:
        """Identity, None before the first connection."""
        return self._connection.identity

    @property
    def health(self) -> Health:
        """Rate, age and losses of the samples."""
        return self._connection.health

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect immediately."""
        self._connection.open()

    def close(self) -> None:
        """Close."""
        self._connection.close()

"""One monotonic clock for the whole bench, and the hand-wound one of the simulation."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """Seconds that never go back."""

    def now_s(self) -> float:
        """Return the present time in s."""


class MonotonicClock:
    """The computer's own monotonic clock."""

    def now_s(self) -> float:
        """Return seconds of ``time.monotonic``."""
        return time.monotonic()


class BenchClock:
    """The wall's time since the bench was made, and waiting on it without drifting away."""

    def __init__(self) -> None:
        self._never = threading.Event()
        self._begun_s = time.monotonic()
        self._due_s = 0.0

    def now_s(self) -> float:
        """Return the present time in s."""
        return time.monotonic() - self._begun_s

    def wait(self, step_us: int) -> None:
        """Wait until a step after the last one; what came too late is not made up."""
        now_s = self.now_s()
        self._due_s = max(self._due_s + 1e-6 * step_us, now_s)
        self._never.wait(self._due_s - now_s)


class HandClock:
    """A clock that moves only when it is wound, in whole microseconds (exactly repeatable)."""

    def __init__(self) -> None:
        self._now_us = 0

    @property
    def now_us(self) -> int:
        """Present time in whole microseconds."""
        return self._now_us

    def now_s(self) -> float:
        """Return the present time in s."""
        return self._now_us * 1e-6

    def wind(self, step_us: int) -> None:
        """Move forward by ``step_us`` microseconds; raises ValueError if negative."""
        if step_us < 0:
            raise ValueError("a clock is never wound back")
        self._now_us += step_us

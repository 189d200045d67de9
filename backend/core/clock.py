"""Clocks of the bench: monotonic, paced by the wall clock, or advanced by hand in simulation."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Protocol


class Clock(Protocol):
    """A clock whose time never decreases."""

    def now_s(self) -> float:
        """Return the present time in s."""


class MonotonicClock:
    """Clock of ``time.monotonic``."""

    def now_s(self) -> float:
        """Return seconds of ``time.monotonic``."""
        return time.monotonic()


class BenchClock:
    """Time since construction, with periodic waits that do not accumulate drift."""

    def __init__(self) -> None:
        self._never = threading.Event()
        self._begun_s = time.monotonic()
        self._due_s = 0.0

    def now_s(self) -> float:
        """Return the present time in s."""
        return time.monotonic() - self._begun_s

    def wait(self, step_us: int) -> None:
        """Wait until one step after the last deadline; a missed deadline is not made up."""
        now_s = self.now_s()
        self._due_s = max(self._due_s + 1e-6 * step_us, now_s)
        self._never.wait(self._due_s - now_s)


class ClockJumpDetector:
    """Detects a changed wall clock, or a suspended computer, against a monotonic clock."""

    LEAST_S = 1.0
    SLEW = 1e-3  # clock corrections slower than this share of the elapsed time are normal

    def __init__(
        self,
        # time.time is looked up at each call, so that a test can replace it.
        wall_s: Callable[[], float] = lambda: time.time(),
        steady_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._wall_s, self._steady_s = wall_s, steady_s
        self._seen = self._wall_s(), self._steady_s()

    def jump_s(self) -> float:
        """Return the jump of the wall clock since the last call, s; 0.0 within normal slew."""
        wall_s, steady_s = self._wall_s(), self._steady_s()
        gone_s = steady_s - self._seen[1]
        ahead_s = wall_s - self._seen[0] - gone_s
        self._seen = wall_s, steady_s
        return ahead_s if abs(ahead_s) > self.LEAST_S + self.SLEW * gone_s else 0.0


class ManualClock:
    """A clock advanced by hand in whole microseconds (exactly repeatable)."""

    def __init__(self) -> None:
        self._now_us = 0

    @property
    def now_us(self) -> int:
        """Present time in whole microseconds."""
        return self._now_us

    def now_s(self) -> float:
        """Return the present time in s."""
        return self._now_us * 1e-6

    def advance(self, step_us: int) -> None:
        """Advance by ``step_us`` microseconds; raises ValueError if negative."""
        if step_us < 0:
            raise ValueError("a clock cannot go back")
        self._now_us += step_us

"""How long somebody looked at one episode; a pause is not looking."""

from __future__ import annotations

import time
from collections.abc import Callable

PAUSE_S = 60.0


class LookClock:
    """Adds up the time between signs of life; gaps longer than a minute count nothing."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._last_s, self._seen_s = now_s(), 0.0

    def restart(self) -> None:
        """Another episode is shown."""
        self._last_s, self._seen_s = self._now_s(), 0.0

    def alive(self) -> None:
        """Take note of a key or a click."""
        now_s = self._now_s()
        if now_s - self._last_s <= PAUSE_S:
            self._seen_s += now_s - self._last_s
        self._last_s = now_s

    def seen_ms(self) -> int:
        """Return the time spent on this episode."""
        self.alive()
        return round(1e3 * self._seen_s)

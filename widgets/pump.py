"""The only door from other threads to Qt: one timer that pulls, with a time budget per tick."""

from __future__ import annotations

import time
from collections.abc import Callable

from PySide6.QtCore import QObject, Qt, QTimer

PERIOD_MS = 32
"""Slightly above 30 Hz, so that a late tick now and then still leaves 30 pictures a second."""
BUDGET_S = 0.008


class Pump:
    """Calls ``pull`` for facts until there is none, then each view's ``draw``, every 32 ms.

    ``pull`` handles one fact and returns False when there was none; the budget is checked after
    every single fact, so a burst is spread over ticks and the window stays alive. Views are drawn
    in turn; one that no longer fits into the budget is first in the next tick.
    """

    def __init__(
        self,
        parent: QObject,
        pull: Callable[[], bool],
        *,
        now_s: Callable[[], float] = time.perf_counter,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._pull, self._now_s, self._budget_s = pull, now_s, budget_s
        self._draws: list[Callable[[], None]] = []
        self._next = 0
        self.ticks = 0
        self._timer = QTimer(parent)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.setInterval(PERIOD_MS)
        self._timer.timeout.connect(self.tick)

    def add(self, draw: Callable[[], None]) -> None:
        """Draw this view on every tick that has time for it."""
        self._draws.append(draw)

    def start(self) -> None:
        """Begin to tick."""
        self._timer.start()

    def stop(self) -> None:
        """End ticking; what waits stays where it is."""
        self._timer.stop()

    def tick(self) -> None:
        """Run one tick now."""
        self.ticks += 1
        deadline = self._now_s() + self._budget_s
        while self._pull() and self._now_s() < deadline:
            pass
        for _ in range(len(self._draws)):
            draw = self._draws[self._next]
            self._next = (self._next + 1) % len(self._draws)
            draw()
            if self._now_s() >= deadline:
                break

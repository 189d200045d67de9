"""The only door from other threads to Qt: one timer that pulls, with a time budget per tick."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable

from PySide6.QtCore import QObject, Qt, QTimer

TURNS = 2
"""What is drawn in one tick Qt paints in one go, and nothing else happens meanwhile: half the views
at a time keep the window waiting half as long."""
PERIOD_MS = 32 // TURNS
"""Each view slightly above 30 Hz: a late tick now and then still leaves 30 pictures a second."""
BUDGET_S = 0.008


class Pump:
    """Calls ``pull`` for facts until there is none, then ``draw`` of half the views, every 16 ms.

    ``pull`` handles one fact and returns False when there was none; the budget is checked after
    every single fact, so a burst is spread over ticks and the window stays alive. A view that no
    longer fits into the budget is the first of its half next time.
    """

    def __init__(
        self,
        parent: QObject,
        pull: Callable[[], bool],
        *,
        hold: Callable[[], bool] = lambda: False,
        now_s: Callable[[], float] = time.perf_counter,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._pull, self._hold = pull, hold
        self._now_s, self._budget_s = now_s, budget_s
        self._turns: tuple[deque[Callable[[], None]], ...] = tuple(deque() for _ in range(TURNS))
        self.ticks = 0
        self._timer = QTimer(parent)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.setInterval(PERIOD_MS)
        self._timer.timeout.connect(self.tick)

    def add(self, draw: Callable[[], None]) -> None:
        """Draw this view on every other tick; neighbours take turns."""
        min(self._turns, key=len).append(draw)

    def start(self) -> None:
        """Begin to tick."""
        self._timer.start()

    def stop(self) -> None:
        """End ticking; what waits stays where it is."""
        self._timer.stop()

    def tick(self) -> None:
        """Run one tick now; nothing is done while ``hold`` asks for quiet."""
        if self._hold():
            return
        views = self._turns[self.ticks % TURNS]
        self.ticks += 1
        deadline = self._now_s() + self._budget_s
        while self._pull() and self._now_s() < deadline:
            pass
        for _ in range(len(views)):
            draw = views[0]
            views.rotate(-1)
            draw()
            if self._now_s() >= deadline:
                break

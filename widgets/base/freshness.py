"""Age of the values on display."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from enum import Enum

from PySide6.QtCore import QObject, Qt, QTimer
from PySide6.QtWidgets import QScrollArea, QWidget

STALE_AFTER_S = 0.2
GONE_AFTER_S = 2.0


class Age(Enum):
    """How far a picture may be trusted."""

    NEVER = "never"
    FRESH = "fresh"
    STALE = "stale"
    GONE = "gone"


class Freshness:
    """Watches a sequence number. A producer that hangs cannot claim to be alive."""

    def __init__(self) -> None:
        self._count: int | None = None
        self._changed_s = 0.0

    def note(self, count: int, now_s: float) -> bool:
        """Take the producer's present count; return whether it changed since the last call."""
        if count == 0 or count == self._count:
            return False
        self._count, self._changed_s = count, now_s
        return True

    def age_s(self, now_s: float) -> float:
        """Seconds since the count last changed (infinite if it never did)."""
        return now_s - self._changed_s if self._count is not None else float("inf")

    def judge(self, now_s: float) -> Age:
        """Fresh up to 0.2 s, stale up to 2 s, then gone."""
        if self._count is None:
            return Age.NEVER
        age_s = self.age_s(now_s)
        if age_s <= STALE_AFTER_S:
            return Age.FRESH
        return Age.STALE if age_s <= GONE_AFTER_S else Age.GONE


def scroll_into_view(widget: QWidget) -> None:
    """Scroll the page to ``widget``, once it has got its place."""

    def scroll() -> None:
        ancestor = widget.parentWidget()
        while ancestor is not None and not isinstance(ancestor, QScrollArea):
            ancestor = ancestor.parentWidget()
        if ancestor is not None and widget.isVisible():
            ancestor.ensureWidgetVisible(widget)

    QTimer.singleShot(0, widget, scroll)


TURNS = 2
"""What is drawn in one tick Qt paints in one go, and nothing else happens meanwhile: half the views
at a time keep the window waiting half as long."""
PERIOD_MS = 32 // TURNS
"""Each view slightly above 30 Hz: a late tick now and then still leaves 30 pictures a second."""
BUDGET_S = 0.008


class EventPump:
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

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
    """Freshness of a displayed value."""

    NEVER = "never"
    FRESH = "fresh"
    STALE = "stale"
    GONE = "gone"


class Freshness:
    """Age of a stream, judged by its sequence number: a stalled producer counts as old."""

    def __init__(self) -> None:
        self._count: int | None = None
        self._changed_s = 0.0

    def note(self, count: int, now_s: float) -> bool:
        """Record the present sequence number; return True if it changed since the last call."""
        if count == 0 or count == self._count:
            return False
        self._count, self._changed_s = count, now_s
        return True

    def age_s(self, now_s: float) -> float:
        """Return the seconds since the number last changed, infinite if it never did."""
        return now_s - self._changed_s if self._count is not None else float("inf")

    def judge(self, now_s: float) -> Age:
        """Return the age class: fresh up to 0.2 s, stale up to 2 s, then gone."""
        if self._count is None:
            return Age.NEVER
        age_s = self.age_s(now_s)
        if age_s <= STALE_AFTER_S:
            return Age.FRESH
        return Age.STALE if age_s <= GONE_AFTER_S else Age.GONE


def scroll_into_view(widget: QWidget) -> None:
    """Scroll the page to ``widget`` after the pending layout."""

    def scroll() -> None:
        ancestor = widget.parentWidget()
        while ancestor is not None and not isinstance(ancestor, QScrollArea):
            ancestor = ancestor.parentWidget()
        if ancestor is not None and widget.isVisible():
            ancestor.ensureWidgetVisible(widget)

    QTimer.singleShot(0, widget, scroll)


# Qt paints everything drawn in one tick in one go. Half of the views per tick halve that pause.
TURNS = 2
PERIOD_MS = 32 // TURNS  # each view at slightly above 30 Hz; a late tick leaves 30 frames/s
BUDGET_S = 0.008
CALM_PERIOD_MS = 125  # while nothing moves: all views at 8 Hz
HIDDEN_PERIOD_MS, HIDDEN_BUDGET_S = 100, 0.05  # of a minimised window, which draws nothing


class EventPump:
    """Timer of 16 ms that handles queued events and then redraws half of the views.

    ``pull`` handles one event and returns False if there was none. The time budget is checked after
    every event, so that a burst is spread over several ticks. A view that exceeds the budget is
    drawn first at the next turn of its half. While ``calm`` returns True all views are drawn every
    125 ms. While ``hidden`` returns True nothing is drawn, and events are handled every 100 ms.
    """

    def __init__(
        self,
        parent: QObject,
        pull: Callable[[], bool],
        *,
        hold: Callable[[], bool] = lambda: False,
        hidden: Callable[[], bool] = lambda: False,
        now_s: Callable[[], float] = time.perf_counter,
        budget_s: float = BUDGET_S,
    ) -> None:
        self._pull, self._hold, self._hidden = pull, hold, hidden
        self.calm: Callable[[], bool] = lambda: False
        self._now_s, self._budget_s = now_s, budget_s
        self._turns: tuple[deque[Callable[[], None]], ...] = tuple(deque() for _ in range(TURNS))
        self.ticks = 0
        self._timer = QTimer(parent, timerType=Qt.TimerType.PreciseTimer, interval=PERIOD_MS)
        self._timer.timeout.connect(self.tick)

    def add(self, draw: Callable[[], None]) -> None:
        """Register a view; it is drawn on every other tick."""
        min(self._turns, key=len).append(draw)

    def start(self) -> None:
        """Start the timer."""
        self._timer.start()

    def stop(self) -> None:
        """Stop the timer; queued events stay queued."""
        self._timer.stop()

    def tick(self) -> None:
        """Run one tick; does nothing while ``hold`` returns True."""
        if self._hold():
            return
        hidden = self._hidden()
        calm = not hidden and self.calm()
        period_ms = HIDDEN_PERIOD_MS if hidden else CALM_PERIOD_MS if calm else PERIOD_MS
        if self._timer.interval() != period_ms:
            self._timer.setInterval(period_ms)
        halves = self._turns if calm else () if hidden else (self._turns[self.ticks % TURNS],)
        self.ticks += 1
        budget_s = self._budget_s * (TURNS if calm else 1)
        deadline = self._now_s() + (HIDDEN_BUDGET_S if hidden else budget_s)
        while self._pull() and self._now_s() < deadline:
            pass
        for views in halves:
            for _ in range(len(views)):
                draw = views[0]
                views.rotate(-1)
                draw()
                if self._now_s() >= deadline:
                    return

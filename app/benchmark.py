"""Benchmark of the window: frame times and memory of a live run."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import numpy as np
import psutil
from PySide6.QtCore import QObject, Qt, QTimer

from touchdown.app.application import TouchdownApp
from touchdown.app.stack import StackWorkspace
from touchdown.backend.core import ActionChosen, Event
from touchdown.backend.runs import StackRequest

HEARTBEAT_MS = 10
# More trials than any measurement lasts, so that trial changes are part of the load.
TRIALS, FIRST_SEED = 500, 100


class Measurement(QObject):
    """Waits for the bench, starts a long run, measures for ``seconds``, reports and quits."""

    def __init__(
        self, main: TouchdownApp, seconds: float, report: Callable[[dict[str, float]], None]
    ) -> None:
        super().__init__(main)
        self._main, self._seconds, self._report = main, seconds, report
        self._lags_ms: list[float] = []
        self._latencies_ms: list[float] = []
        self._due_s = 0.0
        self._timer = QTimer(self)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self._wait)
        self._timer.start(HEARTBEAT_MS)
        self._warm_s = 0.0

    def _wait(self) -> None:
        """Start the measurement two seconds after the run has begun."""
        cards = self._main.cards
        if self._main.bench is None and cards.codes:
            text = cards.card(cards.codes[0]).text
            sys.stderr.write(f"touchdown: {text.what} {text.next_step}\n")
            self._timer.stop()
            self._main.quit_at_once(1)
        if self._main.bench is None:
            return
        if self._warm_s == 0.0:
            self._main.bench.events.subscribe(self._take)
            self._main.bench.start(StackRequest(trials=TRIALS, seed=FIRST_SEED))
            self._warm_s = time.perf_counter() + 2.0
        if time.perf_counter() < self._warm_s:
            return
        self._timer.timeout.disconnect(self._wait)
        self._timer.timeout.connect(self._beat)
        self._start_s = self._due_s = time.perf_counter()
        self._thread_s, self._process = time.thread_time(), psutil.Process()
        self._process_s = sum(self._process.cpu_times()[:2])
        self._counts = self._paints()

    def _take(self, event: Event) -> None:
        """Record a decision. Runs on the thread of the bench, so it only appends."""
        if isinstance(event, ActionChosen):
            self._latencies_ms.append(event.latency_ms)

    def _beat(self) -> None:
        now_s = time.perf_counter()
        self._due_s += HEARTBEAT_MS * 1e-3
        self._lags_ms.append(max(0.0, 1e3 * (now_s - self._due_s)))
        if now_s > self._due_s:
            self._due_s = now_s
        if now_s - self._start_s >= self._seconds:
            self._timer.stop()
            self._finish(now_s - self._start_s)

    def _paints(self) -> tuple[int, int, int]:
        stack = self._main.workspaces["stack"]
        assert isinstance(stack, StackWorkspace)
        assert stack.live is not None
        shown = stack.live.frames_shown
        return shown["left"], shown["right"], stack.page.force.paints

    def _finish(self, wall_s: float) -> None:
        left, right, traces = (
            (after - before) / wall_s
            for after, before in zip(self._paints(), self._counts, strict=True)
        )
        lags = np.array(self._lags_ms)
        thread = time.thread_time() - self._thread_s
        process = sum(self._process.cpu_times()[:2]) - self._process_s
        self._report(
            {
                "seconds": round(wall_s, 2),
                "window_cpu_percent": round(100 * thread / wall_s, 1),
                "process_cpu_percent": round(100 * process / wall_s, 1),
                "tactile_left_fps": round(left, 1),
                "tactile_right_fps": round(right, 1),
                "traces_fps": round(traces, 1),
                "lag_p50_ms": round(float(np.percentile(lags, 50)), 2),
                "lag_p99_ms": round(float(np.percentile(lags, 99)), 2),
                "lag_max_ms": round(float(lags.max()), 2),
                **_decisions(self._latencies_ms),
                "memory_mb": round(self._process.memory_info().rss / 1e6, 1),
                "pace": round(self._main.pace, 3),
            }
        )
        self._main.quit_at_once()


def _decisions(latencies_ms: list[float]) -> dict[str, float]:
    """Return count, median, 99th percentile and maximum; only the count if there were none."""
    if not latencies_ms:
        return {"decisions": 0}
    p50, p99 = np.percentile(latencies_ms, [50, 99])
    return {
        "decisions": len(latencies_ms),
        "decision_p50_ms": round(float(p50), 2),
        "decision_p99_ms": round(float(p99), 2),
        "decision_max_ms": round(max(latencies_ms), 2),
    }

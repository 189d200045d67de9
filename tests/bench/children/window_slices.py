"""A real window with a run on the simulated bench, measured slice by slice. Wall time.

The window lives in an event loop as it does in use. A fault lasts for whole slices; the slices
beside it are the same window without the fault.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from PySide6.QtCore import QEventLoop, Qt, QTimer

from tests.bench.children.failing_window import LIMIT_S, Watched
from touchdown.app.stack.workspace import StackWorkspace
from touchdown.backend.runs.requests import StackRequest

TICK_MS = 10
TRIALS, SEED = 500, 100  # more trials than any measurement needs
SIZE = (1600, 940)
WARM_UP_S, LOOK_S = 3.0, 0.02
RATES = ("left_fps", "right_fps", "traces_fps")


@dataclass(frozen=True, slots=True)
class Slice:
    """One stretch of time: pictures a second, share of a core (window's thread), longest gap."""

    left_fps: float
    right_fps: float
    traces_fps: float
    core_percent: float
    gap_ms: float


class Sliced(Watched):
    """A window on its Stack page; ``slice_of`` lets it live and says what that took."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.main.window.resize(*SIZE)
        self.session = self.bench()
        self._last_s = self._gap_s = math.nan
        self._timer = QTimer(self.main.window)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self._tick)
        self._timer.start(TICK_MS)

    def stack(self) -> None:
        """Let a run go on, in sight, for longer than anything is measured."""
        self.main.go("stack")
        self.session.start(StackRequest(trials=TRIALS, seed=SEED))
        self.live_for(WARM_UP_S)

    def live_for(self, for_s: float) -> None:
        """Live for so long."""
        loop = QEventLoop()
        QTimer.singleShot(round(1e3 * for_s), loop.quit)
        loop.exec()

    def pump(self, there: Callable[[], bool]) -> float:
        """Live until ``there`` as in use, without asking all the time; return how long it took."""
        begun_s = time.monotonic()
        while not there():
            self.live_for(LOOK_S)
            if time.monotonic() - begun_s > LIMIT_S:
                raise TimeoutError(f"nothing after {LIMIT_S:g} s; cards {self.main.cards.codes}")
        return time.monotonic() - begun_s

    def slice_of(self, for_s: float) -> Slice:
        """Live for so long; return what was shown meanwhile, and what it took."""
        before, thread_s, begun_s = self._shown(), time.thread_time(), time.monotonic()
        self._last_s, self._gap_s = begun_s, 0.0
        self.live_for(for_s)
        self._tick()
        took_s = time.monotonic() - begun_s
        left, right, traces = (self._shown() - before) / took_s
        percent = 100.0 * (time.thread_time() - thread_s) / took_s
        return Slice(left, right, traces, percent, 1e3 * self._gap_s)

    def _tick(self) -> None:
        now_s = time.monotonic()
        self._gap_s = max(self._gap_s, now_s - self._last_s)
        self._last_s = now_s

    def _shown(self) -> np.ndarray:
        stack = self.main.workspaces["stack"]
        assert isinstance(stack, StackWorkspace)
        assert stack.live is not None
        shown = stack.live.frames_shown
        return np.array([shown["left"], shown["right"], stack.page.force.paints], np.float64)


def together(slices: Sequence[Slice]) -> Mapping[str, float]:
    """Return the mean of slices of one length, and of their longest gaps the longest."""
    rows = [asdict(one) for one in slices]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return means | {"gap_ms": max(row["gap_ms"] for row in rows)}

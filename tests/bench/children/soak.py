"""Child of the soak figure: the window beside a stepped bench for many simulated minutes.

Runs follow each other, pages are turned, pictures are painted as often as the window's own timer
has it. Prints one JSON object: the slope of the memory after the warm-up, the pictures a simulated
second on the Stack page, and what was left behind at the end.
"""

from __future__ import annotations

import argparse
import gc
import json
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QApplication
from shiboken6 import isValid

from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.stack.workspace import StackWorkspace
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.bench.session import STEP_US, Session
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import RunState, SceneChoice, StackRequest
from touchdown.widgets.base.freshness import PERIOD_MS

STEP_S = 1e-6 * STEP_US
TICKS_A_STEP = 1e3 * STEP_S / PERIOD_MS
PAGE_S, SAMPLE_S = 10.0, 10.0  # time per page; interval of the memory samples
WARM_UP = 0.2  # share of the minutes in which caches may still fill


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=30.0)
    args = parser.parse_args(argv)
    application = QApplication([])
    with tempfile.TemporaryDirectory() as folder:
        threads = set(threading.enumerate())
        figures = _soak(application, Path(folder), args.minutes)
        figures["threads_left"] = len(set(threading.enumerate()) - threads)
        figures["timers_left"] = _active_timers()
    sys.stdout.write(json.dumps(figures) + "\n")
    return 0


def _soak(application: QApplication, folder: Path, minutes: float) -> dict[str, float]:
    session = simulated_session(keep=RecordingOptions(folder / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None  # type: ignore[method-assign]
    main = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
    main.window.resize(1600, 940)
    main.window.show()
    main.attach(session)
    pictures = _Pictures(main)
    memory, begun_s, seed = [], time.monotonic(), 100
    for step in range(round(60 * minutes / STEP_S)):
        if session.status().state is RunState.IDLE:
            main.reset()
            session.start(StackRequest(trials=20, seed=seed))
            seed += 20
        _step(main, session, step, pictures)
        if step % round(SAMPLE_S / STEP_S) == 0:
            gc.collect()
            memory.append(psutil.Process().memory_info().rss / 1e6)
            sys.stderr.write(f"minute {step * STEP_S / 60.0:.1f}: {memory[-1]:.1f} MB\n")
    wall_s = time.monotonic() - begun_s
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    application.sendPostedEvents(None, 0)
    application.processEvents()
    first = round(WARM_UP * len(memory))
    at_min = np.arange(first, len(memory)) * SAMPLE_S / 60.0
    slope = np.polyfit(at_min, memory[first:], 1)[0] if len(at_min) > 1 else float("nan")
    return {
        "minutes": minutes,
        "slope_mb_per_min": round(float(slope), 3),
        "memory_mb": round(memory[-1], 1),
        "wall_s": round(wall_s, 1),
        "runs": (seed - 100) // 20,
        **pictures.a_second(),
    }


class _Pictures:
    """Counts what is painted on the Stack page while it is in front."""

    def __init__(self, main: TouchdownApp) -> None:
        stack = main.workspaces["stack"]
        assert isinstance(stack, StackWorkspace)
        assert stack.live is not None
        self._live, self._force = stack.live, stack.page.force
        self._begun = self._counts()
        self._in_front, self._steps = False, 0
        self._shown = np.zeros(3)

    def turn(self, *, stack_in_front: bool) -> None:
        """Note that another page is turned to."""
        counts = self._counts()
        if self._in_front:
            self._shown += counts - self._begun
        self._begun, self._in_front = counts, stack_in_front

    def step(self) -> None:
        self._steps += self._in_front

    def a_second(self) -> dict[str, float]:
        self.turn(stack_in_front=False)
        names = ("tactile_left_fps", "tactile_right_fps", "traces_fps")
        rates = self._shown / max(self._steps * STEP_S, STEP_S)
        return {name: round(float(rate), 1) for name, rate in zip(names, rates, strict=True)}

    def _counts(self) -> np.ndarray:
        shown = self._live.frames_shown
        return np.array([shown["left"], shown["right"], self._force.paints], dtype=np.float64)


def _step(main: TouchdownApp, session: Session, step: int, pictures: _Pictures) -> None:
    session.engine.tick()
    session.advance()
    if step % round(PAGE_S / STEP_S) == 0:
        names = list(main.workspaces)
        name = names[step // round(PAGE_S / STEP_S) % len(names)]
        main.go(name)
        pictures.turn(stack_in_front=name == "stack")
    pictures.step()
    for _ in range(int((step + 1) * TICKS_A_STEP) - int(step * TICKS_A_STEP)):
        main.pump.tick()
        QApplication.processEvents()


def _active_timers() -> int:
    gc.collect()
    found = [item for item in gc.get_objects() if isinstance(item, QTimer)]
    return sum(isValid(timer) and timer.isActive() for timer in found)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""Child of the soak figure: the window beside a stepped bench for so many simulated minutes.

Everything is live: runs follow each other, pages are turned, pictures are painted. Prints one JSON
object: the slope of the memory after the warm-up, and what was left behind at the end.
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

from app.application import TouchdownApp
from app.error_hooks import ErrorBox
from backend.assembly import simulated_session
from backend.runs.requests import RunState, SceneChoice, StackRequest
from backend.session import STEP_US, Keep, Session

STEP_S = 1e-6 * STEP_US
PAGE_S, TICK_STEPS = 10.0, 2
"""A page stays so long; the window draws on every second step, 25 times a second."""
WARM_UP = 0.2
"""Share of the minutes in which caches may still fill."""


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
    session = simulated_session(keep=Keep(folder / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None  # type: ignore[method-assign]
    main = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
    main.window.resize(1600, 940)
    main.window.show()
    main.attach(session)
    memory, begun_s, seed = [], time.monotonic(), 100
    steps = round(60 * minutes / STEP_S)
    for step in range(steps):
        if session.status().state is RunState.IDLE:
            main.reset()
            session.start(StackRequest(trials=20, seed=seed))
            seed += 20
        _step(main, session, step)
        if step % round(60 / STEP_S) == 0:
            gc.collect()
            memory.append(psutil.Process().memory_info().rss / 1e6)
            sys.stderr.write(f"minute {len(memory) - 1}: {memory[-1]:.1f} MB\n")
    wall_s = time.monotonic() - begun_s
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    application.sendPostedEvents(None, 0)
    application.processEvents()
    first = round(WARM_UP * len(memory))
    slope = np.polyfit(np.arange(first, len(memory)), memory[first:], 1)[0]
    return {
        "minutes": minutes,
        "slope_mb_per_min": round(float(slope), 3),
        "memory_mb": round(memory[-1], 1),
        "wall_s": round(wall_s, 1),
        "runs": (seed - 100) // 20,
    }


def _step(main: TouchdownApp, session: Session, step: int) -> None:
    session.engine.tick()
    session.advance()
    if step % round(PAGE_S / STEP_S) == 0:
        names = list(main.workspaces)
        main.go(names[step // round(PAGE_S / STEP_S) % len(names)])
    if step % TICK_STEPS == 0:
        main.pump.tick()
        QApplication.processEvents()


def _active_timers() -> int:
    gc.collect()
    found = [item for item in gc.get_objects() if isinstance(item, QTimer)]
    return sum(isValid(timer) and timer.isActive() for timer in found)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

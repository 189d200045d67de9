"""Child that measures a window beside a simulated bench: ``python -m`` it ``soak`` or ``start``.

``soak``: many simulated minutes on a stepped bench, with all pages in turn. ``start``: from the
command to live pictures, then again in the same process with every module imported. Prints one JSON
object.
"""

import gc
import json
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np
import psutil
from PySide6.QtCore import QDeadlineTimer, QEventLoop, QTimer
from PySide6.QtWidgets import QApplication
from shiboken6 import isValid

from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.stack.workspace import StackWorkspace
from touchdown.app.start import open_simulated_bench
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.bench.session import STEP_US, Session
from touchdown.backend.runs import RecordingOptions, RunState, SceneChoice, StackRequest
from touchdown.widgets.base.freshness import PERIOD_MS

STEP_S, MINUTES = 1e-6 * STEP_US, 30.0
TICKS_A_STEP = 1e3 * STEP_S / PERIOD_MS
PAGE_S, SAMPLE_S = 10.0, 10.0  # time per page; interval of the memory samples
WARM_UP = 0.2  # share of the minutes in which caches may still fill
START_MS = 60_000


def _window(application: QApplication, folder: Path) -> TouchdownApp:
    return TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")


def _close(application: QApplication, main: TouchdownApp) -> None:
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    application.sendPostedEvents(None, 0)
    application.processEvents()


def soak(application: QApplication, folder: Path) -> dict[str, float]:
    """Return the memory slope after the warm-up, frame rates, and what is left at the end."""
    threads = set(threading.enumerate())
    session = simulated_session(keep=RecordingOptions(folder / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None  # type: ignore[method-assign]
    main = _window(application, folder)
    main.window.resize(1600, 940)
    main.window.show()
    main.attach(session)
    pictures = _Pictures(main)
    memory, begun_s, seed = [], time.monotonic(), 100
    for step in range(round(60 * MINUTES / STEP_S)):
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
    _close(application, main)
    first = round(WARM_UP * len(memory))
    at_min = np.arange(first, len(memory)) * SAMPLE_S / 60.0
    return {
        "slope_mb_per_min": float(np.polyfit(at_min, memory[first:], 1)[0]),
        "memory_mb": memory[-1],
        "wall_s": wall_s,
        **pictures.per_second(),
        "threads_left": len(set(threading.enumerate()) - threads),
        "timers_left": _active_timers(),
    }


class _Pictures:
    """Counts what is painted on the Stack page while it is in front."""

    def __init__(self, main: TouchdownApp) -> None:
        stack = main.workspaces["stack"]
        assert isinstance(stack, StackWorkspace)
        assert stack.live is not None
        self._live, self._force = stack.live, stack.page.force
        self._begun, self._shown = self._counts(), np.zeros(3)
        self.in_front, self.steps = False, 0

    def turn(self, *, stack_in_front: bool) -> None:
        counts = self._counts()
        if self.in_front:
            self._shown += counts - self._begun
        self._begun, self.in_front = counts, stack_in_front

    def per_second(self) -> dict[str, float]:
        self.turn(stack_in_front=False)
        names = ("tactile_left_fps", "tactile_right_fps", "traces_fps")
        rates = self._shown / max(self.steps * STEP_S, STEP_S)
        return {name: float(rate) for name, rate in zip(names, rates, strict=True)}

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
    pictures.steps += pictures.in_front
    for _ in range(int((step + 1) * TICKS_A_STEP) - int(step * TICKS_A_STEP)):
        main.pump.tick()
        QApplication.processEvents()


def _active_timers() -> int:
    gc.collect()
    found = [item for item in gc.get_objects() if isinstance(item, QTimer)]
    return sum(isValid(timer) and timer.isActive() for timer in found)


def start(application: QApplication, folder: Path) -> dict[str, float]:
    """Return the seconds to live pictures: cold from the start of this process, and warm."""
    _to_live(application, folder)
    cold_s = time.time() - psutil.Process().create_time()
    return {"cold_s": cold_s, "warm_s": _to_live(application, folder)}


def _to_live(application: QApplication, folder: Path) -> float:
    begun_s = time.monotonic()
    main = _window(application, folder)
    main.start()
    main.go("operate")
    main.connect_bench(open_simulated_bench)
    operate, until = main.workspaces["operate"], QDeadlineTimer(START_MS)
    while not until.hasExpired():
        application.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
        live = operate.live
        if live is not None and min(live.frames_shown.values()) and operate.page.force.paints:
            break
    taken_s = time.monotonic() - begun_s
    main.quit_at_once()
    _close(application, main)
    return taken_s


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        answer = {"soak": soak, "start": start}[sys.argv[1]](QApplication([]), Path(name))
    sys.stdout.write(json.dumps(answer) + "\n")

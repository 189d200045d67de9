"""Child that measures a window beside a simulated bench: ``python -m`` it with one of the words.

``soak``: a day on a stepped bench, in short form. ``start``: from the
command to live pictures, then again in the same process with every module imported. ``pages``:
change of page and dragging of pictures. ``rest``: memory and processor time without a run.
``load`` and seconds: frame times beside a live run. Prints one JSON object.
"""

import gc
import itertools
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil
from PySide6.QtCore import QDeadlineTimer, QEvent, QEventLoop, QObject, QPoint, QPointF, Qt, QTimer
from PySide6.QtGui import QMouseEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QApplication
from shiboken6 import isValid

from touchdown.app.application import TouchdownApp
from touchdown.app.shell import lift_hand
from touchdown.app.shell.errors import ErrorBox
from touchdown.app.stack.workspace import StackWorkspace
from touchdown.app.start import open_simulated_bench, tune_interpreter
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.bench.session import STEP_US, Session
from touchdown.backend.core import (
    ActionChosen,
    EpisodeRecorded,
    Event,
    PatchEstimated,
    RefusedError,
    TrialFinished,
)
from touchdown.backend.runs import (
    CollectRequest,
    ProbeRequest,
    RecordingOptions,
    RunState,
    SceneChoice,
    SetRequest,
    StackRequest,
)
from touchdown.widgets.base.freshness import PERIOD_MS

STEP_S, MINUTES = 1e-6 * STEP_US, 45.0
TICKS_A_STEP = 1e3 * STEP_S / PERIOD_MS
PAGE_S, SAMPLE_S = 10.0, 10.0  # time per page; interval of the memory samples
WARM_UP_MIN = 10.0  # until then each page has shown each sheet, and each run was done
START_MS = 60_000
HEARTBEAT_MS = 10
# Of a day: trials and probes of a run, labels at a time, commands for a sheet or another look.
STACKED, COLLECTED, LABELS, SHOWN = 4, 6, 2, 12  # SHOWN: turns of the pump after an act
SHEETS = ("keys", "palette", "limits", "calibrate", "layouts", "theme", "larger", "smaller")
# More trials than any measurement lasts, so that trial changes are part of the load.
TRIALS, FIRST_SEED = 500, 100
RUN_UP_S, CHANGES, MOVES = 20.0, 60, 80  # simulated time before the pages; changes; moves a picture
SETTLE_MS, IDLE_MS = 10_000, 20_000


def _window(application: QApplication, folder: Path) -> TouchdownApp:
    return TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")


def _close(application: QApplication, main: TouchdownApp) -> None:
    main.close()
    main.window.deleteLater()
    main.deleteLater()
    application.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)
    application.processEvents()


def soak(application: QApplication, folder: Path) -> dict[str, float]:
    """Return the memory slope of a day after the first visits, frame rates, and what is left.

    Memory rises and falls with each run, so the slope is that of the means of whole rounds of runs.
    """
    threads = set(threading.enumerate())
    session = simulated_session(keep=RecordingOptions(folder / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None  # type: ignore[method-assign]
    main = _window(application, folder)
    main.window.resize(1600, 940)
    main.window.show()
    main.attach(session)
    pictures = _Pictures(main)
    day, begun_s = _Day(main, session), time.monotonic()
    memory: dict[int, list[tuple[float, float]]] = {}  # minute and MB, by round of runs
    for step in range(round(60 * MINUTES / STEP_S)):
        if session.status().state is RunState.IDLE:
            day.start_run()
        _step(main, session, step, pictures)
        if step % round(PAGE_S / STEP_S) == round(PAGE_S / STEP_S) // 2:
            day.act()
        if step == round(60 * WARM_UP_MIN / STEP_S):
            first = day.complete_rounds()
        if step % round(SAMPLE_S / STEP_S) == 0:
            gc.collect()
            sample = step * STEP_S / 60.0, psutil.Process().memory_info().rss / 1e6
            memory.setdefault(day.rounds, []).append(sample)
            sys.stderr.write(f"minute {sample[0]:.1f}: {sample[1]:.1f} MB\n")
    wall_s, pss_mb, done = time.monotonic() - begun_s, _pss_mb(), day.done()
    session.engine.cancel()
    while session.status().state is not RunState.IDLE:
        _step(main, session, 1, pictures)
    _close(application, main)
    left = set(threading.enumerate()) - threads
    sys.stderr.writelines(f"left: {thread}\n" for thread in left)
    at_min, mean_mb = np.transpose([np.mean(memory[k], 0) for k in range(first + 1, day.rounds)])
    half = len(at_min) // 2
    return {
        "slope_mb_per_min": float(np.polyfit(at_min, mean_mb, 1)[0]),
        "later_slope_mb_per_min": float(np.polyfit(at_min[half:], mean_mb[half:], 1)[0]),
        "first_round_mb": float(mean_mb[0]),
        "last_round_mb": float(mean_mb[-1]),
        "rounds": len(at_min),
        "pss_mb": pss_mb,
        **done,
        "wall_s": wall_s,
        **pictures.per_second(),
        "threads_left": len(left),
        "timers_left": len(_active_timers()),
    }


class _Day:
    """An operator's day in short form: a run after the other, and acts on the page in front."""

    def __init__(self, main: TouchdownApp, session: Session) -> None:
        self._main, self._session, self._seeds = main, session, itertools.count(100, STACKED)
        self.rounds, self._visits = 0, set[tuple[str, str]]()
        self._waits, self.counts = 0, dict.fromkeys(("trials", "probes", "sheets", "refused"), 0)
        session.events.subscribe(self._take)  # on this thread: the bench is stepped
        self._runs = itertools.cycle((self._set, self._probe, self._collect, self._stack))
        self._sheets = itertools.cycle(SHEETS)
        collect = main.workspaces["collect"]
        collect.label.be("Ann")
        until = QDeadlineTimer(START_MS)
        while collect.presenter.dataset is None and not until.hasExpired():
            QApplication.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
            main.pump.tick()
        self._collected = collect

    def start_run(self) -> None:
        """Start the next run; where it is refused, lift the piece and wait some seconds."""
        if self._waits:
            self._waits -= 1
            return
        self._main.reset()
        try:
            next(self._runs)()
        except RefusedError:
            self.counts["refused"] += 1
            lift_hand(self._session, self._main.cards)
            self._waits = round(PAGE_S / STEP_S)

    def act(self) -> None:
        """Act on the page in front, and open the next sheet or look; all are closed again."""
        main, front = self._main, self._main.window.front
        if front == "collect":
            self._collected.page.show_half("label")
            self._show()
            label = {command.name: command.run for command in self._collected.label.commands}
            for name in ("nudge-right-100", "accept") * LABELS:
                label[name]()
                self._show()
            self._collected.page.show_half("collect")
        elif front == "review":
            main.workspaces["review"].page.recording_chosen.emit(0)
        elif front == "stack":
            self._do("stack.compare", "stack.planned")
        sheet = next(self._sheets)
        self._visits.add((front, sheet))
        self._do(sheet)
        self.counts["sheets"] += 1
        for top in QApplication.topLevelWidgets():
            if top is not main.window and top.isVisible():
                top.close()

    def done(self) -> dict[str, int]:
        """Return how often each thing was done; labels are those accepted."""
        states = self._collected.presenter.dataset.counts()
        drafts = states.pop("draft", 0) + states.pop("unlabelled", 0)
        return {**self.counts, "labels": sum(states.values()), "drafts": drafts}

    def _do(self, *commands: str) -> None:
        for name in commands:
            self._main.actions.action(name).trigger()
            self._show()

    def _show(self) -> None:
        for _ in range(SHOWN):
            _turn(self._main)

    def _take(self, event: Event) -> None:
        self.counts["trials"] += isinstance(event, TrialFinished)
        self.counts["probes"] += isinstance(event, PatchEstimated | EpisodeRecorded)

    def complete_rounds(self) -> int:
        """Return the number of the present round; every page must have shown every sheet."""
        assert len(self._visits) == len(self._main.workspaces) * len(SHEETS)
        assert self.rounds > 1
        return self.rounds

    def _set(self) -> None:
        self.rounds += 1
        self._session.start(SetRequest(SceneChoice()))

    def _probe(self) -> None:
        self._session.start(ProbeRequest())

    def _collect(self) -> None:
        self._session.dataset = self._collected.presenter.dataset
        self._session.start(
            CollectRequest("pot", "circle15", COLLECTED, next(self._seeds), person="Ann")
        )

    def _stack(self) -> None:
        self._session.start(StackRequest(trials=STACKED, seed=next(self._seeds)))


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
        _turn(main)


def _turn(main: TouchdownApp) -> None:
    """Let the window have one turn, and delete what the event loop of the program would delete."""
    main.pump.tick()
    QApplication.processEvents()
    QApplication.sendPostedEvents(None, QEvent.Type.DeferredDelete.value)


def _active_timers() -> list[QTimer]:
    gc.collect()
    found = [item for item in gc.get_objects() if isinstance(item, QTimer)]
    left = [timer for timer in found if isValid(timer) and timer.isActive()]
    sys.stderr.writelines(f"left: {timer} of {timer.parent()}\n" for timer in left)
    return left


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


def load(application: QApplication, folder: Path) -> dict[str, float]:
    """Return frame times, processor time and decisions beside a live run of some seconds."""
    main = _window(application, folder)
    main.start()
    main.window.resize(1600, 940)
    main.go("stack")
    main.connect_bench(open_simulated_bench)
    answers: list[dict[str, float]] = []
    Measurement(main, float(sys.argv[2]), answers.append)
    application.exec()
    main.close()
    return answers[0]


def pages(application: QApplication, folder: Path) -> dict[str, float]:
    """Return the 95th percentiles of a page change, and of a move of the pointer in a picture."""
    session = simulated_session(keep=RecordingOptions(folder / "runs"))
    session.prepare(SceneChoice())
    session.open = lambda speed=1.0: None  # type: ignore[method-assign]
    main = _window(application, folder)
    main.window.resize(1600, 940)
    main.window.show()
    main.attach(session)
    session.start(StackRequest(trials=20, seed=100))
    pictures, changes, moves = _Pictures(main), [], []
    for step in range(round(RUN_UP_S / STEP_S)):
        _step(main, session, step, pictures)
    for turn in range(CHANGES):
        name = list(main.workspaces)[turn % len(main.workspaces)]
        changes.append(_timed_ms(application, lambda name=name: main.go(name)))
        for step in range(5):
            _step(main, session, step + 1, pictures)
    main.go("stack")
    stack = main.workspaces["stack"]
    assert isinstance(stack, StackWorkspace)
    for view in (stack.page.belief, *stack.page.tactile.values()):
        view.zoom_by(2.0)
        centre, button = view.rect().center(), Qt.MouseButton.LeftButton
        QTest.mousePress(view, button, Qt.KeyboardModifier.NoModifier, centre)
        for turn in range(MOVES):
            at = centre + QPoint(turn % 40 - 20, turn % 30 - 15)
            place, map_to = QPointF(at), QPointF(view.mapToGlobal(at))
            event = QMouseEvent(QEvent.Type.MouseMove, place, map_to, Qt.MouseButton.NoButton,
                                button, Qt.KeyboardModifier.NoModifier)  # fmt: skip
            moves.append(
                _timed_ms(application, lambda e=event, v=view: application.sendEvent(v, e))
            )
        QTest.mouseRelease(view, button, Qt.KeyboardModifier.NoModifier, centre)
    _close(application, main)
    found = {"change": changes[len(main.workspaces) :], "drag": moves}
    return {f"{name}_p95_ms": float(np.percentile(ms, 95)) for name, ms in found.items()}


def _timed_ms(application: QApplication, act: Callable[[], object]) -> float:
    """Return the time of ``act`` with the painting that follows."""
    begun_s = time.perf_counter()
    act()
    application.processEvents()
    return 1e3 * (time.perf_counter() - begun_s)


def _processes() -> list[psutil.Process]:
    me = psutil.Process()
    return [me, *me.children(recursive=True)]


def _pss_mb() -> float:
    return sum(one.memory_full_info().pss for one in _processes()) / 1e6


def rest(application: QApplication, folder: Path) -> dict[str, float]:
    """Return memory and share of one core of all processes, without a run, then minimised."""
    main = _window(application, folder)
    main.start()
    main.go("operate")
    main.connect_bench(open_simulated_bench)
    _wait(application, lambda: main.bench is not None, START_MS)
    _wait(application, lambda: False, SETTLE_MS)
    idle, pss_mb = _share_percent(application), _pss_mb()
    main.window.showMinimized()
    minimised = _share_percent(application)
    main.quit_at_once()
    _close(application, main)
    return {"idle_percent": idle, "minimised_percent": minimised, "pss_mb": pss_mb}


def _share_percent(application: QApplication) -> float:
    def used_s() -> float:
        return sum(sum(one.cpu_times()[:2]) for one in _processes())

    begun_s, before_s = time.monotonic(), used_s()
    _wait(application, lambda: False, IDLE_MS)
    return 100 * (used_s() - before_s) / (time.monotonic() - begun_s)


def _wait(application: QApplication, done: Callable[[], bool], most_ms: int) -> None:
    # An event loop sleeps between events; processEvents with a time limit does not.
    until, loop, poll = QDeadlineTimer(most_ms), QEventLoop(application), QTimer(interval=50)
    poll.timeout.connect(lambda: loop.quit() if done() or until.hasExpired() else None)
    poll.start()
    loop.exec()
    poll.stop()


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        os.environ["TOUCHDOWN_DATA"] = os.environ["TOUCHDOWN_CONFIG"] = name
        modes = {"soak": soak, "start": start, "pages": pages, "rest": rest, "load": load}
        tune_interpreter()
        measure = modes[sys.argv[1]]
        answer = measure(QApplication([]), Path(name))
    sys.stdout.write(json.dumps(answer) + "\n")

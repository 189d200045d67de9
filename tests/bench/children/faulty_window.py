"""Child that measures a real window while something fails: ``python -m`` it SCENARIO [LAB].

A fault lasts for whole slices of time; the slices beside it are the same window without the fault.
Prints one JSON object after the window was closed.
"""

import gc
import json
import math
import os
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import psutil
from PySide6.QtCore import QEventLoop, QObject, Qt, QTimer, Signal
from PySide6.QtGui import QPaintEvent
from PySide6.QtTest import QTest
from PySide6.QtWidgets import QPushButton, QWidget

from tests.bench.children.failing_window import LIMIT_S, Watched, say
from tests.bench.children.lab_window import LabWindow
from touchdown.app.shell import exit_after_timeout, log_to
from touchdown.app.stack.workspace import StackWorkspace
from touchdown.app.start import THREAD_SWITCH_S, freeze_garbage, tune_interpreter
from touchdown.backend.bench.assembly import simulated_session
from touchdown.backend.core import Fault, FaultRaised, ImageArray
from touchdown.backend.devices.cameras.sources import PictureSource
from touchdown.backend.devices.gelsight.driver import TactileCamera
from touchdown.backend.placement.strategies import ProbeObservation, make_strategy
from touchdown.backend.runs import RecordingOptions, StackRequest, probe, stack

TICK_MS, FLOOD_TICK_MS, KEY_MS = 10, 16, 15
TRIALS, SEED = 500, 100  # more trials than any measurement needs
SIZE = (1600, 940)
WARM_UP_S, LOOK_S, SLICE_S = 3.0, 0.02, 5.0
BLOCKED_S, FLOOD_S = 10.0, 10.0
SLICES = 12  # pairs of slices for each comparison of machinery
FLOOD_SLICES, FLOOD_SLICE_S, DYING_S = (
    5,
    2.0,
    3.0,
)  # pairs of slices for each kind of error in every frame
DECISIONS, HOLD_S, USUAL_SWITCH_S = 200, 0.08, 0.005
FLOODS = ("view", "paint event", "bench")  # a view's redraw, a paint event, each step of the bench
RAISED = ("SlotError", "TimerError", "PaintError", "ThreadError", "QueuedError")
FLOOD = Fault("FLOOD", "The same fault in every step of the bench.", "None.", "Reset.")
# larger than the shipped models, so that the training outlasts the measurement
SIZES = {"hidden": 512, "layers": 2, "batch": 1}
# labels entered before the timing and in each round, and how far each is nudged
FIRST_LABELS, LABELS, NUDGES, NUDGE_UM = 3, 4, 3, 100
HELD_S, ROUND_S = (0.1, 1.0, 10.0), 2.0
HOLD = """
import sqlite3, sys, time
other = sqlite3.connect(sys.argv[1], isolation_level=None)
other.execute("BEGIN IMMEDIATE")
print("held", flush=True)
time.sleep(float(sys.argv[2]))
other.execute("ROLLBACK")
"""


class Ticks:
    """Longest gap between two ticks of 10 ms of the window's thread."""

    def __init__(self, parent: QObject) -> None:
        self._last_s = self._gap_s = math.nan
        self._timer = QTimer(parent)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self._tick)
        self._timer.start(TICK_MS)

    def longest_ms(self, live: Callable[[], object]) -> float:
        self._last_s, self._gap_s = time.monotonic(), 0.0
        live()
        self._tick()
        return 1e3 * self._gap_s

    def _tick(self) -> None:
        now_s = time.monotonic()
        self._gap_s = max(self._gap_s, now_s - self._last_s)
        self._last_s = now_s


@dataclass(frozen=True, slots=True)
class Slice:
    """Pictures per second, share of a core (window's thread) and longest gap of a slice of time."""

    left_fps: float
    right_fps: float
    traces_fps: float
    core_percent: float
    gap_ms: float


class Sliced(Watched):
    """A window beside a live simulated bench, measured slice by slice."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.main.window.resize(*SIZE)
        self.session, self.ticks = self.bench(), Ticks(self.main.window)

    def stack(self) -> None:
        """Start a run that outlasts the measurement, with the Stack page in front."""
        self.main.go("stack")
        self.session.start(StackRequest(trials=TRIALS, seed=SEED))
        self.live_for(WARM_UP_S)

    def live_for(self, for_s: float) -> None:
        loop = QEventLoop()
        QTimer.singleShot(round(1e3 * for_s), loop.quit)
        loop.exec()

    def pump(self, there: Callable[[], bool]) -> float:
        """Run the event loop until ``there`` as in use; return how long it took."""
        begun_s = time.monotonic()
        while not there():
            self.live_for(LOOK_S)
            if time.monotonic() - begun_s > LIMIT_S:
                raise TimeoutError(f"nothing after {LIMIT_S:g} s; cards {self.main.cards.codes}")
        return time.monotonic() - begun_s

    def slice_of(self, for_s: float) -> Slice:
        before, thread_s, begun_s = self._shown(), time.thread_time(), time.monotonic()
        gap_ms = self.ticks.longest_ms(lambda: self.live_for(for_s))
        took_s = time.monotonic() - begun_s
        left, right, traces = (self._shown() - before) / took_s
        percent = 100.0 * (time.thread_time() - thread_s) / took_s
        return Slice(left, right, traces, percent, gap_ms)

    def _shown(self) -> np.ndarray:
        stack = self.main.workspaces["stack"]
        assert isinstance(stack, StackWorkspace)
        assert stack.live is not None
        shown = stack.live.frames_shown
        return np.array([shown["left"], shown["right"], stack.page.force.paints], np.float64)


def together(slices: Sequence[Slice]) -> Mapping[str, float]:
    rows = [asdict(one) for one in slices]
    means = {name: float(np.mean([row[name] for row in rows])) for name in rows[0]}
    return means | {"gap_ms": max(row["gap_ms"] for row in rows)}


class Blocking:
    """Replaces a picture source; the next read after ``block`` was set takes 10 s."""

    def __init__(self, source: PictureSource, block: threading.Event) -> None:
        self._source, self._block = source, block
        self.lost, self.facts, self.close = 0, source.facts, source.close

    def read(self, limit_s: float) -> bytes | ImageArray | None:
        if self._block.is_set():
            self._block.clear()
            threading.Event().wait(BLOCKED_S)
        return self._source.read(limit_s)


def blocked_camera(window: LabWindow) -> dict[str, object]:
    """Block a read for 10 s, then another one that still blocks when the window is closed."""
    block, ticks = threading.Event(), Ticks(window.main.window)
    assert window.session.connection is not None
    camera = window.session.connection.devices["tactile_left"]
    assert isinstance(camera, TactileCamera)
    real = camera._open_camera
    camera._open_camera = lambda path, settings: Blocking(real(path, settings), block)
    window.ready()
    window.linger(2.0)
    usual_ms = ticks.longest_ms(lambda: window.linger(BLOCKED_S / 2))
    block.set()
    blocked_ms = ticks.longest_ms(lambda: window.linger(BLOCKED_S))
    found = {"usual_ms": usual_ms, "blocked_ms": blocked_ms, "cards": window.main.cards.codes}
    window.ready()
    block.set()
    window.linger(1.0)
    assert not block.is_set(), "no read is blocked"
    return found


class Canvas(QWidget):
    """Paints nothing, or raises ``error``."""

    error: type[Exception] | None = None

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: N802
        if self.error is not None:
            raise self.error("deliberate")


class Raising(QObject):
    """``ways``: by name of an exception, the code that raises it once."""

    queued = Signal()

    def __init__(self, main: QWidget) -> None:
        super().__init__(main)
        self.errors = {name: type(name, (Exception,), {}) for name in RAISED}
        slot, timer, _, thread, queued = (self._raising(name) for name in RAISED)
        self.canvas, button = Canvas(main), QPushButton(main)
        self.canvas.resize(40, 40)
        self.canvas.show()
        button.clicked.connect(slot)
        self.queued.connect(queued, Qt.ConnectionType.QueuedConnection)
        ways = (
            button.click,
            lambda: QTimer.singleShot(0, main, timer),
            self._paint,
            lambda: threading.Thread(target=thread).start(),
            lambda: threading.Thread(target=self.queued.emit).start(),
        )
        self.ways: dict[str, Callable[[], None]] = dict(zip(RAISED, ways, strict=True))

    def _raising(self, name: str) -> Callable[[], None]:
        def fail() -> None:
            raise self.errors[name]("deliberate")

        return fail

    def _paint(self) -> None:
        self.canvas.error = self.errors["PaintError"]
        self.canvas.repaint()
        self.canvas.error = None


def exceptions(window: Watched) -> dict[str, object]:
    """Raise in a slot, timer, paint event, thread and queued call: once, then at every tick."""
    log = log_to(window.folder / "log")
    assert log is not None
    window.bench()
    main, found = window.main, dict[str, dict[str, float]]()
    raising = Raising(main.window)
    for kind, once in raising.ways.items():
        raised_s = time.monotonic()
        QTimer.singleShot(0, main.window, once)
        window.pump(lambda kind=kind: f"BUG-{kind.upper()}" in main.cards.codes)
        found[kind] = {"told_s": time.monotonic() - raised_s}
    for kind, once in raising.ways.items():
        main.reset()
        before, flood = log.read_text("utf-8").count("\n"), QTimer(main.window)
        flood.timeout.connect(once)
        flood.start(FLOOD_TICK_MS)
        end_s = time.monotonic() + FLOOD_S
        window.pump(lambda end_s=end_s: time.monotonic() >= end_s)
        flood.stop()
        found[kind]["lines_per_s"] = (log.read_text("utf-8").count("\n") - before) / FLOOD_S
    return {"kinds": found}


class Flood:
    """``kind``: the error that is raised in every frame, "" for none; ``raised`` counts them."""

    def __init__(self, window: Sliced) -> None:
        self.kind, self.raised, self._session = "", dict.fromkeys(FLOODS, 0), window.session
        self.canvas = Canvas(window.main.window)
        self.canvas.resize(40, 40)
        self.canvas.show()
        window.main.pump.add(self._view)
        window.main.pump.add(self._paint)
        self._step = window.session.advance
        window.session.advance = self._advance  # type: ignore[method-assign]

    def _is_due(self, kind: str) -> bool:
        self.raised[kind] += self.kind == kind
        return self.kind == kind

    def _view(self) -> None:
        if self._is_due("view"):
            raise RuntimeError("deliberate")

    def _paint(self) -> None:
        self.canvas.error = RuntimeError if self._is_due("paint event") else None
        self.canvas.update()

    def _advance(self) -> None:
        self._step()
        if self._is_due("bench"):
            self._session.events.publish(FaultRaised(self._session.clock_s(), FLOOD))


def error_in_every_frame(window: Sliced) -> dict[str, object]:
    """Take turns of slices with and without an error in every frame."""
    folder = window.folder / "log"
    assert log_to(folder) is not None
    window.stack()
    flood, kinds = Flood(window), dict[str, dict[str, object]]()
    for kind in FLOODS:
        slices: dict[str, list[Slice]] = {"with": [], "without": []}
        for _ in range(FLOOD_SLICES):
            for which, raised in (("without", ""), ("with", kind)):
                flood.kind = raised
                slices[which].append(window.slice_of(FLOOD_SLICE_S))
        flood.kind = ""
        kinds[kind] = {which: together(some) for which, some in slices.items()}
        window.main.cards.clear()
    log_bytes = sum(path.stat().st_size for path in folder.iterdir())
    return {"kinds": kinds, "raised": flood.raised, "log_bytes": log_bytes}


ROOM_BYTES = 65_536  # memory left to the training: less than a batch


def out_of_memory(number: int) -> None:
    """Let the process ``number`` take next to nothing more."""
    taken = psutil.Process(number).memory_info().vms
    resource.prlimit(number, resource.RLIMIT_AS, (taken // 2, taken // 2))
    resource.prlimit(number, resource.RLIMIT_DATA, (ROOM_BYTES, ROOM_BYTES))


def killed(number: int) -> None:
    os.kill(number, signal.SIGKILL)


MEMORY_FAILURES: dict[str, Callable[[int], None]] = {
    "no memory left": out_of_memory,
    "killed": killed,
}


def dying_training(window: Sliced) -> dict[str, object]:
    """Let a training die in each way: slices before it, beside it, while it dies, and after it."""
    found = dict[str, object]()
    train = window.train()
    for name, value in SIZES.items():
        getattr(train.page.form, name).setValue(value)
    window.stack()
    for way, strike in MEMORY_FAILURES.items():
        whens = {"before": window.slice_of(DYING_S)}
        window.main.go("train")
        number = window.begin(train)
        window.main.go("stack")
        whens["beside"] = window.slice_of(DYING_S)
        strike(number)
        whens["dying"] = window.slice_of(DYING_S)
        assert "TRAINING-DIED" in window.main.cards.codes, window.main.cards.codes
        window.main.cards.clear(("TRAINING-DIED",))
        whens["after"] = window.slice_of(DYING_S)
        found[way] = {when: asdict(one) for when, one in whens.items()}
    return {"ways": found}


class Labelling:
    """The Label page with an emulated operator; ``asked``: entered positions (µm)."""

    def __init__(self, window: Sliced) -> None:
        self._window, main = window, window.main
        both: Any = main.workspaces["collect"]
        both.page.bring("label")
        both.label.recall({"person": "Ann", "sigma_mm": 0.2})
        main.go("collect")
        main.window.activateWindow()
        self.asked, self.waited = dict[str, tuple[int, int]](), 0
        self._keys = list[Qt.Key]()
        self._typing = QTimer(main.window)
        self._typing.timeout.connect(self._type)
        self._typing.start(KEY_MS)
        window.pump(lambda: both.label.presenter is not None)
        self.presenter = both.label.presenter
        window.pump(lambda: self.presenter.present is not None and self.quiet)

    @property
    def quiet(self) -> bool:
        """Return True if all entered labels are saved."""
        saving, editing = self.presenter.saving, self.presenter.editing
        return not (self._keys or saving.busy or editing.waits or saving.waiting)

    def accept(self, labels: int) -> None:
        """Nudge and accept labels by keys, one key every ``KEY_MS``."""
        walk = self.presenter.walk
        for uuid in walk.order[walk.at : walk.at + labels]:
            label = self.presenter.book.head(uuid).label
            self.asked[uuid] = (label.x_um + NUDGES * NUDGE_UM, label.y_um)
        self._keys = [*[Qt.Key.Key_Right] * NUDGES, Qt.Key.Key_Return] * labels

    def _type(self) -> None:
        if self._keys:
            QTest.keyClick(self._window.main.window.windowHandle(), self._keys.pop(0))
        self.waited = max(self.waited, self.presenter.saving.waiting)


def locked_catalogue(window: Sliced) -> dict[str, object]:
    """Accept labels while another process holds the catalogue's lock, and while none does."""
    at = Labelling(window)
    at.accept(FIRST_LABELS)
    window.pump(lambda: at.quiet)
    locked, free, waited = dict[str, float](), dict[str, float](), dict[str, int]()
    for held_s in HELD_S:
        name, path = f"{held_s:g}", at.presenter.dataset.database.path
        at.accept(LABELS)
        free[name] = window.slice_of(held_s + ROUND_S).gap_ms
        window.pump(lambda: at.quiet)
        holding = [sys.executable, "-c", HOLD, str(path), name]
        with subprocess.Popen(holding, stdout=subprocess.PIPE, text=True) as other:
            assert other.stdout is not None
            other.stdout.readline()
            at.waited = 0
            at.accept(LABELS)
            locked[name] = window.slice_of(held_s + ROUND_S).gap_ms
        window.pump(lambda: at.quiet)
        waited[name] = at.waited
    return {"locked": locked, "free": free, "waited": waited, "asked": at.asked}


def a_decision() -> Callable[[], float]:
    """Return a function that decides on a recorded probe and returns how long that took, ms."""
    pressed: list[tuple[Any, ...]] = []
    judge, assemble = stack._judge, probe.assemble_episode

    def judged(bench: Any, one: Any, strategy: Any) -> Any:
        pressed.append((bench.estimator, stack.grasped_piece(bench), bench.settings, one.episode))
        return judge(bench, one, strategy)

    with (
        mock.patch.object(stack, "_judge", judged),
        mock.patch.object(probe, "assemble_episode", side_effect=assemble) as assembled,
    ):
        session = simulated_session(keep=RecordingOptions(None))
        session.run(StackRequest(seed=SEED))
        session.close()
    (estimator, held, settings, episode), made = pressed[0], assembled.call_args_list[0]

    def decide() -> float:
        estimator.prepare(episode.observation[:19])
        strategy, begun_s = make_strategy(held, settings, (0.0, 0.0)), time.perf_counter()
        now = assemble(*made.args, **made.kwargs)
        x_mm, y_mm = now.offset_mm.tolist()
        patch = estimator.estimate(now)
        strategy.conclude(ProbeObservation(now.observation, patch, (x_mm, y_mm)))
        return 1e3 * (time.perf_counter() - begun_s)

    return decide


def machinery(window: Sliced) -> dict[str, object]:
    """Decisions, collections of garbage and ticks with and without what shall speed them up."""
    decide, hold = a_decision(), window.session.repaint_hold
    window.stack()
    latency_ms: dict[bool, list[float]] = {True: [], False: []}

    def alternate() -> None:
        pause = threading.Event()
        for number in range(2 * DECISIONS):
            if number % 2 == 0:
                hold.begin(HOLD_S)
            pause.wait(LOOK_S)
            latency_ms[number % 2 == 0].append(decide())
            hold.end()
            pause.wait(LOOK_S)

    thread = threading.Thread(target=alternate)
    thread.start()
    window.pump(lambda: not thread.is_alive())
    found: dict[str, object] = {"latency_ms": [latency_ms[True], latency_ms[False]]}
    collected_ms: dict[bool, list[float]] = {True: [], False: []}
    gaps_ms: dict[bool, list[float]] = {True: [], False: []}
    for number in range(2 * SLICES):
        used = number % 2 == 0
        (freeze_garbage if used else gc.unfreeze)()
        begun_s = time.thread_time()
        gc.collect()
        collected_ms[used].append(1e3 * (time.thread_time() - begun_s))
        sys.setswitchinterval(THREAD_SWITCH_S if used else USUAL_SWITCH_S)
        gaps_ms[used].append(window.slice_of(SLICE_S).gap_ms)
    found["collected_ms"] = [collected_ms[True], collected_ms[False]]
    return found | {"gap_ms": [gaps_ms[True], gaps_ms[False]]}


SCENARIOS: dict[str, tuple[Callable[..., Watched], Callable[[Any], dict[str, object]]]] = {
    "blocked camera": (LabWindow, blocked_camera),
    "exceptions": (Watched, exceptions),
    "error in every frame": (Sliced, error_in_every_frame),
    "dying training": (Sliced, dying_training),
    "locked catalogue": (Sliced, locked_catalogue),
    "machinery": (Sliced, machinery),
}


def main(scenario: str, *lab: str) -> int:
    tune_interpreter()
    make, measure = SCENARIOS[scenario]
    with tempfile.TemporaryDirectory() as name:
        os.environ.setdefault("TOUCHDOWN_DATA", name)
        window = make(Path(name), *map(Path, lab))
        found = measure(window)
        found["asked_s"] = time.monotonic()
        window.close()
        say(json.dumps(found))
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

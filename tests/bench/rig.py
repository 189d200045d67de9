"""Figures of the rig process: STOP through it, killed halves, a shared core, and the end of a jog
lease.

Wall time, Linux. On a shared core rig and busy programs have one core, the emulated devices and the
backend the others. The lease is measured over real windows, drivers and a rig process: the window
freezes, loses what was held, is stopped, or is killed.
"""

import itertools
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from tests.backend.devices.melfa.emulated_arm import settings as melfa_settings
from tests.backend.devices.waiting import until
from tests.backend.rig.inline import InlineBench
from tests.backend.rig.served import Backend, Served
from tests.bench.children.lab_window import LOSSES, STALLS, Note
from tests.bench.children.logged_arm import LoggedArm, Told
from tests.bench.children.watched_arm import LineChild, WatchedArm, watched_arm
from tests.bench.figures import Figure, at_most, failures, figure, stated
from tests.bench.worker_faults import hooked
from tests.busy_computer import STARVED
from touchdown.backend.bench import Session, simulated_session
from touchdown.backend.config import HardwareSettings, is_loopback
from touchdown.backend.core.events import Event, TrialFinished
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.scheduling import round_robin_priority
from touchdown.backend.core.values import Pose
from touchdown.backend.runs import RecordingOptions, StackRequest

STOPS, KILLS, OWN_CYCLES = 100, 10, 285
SEEDS = range(7, 11)


@contextmanager
def served() -> Iterator[Served]:
    """Serve emulated devices until the block ends."""
    made = Served()
    try:
        yield made
    finally:
        made.close()


@figure("arm")
def stop_through_the_rig() -> list[Figure]:
    """Time from the backend's STOP to its arrival at the emulated controller, while the arm moves.

    Also the answer to an order that moves nothing: there and back through the pipe.
    """
    took_ms, asked_ms = [], []
    with served() as bench:
        backend = Backend(bench.settings)
        try:
            while len(took_ms) < STOPS:
                backend.moving()
                before, asked_s = len(bench.arm.stops), time.monotonic()
                backend.arm.stop()
                until(lambda: len(bench.arm.stops) > before)  # noqa: B023 - called at once
                took_ms.append(1e3 * (bench.arm.stops[before] - asked_s))
                asked_s = time.monotonic()
                backend.arm.place_of((0.0, 0.2, 2.0, 0.0, 0.9, 0.0))
                asked_ms.append(1e3 * (time.monotonic() - asked_s))
                threading.Event().wait(0.05)
        finally:
            backend.close()
    p99 = float(np.percentile(took_ms, 99))
    told = f"{STOPS} stops; median {np.median(took_ms):.2f}, worst {max(took_ms):.1f} ms"
    asked = float(np.median(asked_ms))
    return [
        at_most("STOP through the rig to the controller, p99", p99, "ms", 20, told),
        stated("an order to the rig and its answer, median", asked, "ms"),
    ]


@figure("arm")
def killed_rig() -> list[Figure]:
    """Rig killed or crashed while the arm moves: time until reported, and stop of the arm."""
    took_ms, moved, again = [], 0, 0
    with served() as bench:
        backend = Backend(bench.settings)
        # The controller ends a stream by itself; the tests give it longer than any stall.
        controller, stream = bench.arm._device.controller, bench.arm._device.stream
        patient, strict = stream._settings, melfa_settings(mxt={"mxttout": OWN_CYCLES})
        try:
            for kill in range(KILLS):
                backend.moving()
                number, stream._settings = backend.link.hello["pid"], strict
                killed_s = time.monotonic()
                os.kill(number, (signal.SIGKILL, signal.SIGSEGV)[kill % 2])
                until(lambda: backend.interlock.latched)
                took_ms.append(1e3 * (time.monotonic() - killed_s))
                until(lambda: not controller.servo or not controller.program)
                height_mm = controller.joints.true_rad.copy()
                threading.Event().wait(0.05)
                moved += bool(np.abs(controller.joints.true_rad - height_mm).max() > 1e-6)
                again += backend.link.hello["pid"] != number
                stream._settings = patient
                backend.disconnect()
                backend.interlock.reset()
                controller.reset_error()
        finally:
            backend.close()
    worst = max(took_ms)
    told = f"{KILLS} times, killed and crashed by turns; median {np.median(took_ms):.0f} ms"
    still = "stopped by the controller itself; no rig began by itself"
    return [
        at_most("rig killed: CONTROL-LOST, worst", worst, "ms", 500, told),
        failures("rig killed: arms that moved on, or rigs started again", moved + again, "", still),
    ]  # fmt: skip


@figure("arm")
def killed_backend() -> list[Figure]:
    """Time from kill -9 of the backend to the end of motion at the controller; what is left."""
    took_ms, left = [], 0
    with served() as bench:
        command = [sys.executable, "-m", "tests.backend.rig.served"]
        for _ in range(KILLS):
            settings = bench.settings.model_dump_json()
            with subprocess.Popen([*command, settings], stdout=subprocess.PIPE, text=True) as child:
                assert child.stdout is not None
                rig = psutil.Process(int(child.stdout.readline()))
                before, killed_s = len(bench.arm.stops), time.monotonic()
                child.kill()
            until(lambda: len(bench.arm.stops) > before)  # noqa: B023 - called at once
            took_ms.append(1e3 * (bench.arm.stops[before] - killed_s))
            _, alive = psutil.wait_procs([rig], timeout=10.0)
            left += len(alive)
    worst = max(took_ms)
    told = f"{KILLS} kills; median {np.median(took_ms):.0f} ms"
    return [
        at_most("backend killed: STOP by the rig, worst", worst, "ms", 100, told),
        failures("backend killed: processes left", left),
    ]


def outcome(session: Session, seed: int) -> str:
    """Return how a trial on ``seed`` ends."""
    ends: list[str] = []

    def hear(fact: Event) -> None:
        if isinstance(fact, TrialFinished):
            ends.append(fact.outcome.value)

    leave = session.events.subscribe(hear)
    session.run(StackRequest("pot", ("short",), seed))
    leave()
    return ends[0]


@figure("arm")
def trials_through_the_rig() -> list[Figure]:
    """Whole trials through the rig by stepped clock, compared with the simulated bench."""
    simulated = simulated_session(keep=RecordingOptions(None))
    try:
        usual = [outcome(simulated, seed) for seed in SEEDS]
    finally:
        simulated.close()
    return [figure for mode in ("software", "controller") for figure in _through(mode, usual)]


def _through(mode: str, usual: Sequence[str]) -> list[Figure]:
    bench = InlineBench(mode=mode)
    try:
        ended = [outcome(bench.session, seed) for seed in SEEDS]
    finally:
        bench.close()
    alike = sum(one == other for one, other in zip(ended, usual, strict=True))
    refused = [text for link in bench.links for text in link.refused]
    name = f"trials with {mode} stiffness that end as on the simulated bench"
    orders = f"orders of the plans, {mode} stiffness, that the rig refused"
    good, share = alike >= 0.9 * len(SEEDS), f"{alike} of {len(SEEDS)}"
    return [
        Figure(name, share, "", ">= 90 %", good, ", ".join(ended)),
        failures(orders, len(refused), note="; ".join(refused[:2])),
    ]


PLACES = (Pose(0.0, 0.0, 120.0), Pose(0.0, 0.0, 70.0))
SPEED_MM_S, MOVES_S, WATCHED_S, REALTIME = 20.0, 8.0, 5.0, 50
# half of the top speed of a joint; one late command and the next, with a clock tolerance
MOST_SHARE, MOST_AHEAD = 0.5, 1.05
REFUSED = "RIG-STARVED"
# The second address (RFC 5737) is unused: only the route is looked up.
LOOPBACK, ELSEWHERE = "127.0.0.1", ("192.0.2.1", 9)


@dataclass(frozen=True, slots=True)
class Load:
    """``programs`` that never rest; one with ``takes_ms`` takes the core so long in each second.

    That one does it before all others, at a real-time priority above that of the rig.
    """

    programs: int
    takes_ms: int = 0

    def __str__(self) -> str:
        if self.takes_ms:
            return f"a program that takes the core for {self.takes_ms} ms each second"
        return f"{self.programs} busy program{'s' * (self.programs > 1)}"


PLAIN = (Load(1), Load(2), Load(4))
# below the first limit of the idle check (35 ms), between both, above the second (101 ms)
TAKING = (Load(1, 20), Load(1, 60), Load(1, 150))
TAKES = """
import os, threading, time
os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
while True:
    threading.Event().wait(1.0 - {0})
    until_s = time.monotonic() + {0}
    while time.monotonic() < until_s:
        pass
"""


@dataclass(frozen=True, slots=True)
class Ended:
    """Result of a rig: ``outcome`` as text, and the commands to the arm."""

    outcome: str
    code: str
    told: Told

    @property
    def well(self) -> bool:
        """Return True if the rig warned, refused, held or went on, without a burst."""
        told = self.told
        safe = told.share <= MOST_SHARE and told.ahead <= MOST_AHEAD and told.late_ms == 0.0
        return safe and self.code in STARVED | {"", REFUSED}


@contextmanager
def cores_apart() -> Iterator[int]:
    """Keep what is started meanwhile off one core, and give that."""
    all_cores = os.sched_getaffinity(0)
    core = max(all_cores)
    os.sched_setaffinity(0, all_cores - {core})
    try:
        yield core
    finally:
        os.sched_setaffinity(0, all_cores)


@contextmanager
def busy(load: Load, core: int) -> Iterator[None]:
    """Keep the programs of ``load`` at work on ``core``."""
    code = TAKES.format(1e-3 * load.takes_ms) if load.takes_ms else "while True: pass"
    programs = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(load.programs)]
    try:
        for program in programs:
            pin(program.pid, core)
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def pin(number: int, core: int) -> None:
    """Leave all threads of a process, and those they start, one core."""
    for thread in (Path("/proc") / str(number) / "task").iterdir():
        os.sched_setaffinity(int(thread.name), {core})


def may_take_a_core() -> bool:
    """Return True if programs of this user may run at real-time priority."""
    with round_robin_priority(1) as given:
        return given


def own_address() -> str:
    """Return an address of this computer that is no loopback, which no emulated arm has; or ""."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asks:
        try:
            asks.connect(ELSEWHERE)
        except OSError:
            return ""
        host = str(asks.getsockname()[0])
    return "" if is_loopback(host) else host


def shared(host: str, load: Load, core: int, priority: int) -> Ended:
    """Connect a rig on ``core`` beside a load, and let it move up and down."""
    arm = LoggedArm(host)
    changed = {"idle_check_s": WATCHED_S, "realtime_priority": priority}
    melfa = arm.settings.melfa.model_copy(update=changed)
    settings: HardwareSettings = arm.settings.model_copy(update={"melfa": melfa})
    backend = Backend(settings)
    outcome, code = "", ""
    try:
        backend.link.start()
        pin(backend.link.hello["pid"], core)
        with busy(load, core):
            try:
                backend.connect()
                arm.told()
                outcome = "warned, " if "notice" in backend.arm.describe() else "not warned, "
                up_and_down(backend)
            except (FaultError, RefusedError) as error:
                code = error.fault.code if isinstance(error, FaultError) else error.reason
            fields, told = backend.arm.describe(), arm.told()
    finally:
        backend.close()
        arm.close()
    if not outcome:
        outcome = f"refused ({code})"
    else:
        held = f"held {fields.get('holds', 0)} times, "
        outcome += held + (f"ended by {code}" if code else "went on")
    return Ended(outcome, code, told)


def up_and_down(backend: Backend) -> None:
    """Move for a while; raises what ends it."""
    pause, number, until_s = threading.Event(), 0, time.monotonic() + MOVES_S
    while time.monotonic() < until_s:
        motion = backend.arm.move_to(PLACES[number % 2], SPEED_MM_S)
        number += 1
        while not motion.done and time.monotonic() < until_s:
            pause.wait(0.02)
        if motion.done:
            motion.result()


@figure("arm", long=True)
def rigs_that_share_a_core() -> list[Figure]:
    """Rigs beside busy programs and beside one that takes the core: outcome and commands."""
    if not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2:
        text = "rigs that share a core: bursts"
        return [Figure(text, None, "", "0", None, "needs Linux and two cores")]
    may_take, rows, ended = may_take_a_core(), list[Figure](), list[Ended]()
    cases = [("emulated arm", LOOPBACK, 0, (*PLAIN, *TAKING))]
    if own := own_address():
        elsewhere, first = "arm elsewhere", "arm elsewhere, rig at real-time priority"
        cases.append((elsewhere, own, 0, (Load(4), *TAKING[1:])))
        cases.append((first, own, REALTIME, (Load(4),)))
    with cores_apart() as core:
        for name, host, priority, loads in cases:
            for load in loads:
                if load.takes_ms and not may_take:
                    continue
                one = shared(host, load, core, priority)
                ended.append(one)
                told = one.told
                what = f"{name}, beside {load}: cycles left out"
                note = f"{one.outcome}; longest gap {told.gap_ms:.0f} ms, {told.moves} commands"
                rows.append(stated(what, 100.0 * told.left_out, "%", note))
    share, ahead = (max(getattr(one.told, key) for one in ended) for key in ("share", "ahead"))
    wrong = [one.outcome for one in ended if not one.well]
    return [
        *rows,
        at_most("rigs that share a core: largest step, of the top speed", share, "", MOST_SHARE),
        Figure("rigs that share a core: commands ahead of one a cycle, most", ahead, "",
               "<= 1, a late one and the next", ahead <= MOST_AHEAD),
        failures("rigs that share a core: not ended as documented, or with a burst", len(wrong),
                 note="; ".join(wrong)),
    ]  # fmt: skip


MOST_MS = 300.0
STALLED, LOST, STOPPED, KILLED = 40, 72, 60, 28  # trials of each kind, 200 in all
LOOK_S, STOP_S = 0.6, 0.7  # The emulated arm stores one second: the query must come within it.
LEAST_MM, TRIES = 0.2, 3  # trials with a shorter motion are repeated
SPEEDS_MM_S = (20.0, 50.0, 5.0)
BETWEEN_S = 0.1
Trials = dict[str, list[float]]


class Child(LineChild):
    """The process of one window; ``note`` holds when the lease was last renewed."""

    def __init__(self, environment: Mapping[str, str], lab: Path, note: Path) -> None:
        self.note = Note(note)
        words = "tests.bench.children.lab_window", str(lab), str(note)
        super().__init__(*words, environment=environment)
        expect("ready", self.first)

    def jog(self, speed_mm_s: float, way: str) -> None:
        """Begin a jog; returns when it is under way."""
        expect("going", self.ask(f"{speed_mm_s} {way}"))


def expect(word: str, said: str) -> None:
    if said != word:
        raise ChildProcessError(f"the window said '{said}', not '{word}'")


class Trial:
    """Trials over one bench; ``took_ms`` by kind: from the last renewal to standstill."""

    def __init__(self, arm: WatchedArm, environment: Mapping[str, str], folder: Path) -> None:
        self._arm, self._environment, self._folder = arm, environment, folder
        self._rng = random.Random(11)
        self._speeds, self._pause = itertools.cycle(SPEEDS_MM_S), threading.Event()
        self.took_ms: Trials = {}
        self.again = 0

    @contextmanager
    def window(self) -> Iterator[Child]:
        """Open a window; it is closed or killed in the end."""
        child = Child(self._environment, self._arm.lab, self._folder / "renewed")
        try:
            yield child
        finally:
            if child.process.poll() is None:
                child.process.kill()
            child.process.communicate()

    def ends_by_itself(self, child: Child, kind: str, way: str) -> bool:
        """Let the window freeze or lose the hold; return whether the trial is valid."""
        said = self._measured(child, kind, way)
        expect("over", child.answer())
        return said

    def is_stopped(self, child: Child) -> bool:
        """SIGSTOP, and SIGCONT when the arm has been seen to stand."""
        said = self._measured(child, "stopped", "nothing", signal.SIGSTOP)
        self._pause.wait(STOP_S - LOOK_S)
        child.process.send_signal(signal.SIGCONT)
        expect("over", child.answer())
        return said

    def is_killed(self) -> bool:
        """SIGKILL of a window of its own; the rig process that it leaves ends by itself."""
        with self.window() as child:
            rigs = psutil.Process(child.process.pid).children(recursive=True)
            said = self._measured(child, "killed", "nothing", signal.SIGKILL)
        _, alive = psutil.wait_procs(rigs, timeout=10.0)
        assert not alive, "the rig process outlived its window"
        return said

    def until_said(self, trial: Callable[[], bool]) -> None:
        """Make a trial, again where it says nothing."""
        for _ in range(TRIES):
            if trial():
                return
            self.again += 1

    def _measured(
        self, child: Child, kind: str, way: str, number: signal.Signals | None = None
    ) -> bool:
        child.jog(next(self._speeds), way)
        if number is not None:
            # At any time between two renewals.
            self._pause.wait(self._rng.uniform(0.0, BETWEEN_S))
            os.kill(child.process.pid, number)
        self._pause.wait(LOOK_S)
        renewed_s, rest = child.note.read(), self._arm.rest()
        if rest.way_mm < LEAST_MM:
            return False
        self.took_ms.setdefault(kind, []).append(1e3 * (rest.rested_s - renewed_s))
        return True


@figure("faults", long=True)
def standstill_after_the_last_renewal(
    stalled: int = STALLED, lost: int = LOST, stopped: int = STOPPED, killed: int = KILLED
) -> list[Figure]:
    """A jog over the emulated arm whose window freezes, loses it, is stopped or is killed."""
    with watched_arm() as arm, hooked() as environment, tempfile.TemporaryDirectory() as folder:
        trial = Trial(arm, environment, Path(folder))
        with trial.window() as child:
            for way in itertools.islice(itertools.cycle(STALLS), stalled):
                trial.until_said(partial(trial.ends_by_itself, child, f"frozen: {way}", way))
            for way in itertools.islice(itertools.cycle(LOSSES), lost):
                trial.until_said(partial(trial.ends_by_itself, child, f"lost: {way}", way))
            for _ in range(stopped):
                trial.until_said(partial(trial.is_stopped, child))
            child.close()
        for _ in range(killed):
            trial.until_said(trial.is_killed)
    return [told(trial, stalled + lost + stopped + killed)]


def told(trial: Trial, wanted: int) -> Figure:
    """Return the figure of all trials, with each kind in its note."""
    within = sum(one <= MOST_MS for kind in trial.took_ms.values() for one in kind)
    words = [
        f"{kind} {len(each)}: median {np.median(each):.0f}, worst {max(each):.0f} ms"
        for kind, each in trial.took_ms.items()
    ]
    note = f"{'; '.join(words)}; {trial.again} in which the arm had hardly set out made again"
    name = "standstill <= 300 ms after the last renewal of a jog"
    return Figure(name, f"{within} of {wanted}", "", "all", within == wanted, note)

"""Standstill after the last renewal of a jog lease, as the emulated arm saw it. Wall time.

Real windows over a lab file, real drivers and a rig process: the window freezes, loses what was
held, is stopped, or is killed. How long the arm still moved is told by the emulated arm.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import psutil

from tests.bench.fault_workers import hooked
from tests.bench.lab_window import LOSSES, STALLS, Note
from tests.bench.registry import Figure, figure
from tests.bench.watched_arm import WatchedArm, watched_arm

MOST_MS = 300.0
STALLED, LOST, STOPPED, KILLED = 40, 72, 60, 28
"""Trials of each kind, 200 in all."""
LOOK_S, STOP_S = 0.6, 0.7
"""The emulated arm remembers a second: it is asked within that, and stands by then."""
LEAST_MM, TRIES = 0.2, 4
"""A trial of which the arm had hardly set out says nothing, and is made again."""
SPEEDS_MM_S = (20.0, 50.0, 5.0)
TRIES = 3
BETWEEN_S = 0.1
Trials = dict[str, list[float]]


class Child:
    """The process of one window; ``note`` holds when the lease was last renewed."""

    def __init__(self, environment: Mapping[str, str], lab: Path, note: Path) -> None:
        self.note = Note(note)
        command = [sys.executable, "-m", "tests.bench.lab_window", str(lab), str(note)]
        self.process = subprocess.Popen(
            command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.hear("ready")

    def hear(self, word: str) -> None:
        """Wait for a word."""
        assert self.process.stdout is not None
        said = self.process.stdout.readline().strip()
        if said != word:
            raise ChildProcessError(f"the window said '{said}', not '{word}'")

    def jog(self, speed_mm_s: float, way: str) -> None:
        """Begin a jog; returns when it is under way."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{speed_mm_s} {way}\n")
        self.process.stdin.flush()
        self.hear("going")

    def close(self) -> None:
        """End it as its user does."""
        self.process.communicate("", timeout=60.0)


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
        """Let the window freeze or lose what is held; return whether it says something."""
        said = self._measured(child, kind, way)
        child.hear("over")
        return said

    def is_stopped(self, child: Child) -> bool:
        """SIGSTOP, and SIGCONT when the arm has been seen to stand."""
        said = self._measured(child, "stopped", "nothing", signal.SIGSTOP)
        self._pause.wait(STOP_S - LOOK_S)
        child.process.send_signal(signal.SIGCONT)
        child.hear("over")
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


@figure("faults")
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

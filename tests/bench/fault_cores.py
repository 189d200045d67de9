"""A rig that shares its core with busy programs, over real sockets. Wall time, Linux.

Rig and busy programs have one core, the emulated devices and the backend the others.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from tests.backend.rig.served import Backend
from tests.bench.logged_arm import LoggedArm, Told
from tests.bench.registry import Figure, figure
from tests.busy_computer import STARVED
from touchdown.backend.config.hardware import HardwareSettings
from touchdown.backend.config.lab import is_loopback
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.scheduling import round_robin_priority
from touchdown.backend.core.values import Pose

PLACES = (Pose(0.0, 0.0, 120.0), Pose(0.0, 0.0, 70.0))
SPEED_MM_S, MOVES_S, WATCHED_S, REALTIME = 20.0, 8.0, 5.0, 50
MOST_SHARE, MOST_AHEAD = 0.5, 1.05
"""Half of the top speed of a joint; one late command and the next, with a tolerance for clocks."""
REFUSED = "RIG-STARVED"
LOOPBACK, ELSEWHERE = "127.0.0.1", ("192.0.2.1", 9)
"""The second (RFC 5737) is nobody: only the way there is asked for, and nothing is sent."""


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
TAKING = (Load(1, 20), Load(1, 60), Load(1, 150))
"""Below the first mark of the idle check (35 ms), between both, over the second (101 ms)."""
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
    """How a rig fared: ``outcome`` in words, and what the arm was told.

    ``code``: of what refused or ended it, "" if it went on.
    """

    outcome: str
    code: str
    told: Told

    @property
    def well(self) -> bool:
        """Whether it was warned, refused, held or went on, and never made a burst."""
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
    """Whether programs of this user may run at real-time priority."""
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


@figure("arm")
def rigs_that_share_a_core() -> list[Figure]:
    """Beside busy programs, and one that takes the core: outcome, and what the arm was told."""
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
                rows.append(Figure(what, 100.0 * told.left_out, "%", "stated", None,
                                   f"{one.outcome}; longest gap {told.gap_ms:.0f} ms, "
                                   f"{told.moves} commands"))  # fmt: skip
    share, ahead = (max(getattr(one.told, key) for one in ended) for key in ("share", "ahead"))
    wrong = [one.outcome for one in ended if not one.well]
    return [
        *rows,
        Figure("largest step of a rig that shares its core, of the top speed", share, "", "<= 0.5",
               share <= MOST_SHARE),
        Figure("its commands ahead of one a cycle, most", ahead, "", "<= 1, a late one and the "
               "next", ahead <= MOST_AHEAD),
        Figure("of those rigs neither warned, refused, held nor going on, or with a burst",
               len(wrong), "", "0", not wrong, "; ".join(wrong)),
    ]  # fmt: skip

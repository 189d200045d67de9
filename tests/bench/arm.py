"""Figures of the arm's driver: cycle times beside a busy interpreter, STOP, gaps of the stream."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

import numpy as np

from tests.backend.devices.emulated_arm import Rig
from tests.backend.devices.melfa.trials import trial
from tests.bench.arm_child import SPEED_MM_S, UP, driver, front
from tests.bench.registry import Figure, figure
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.values import Pose
from touchdown.backend.devices.melfa.realtime_protocol import CYCLE_S

SECONDS, BUSY, PRIORITY = 15.0, 1, 50
STOPS, TRIALS = 100, 500
GAPS_S = (0.06, 0.098)
Times = dict[str, float | str]
CHILD = [sys.executable, "-m", "tests.bench.arm_child"]


@contextmanager
def beside(*arguments: str) -> Iterator[str]:
    """Run a child until the block ends; gives the first line that it prints."""
    with subprocess.Popen(
        [*CHILD, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        try:
            yield child.stdout.readline() if arguments[0] == "emulate" else ""
        finally:
            child.stdin.close()
            child.wait(30.0)


def streamed(load: int, priority: int = 0) -> Times:
    """Return the cycle times of a driver in a process with ``load`` busy threads."""
    with beside("emulate") as served:
        done = subprocess.run(
            [*CHILD, "drive", served, str(SECONDS), str(load), str(priority)],
            capture_output=True,
            text=True,
            check=True,
            timeout=120.0,
        )
    found: Times = json.loads(done.stdout)
    return found


def share(found: Times) -> float:
    """Share in % of the wake-ups that came more than a cycle late."""
    return 100.0 * float(found["late"]) / float(found["wakes"])


def note(found: Times) -> str:
    """Return what else was counted."""
    skipped = 1.0 - float(found["wakes"]) / (SECONDS / CYCLE_S)
    fault = f", {found['fault']}" if found["fault"] else ""
    return (
        f"{found['wakes']} wake-ups, {100 * skipped:.0f} % of the cycles skipped, "
        f"latest {found['latest_ms']:.0f} ms, {found['holds']} holds{fault}"
    )


@figure("arm")
def cycle_times() -> list[Figure]:
    """Late wake-ups beside a busy interpreter: as a thread of it, and as a process of its own."""
    inside = streamed(BUSY)
    with beside("burn", str(BUSY)):
        apart, first = streamed(0), streamed(0, PRIORITY)
    thread, process, fifo = share(inside), share(apart), share(first)
    rows = [
        Figure("late cycles, thread of a busy process", thread, "%", "stated", None, note(inside)),
        Figure(
            "late cycles, process of its own beside it",
            process,
            "%",
            "<= 1/3 of the thread",
            process <= thread / 3.0,
            note(apart),
        ),
    ]
    ok = fifo <= thread / 10.0 if first["realtime"] else None
    why = note(first) if first["realtime"] else "no right to real-time priority here"
    rows.append(Figure("the same with SCHED_FIFO", fifo, "%", "<= 1/10 of the thread", ok, why))
    return rows


@figure("arm")
def stop_to_wire() -> list[Figure]:
    """Time from ``stop`` to its arrival at the emulated controller, while streaming."""
    served = front()
    served.start()
    arm = driver(served.settings)
    took_ms = []
    try:
        while len(took_ms) < STOPS:
            try:
                arm.connect(10.0, threading.Event())
                arm.move_to(UP, 5.0)
            except FaultError:
                # A stall of a shared machine has ended the stream: connect again.
                arm.close()
                continue
            threading.Event().wait(0.05)
            before = len(served.stops)
            asked_s = time.monotonic()
            arm.stop()
            while len(served.stops) == before:
                threading.Event().wait(0.001)
            took_ms.append(1e3 * (served.stops[before] - asked_s))
            threading.Event().wait(0.15)
    finally:
        arm.close()
        served.close()
    p99 = float(np.percentile(took_ms, 99))
    told = f"{STOPS} stops; median {np.median(took_ms):.2f}, worst {max(took_ms):.1f} ms"
    return [Figure("STOP to the controller's socket, p99", p99, "ms", "<= 20", p99 <= 20.0, told)]


@figure("arm")
def gaps() -> list[Figure]:
    """Largest step of the command after gaps of the stream, at 20 mm/s, on a hand-wound clock."""
    worst_mm, holds, count = 0.0, 0, 0
    for gap_s in GAPS_S:
        for own in (False, True):
            rig = Rig()
            rig.arm.connect(1.0, threading.Event())
            rig.arm.move_to(Pose(0.0, 0.0, 160.0), SPEED_MM_S)
            rig.rest(0.4)
            for _ in range(5):
                before = rig.arm.describe()["z_mm"]
                rig.wires.stalled, rig.wires.link.cut = own, not own
                rig.rest(gap_s)
                rig.wires.stalled = rig.wires.link.cut = False
                for _ in range(60):
                    rig.wires.advance(3500)
                    after = rig.arm.describe()["z_mm"]
                    worst_mm = max(worst_mm, abs(float(after) - float(before)))
                    before = after
                count += 1
            holds += rig.arm._core.holds
    ok = worst_mm <= 0.25 and holds == count
    told = f"{count} gaps of {', '.join(f'{1e3 * s:.0f}' for s in GAPS_S)} ms, {holds} holds"
    return [Figure("largest step after a gap of the stream", worst_mm, "mm", "<= 0.25", ok, told)]


@figure("arm")
def fault_campaign() -> list[Figure]:
    """Random faults in random motions on a hand-wound clock: what did not end as documented."""
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        ended = list(pool.map(trial, range(TRIALS), chunksize=10))
    broken = [one for one in ended if one.broken]
    told = (
        f"{len({one.fault for one in ended})} kinds; {broken[0]}"
        if broken
        else (f"{len({one.fault for one in ended})} kinds of faults in travels, jogs and presses")
    )
    text = f"faults of {TRIALS} not ended as documented, or with an unsafe command"
    return [Figure(text, len(broken), "", "0", not broken, told)]

"""Process-level machinery with and without: priorities, stall detection, announced waits, reserve.

Measurements with and without alternate, so that both sides meet the same load of the computer.
docs/decisions gives the results, and what was removed because it showed no effect.
"""

import contextlib
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import numpy as np

from tests.bench.arm import share, streamed
from tests.bench.figures import Figure, figure, stated
from tests.bench.worker_faults import measured_window
from touchdown.backend.core.scheduling import (
    blocking_section,
    raised_priority,
    round_robin_priority,
)
from touchdown.backend.core.stalled_processes import ProcessStallDetector
from touchdown.backend.runs.engine import ThreadWatchdog

PAIRS, WAKES, PERIOD_S, FIFO = 10, 500, 0.004, 50
LOOK_S, LOOKING_S, DISK_S = 0.05, 4.0, 1.0


def alternate(once: Callable[[bool], float], pairs: int = PAIRS) -> tuple[list[float], list[float]]:
    """Return ``pairs`` values with and without, measured by turns."""
    found: dict[bool, list[float]] = {True: [], False: []}
    for number in range(pairs):
        for used in (True, False) if number % 2 == 0 else (False, True):
            found[used].append(once(used))
    return found[True], found[False]


def compared(name: str, unit: str, used: Sequence[float], plain: Sequence[float]) -> list[Figure]:
    """Return the medians with and without; the note has the range and the pairs that improved."""
    better = sum(one < other for one, other in zip(used, plain, strict=True))
    return [
        stated(f"{name}, {which}", float(np.median(values)), unit,
               f"p90 {np.percentile(values, 90):.3g}, {min(values):.3g} to {max(values):.3g}; "
               f"lower with it in {better} of {len(values)} pairs")
        for which, values in (("with", used), ("without", plain))
    ]  # fmt: skip


def late_ms(priority: Callable[[], AbstractContextManager[bool]], used: bool) -> float:
    """Return the 99th percentile of how late a thread wakes that sleeps for 4 ms each time."""
    found: list[float] = []

    def wake() -> None:
        with priority() if used else contextlib.nullcontext():
            never, due_s = threading.Event(), time.monotonic()
            for _ in range(WAKES):
                due_s = max(due_s + PERIOD_S, time.monotonic())
                never.wait(due_s - time.monotonic())
                found.append(time.monotonic() - due_s)

    thread = threading.Thread(target=wake)
    thread.start()
    thread.join()
    return 1e3 * float(np.percentile(found, 99))


@figure("machinery", long=True)
def priorities() -> list[Figure]:
    """Lateness of a thread beside two busy programs, and late cycles of the arm's stream."""
    rows = []
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(2)]
    try:
        for name, priority in (("SCHED_RR of emulated devices", lambda: round_robin_priority(20)),
                               ("raised niceness of a session", raised_priority)):  # fmt: skip
            sides = alternate(lambda used, priority=priority: late_ms(priority, used))
            rows += compared(f"{name}: wakes late, p99", "ms", *sides)
    finally:
        for program in busy:
            program.kill()
            program.wait()
    sides = alternate(lambda used: share(streamed(0, FIFO if used else 0)))
    return rows + compared("SCHED_FIFO of the stream: late cycles", "%", *sides)


def alarms(announced: bool) -> float:
    """Return the alarms about a bench thread that waits for a slow disk again and again."""
    told, steps, over, begun = [], [0], threading.Event(), threading.Event()
    number: list[int] = []

    def bench() -> None:
        number.append(threading.get_native_id())
        begun.set()
        while not over.is_set():
            steps[0] += 1
            section = blocking_section("waits for the disk", 60.0)
            with section if announced else contextlib.nullcontext():
                threading.Event().wait(DISK_S)

    thread = threading.Thread(target=bench)
    thread.start()
    begun.wait()
    watchdog = ThreadWatchdog(number[0], lambda: steps[0], 0.02, told.append)
    end_s = time.monotonic() + LOOKING_S
    while time.monotonic() < end_s:
        watchdog.look(time.monotonic())
        over.wait(LOOK_S)
    over.set()
    thread.join()
    return float(len(told))


def stopped_s(_: bool) -> float:
    """Return the time until a process that hangs is recognised."""
    sleeps = "import time\nwhile True: time.sleep(0.01)"
    with subprocess.Popen([sys.executable, "-c", sleeps]) as child:
        detector, begun_s = ProcessStallDetector(child.pid), time.monotonic()
        child.send_signal(19)
        while not detector.look(time.monotonic()):
            threading.Event().wait(LOOK_S)
        child.kill()
    return time.monotonic() - begun_s


@figure("machinery", long=True)
def watchdogs() -> list[Figure]:
    """False alarms during announced waits, and the time until a hang is recognised."""
    return [
        *compared("announced waits: false alarms in 4 s", "", *alternate(alarms)),
        stated("stalled process: recognised after", float(np.median(alternate(stopped_s)[0])), "s"),
    ]


@figure("machinery", long=True)
def the_window() -> list[Figure]:
    """Decisions beside the window, full collections of garbage, and gaps of the window's ticks."""
    found = measured_window("machinery")
    return [
        *compared("repaint hold: decision beside the window", "ms", *found["latency_ms"]),
        *compared("frozen objects: full collection of garbage", "ms", *found["collected_ms"]),
        *compared("switch interval of 0.5 ms: longest gap in 5 s", "ms", *found["gap_ms"]),
    ]

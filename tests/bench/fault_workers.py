"""Workers that fail, threads that ask for the end, programs that die holding a lock. Wall time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import psutil

from tests.backend.devices.waiting import until
from tests.backend.rig.served import Backend, Served
from tests.bench.fault_window import HOOKS, THREADS, WAYS, failed_s
from tests.bench.registry import Figure, figure
from touchdown.backend.core.files import lock_file

ASKED, KILLS = 100, 20
TOLD_S, GONE_S, FREE_MS = 0.5, 3.0, 10.0
LIMIT_S = 180.0
WINDOW = "tests.bench.fault_window"
HOLDS = {
    "robot": "from touchdown.backend.devices.melfa.sockets import ControllerLock; "
    "it = ControllerLock('10.0.0.1', 10001)",
    "dataset": "from touchdown.backend.core.files import lock_file; from pathlib import Path; "
    "it = lock_file(Path('writer.lock'))",
}


@contextmanager
def hooked() -> Iterator[Mapping[str, str]]:
    """An environment whose interpreters fail on a signal, each in its way."""
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "sitecustomize.py").write_text(HOOKS)
        paths = [folder, str(Path.cwd()), os.environ.get("PYTHONPATH", "")]
        path = os.pathsep.join(filter(None, paths))
        yield {**os.environ, "PYTHONPATH": path, "QT_QPA_PLATFORM": "offscreen"}


def window(
    environment: Mapping[str, str], *words: str, module: str = WINDOW, limit_s: float = LIMIT_S
) -> dict[str, float | str]:
    """Let a worker of a window fail in a process of its own; return what came of it."""
    missed: dict[str, float | str] = {"told_s": limit_s, "closed_s": limit_s, "left": 0}
    try:
        done = subprocess.run(
            [sys.executable, "-m", module, *words], env=environment, capture_output=True, text=True,
            timeout=limit_s, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {**missed, "named": "nothing"}
    if done.returncode or not done.stdout:
        return {**missed, "named": (done.stderr.strip().splitlines() or ["nothing"])[-1]}
    found: dict[str, float | str] = json.loads(done.stdout.splitlines()[-1])
    return found


@figure("faults")
def failing_workers() -> list[Figure]:
    """Processes and threads that raise, leave, are killed, crash, stop or deadlock."""
    found: dict[str, dict[str, float | str]] = {}
    with hooked() as environment:
        for way in WAYS:
            found[f"training {way}"] = window(environment, "worker", "training", way)
        for way in ("raises", "deadlock"):
            found[f"bench {way}"] = window(environment, "worker", "bench", way)
        before = os.environ.get("PYTHONPATH")
        os.environ["PYTHONPATH"] = environment["PYTHONPATH"]
        try:
            found |= {f"rig {way}": rig(number) for way, number in WAYS.items()}
        finally:
            if before is None:
                del os.environ["PYTHONPATH"]
            else:
                os.environ["PYTHONPATH"] = before
    return [
        worst(found, "told_s", "a failing worker is named after, worst", "s", TOLD_S),
        worst(found, "closed_s", "everything is closed then after, worst", "s", GONE_S),
        worst(found, "left", "processes left", "", 0.0),
    ]


def rig(number: signal.Signals) -> dict[str, float | str]:
    """Let the rig fail while the arm moves; return what the backend made of it."""
    served = Served()
    backend = Backend(served.settings)
    try:
        backend.moving()
        process = psutil.Process(backend.link.hello["pid"])
        begun_s = time.monotonic()
        os.kill(process.pid, number)
        until(lambda: backend.interlock.latched)
        told_s = time.monotonic() - failed_s(process.pid, begun_s)
        named = backend.interlock.faults[0].code
        begun_s = time.monotonic()
        backend.close()
        closed_s = time.monotonic() - begun_s
    finally:
        backend.close()
        served.close()
    return {"told_s": told_s, "named": named, "closed_s": closed_s, "left": process.is_running()}


def worst(
    found: Mapping[str, Mapping[str, float | str]], key: str, name: str, unit: str, most: float
) -> Figure:
    """Return the largest of one value over all workers and ways."""
    values = {case: float(one[key]) for case, one in found.items()}
    case = max(values, key=lambda one: values[one])
    over = [f"{one} {value:.2f} ({found[one]['named']})" for one, value in values.items()
            if value > most]  # fmt: skip
    told = f"{case}; {len(values)} cases" + "".join(f"; {one}" for one in over)
    return Figure(name, values[case], unit, f"<= {most:g}", values[case] <= most, told)


@figure("faults")
def quitting_asked_for_by_workers(asked: int = ASKED) -> list[Figure]:
    """Each kind of thread asks for the end of the window: until its process is gone."""
    took_s: list[tuple[float, str]] = []
    for number in range(asked):
        thread = THREADS[number % len(THREADS)]
        with (
            hooked() as environment,
            subprocess.Popen(
                [sys.executable, "-m", WINDOW, "quit", thread],
                env=environment,
                stdout=subprocess.PIPE,
                text=True,
            ) as child,
        ):
            assert child.stdout is not None
            said = child.stdout.readline()
            try:
                child.wait(LIMIT_S)
                took_s.append((time.monotonic() - float(said), thread))
            except (subprocess.TimeoutExpired, ValueError):
                child.kill()
                took_s.append((LIMIT_S, thread))
    in_time = sum(taken_s <= GONE_S for taken_s, _ in took_s)
    slowest_s, thread = max(took_s)
    told = f"slowest {slowest_s:.2f} s ({thread}); threads: {', '.join(THREADS)}"
    name = "gone within 3 s of being asked by a worker"
    return [Figure(name, f"{in_time} of {asked}", "", "all", in_time == asked, told)]


@figure("faults")
def locks_of_killed_programs() -> list[Figure]:
    """From kill -9 of who holds the robot, or a dataset, until its lock can be taken.

    A second program that is refused at the robot tries again every 20 ms by itself.
    """
    rows = []
    for kind, code in HOLDS.items():
        took_ms = [_freed_ms(code) for _ in range(KILLS)]
        told = f"{KILLS} kills; median {sorted(took_ms)[KILLS // 2]:.1f} ms"
        name, worst_ms = f"{kind} free after kill -9, worst", max(took_ms)
        rows.append(Figure(name, worst_ms, "ms", "<= 10", worst_ms <= FREE_MS, told))
    return rows


def _freed_ms(code: str) -> float:
    held = f"import sys, tempfile; tempfile.tempdir = '.'; {code}; print(1, flush=True); input()"
    with tempfile.TemporaryDirectory() as folder:
        command: Sequence[str] = [sys.executable, "-c", held]
        with subprocess.Popen(
            command, cwd=folder, env={**os.environ, "PYTHONPATH": str(Path.cwd())},
            stdin=subprocess.PIPE, stdout=subprocess.PIPE,
        ) as child:  # fmt: skip
            assert child.stdout is not None
            child.stdout.readline()
            (path,) = Path(folder).glob("*.lock")
            assert not _taken(path)
            pause, begun_s = threading.Event(), time.monotonic()
            child.kill()
            while not _taken(path):
                pause.wait(0.0002)
            return 1e3 * (time.monotonic() - begun_s)


def _taken(path: Path) -> bool:
    try:
        os.close(lock_file(path))
    except BlockingIOError:
        return False
    return True

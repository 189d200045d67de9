"""Failing workers without a window: the emulated bench, the reader of a file, a pool. Wall time."""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil

from tests.backend.devices.waiting import until
from tests.backend.exchange.test_foreign import robomimic_file
from tests.bench.fault_window import WAYS, failed_s
from tests.bench.fault_workers import GONE_S, TOLD_S, hooked, worst
from tests.bench.registry import Figure, figure
from touchdown.backend.bench.assembly import SimulatedBenchChoice
from touchdown.backend.bench.emulated import EmulatedBench
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.exchange.imports import read_foreign
from touchdown.backend.jobs.execution import ProcessPool
from touchdown.backend.jobs.job import JobContext, JobSpec, JobStore
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import SceneChoice

READS = ("raises", "leaves", "killed", "crashes", "stopped", "deadlock")
SERVES = ("raises", "leaves", "killed", "crashes", "stopped")
"""Its devices go on without the thread that waits for the next scene: a deadlock of that one is
told with the next scene."""
NAMES = {"BENCH-GONE", "BENCH-STILL"}
NEXT_SCENE_S = 15.0
BEGUN_S = 0.1
"""Of its processor: a reader is done with a small file after some more."""
Found = dict[str, float | str]


def work(spec: JobSpec, _: JobContext) -> Mapping[str, Any]:
    """Compute until there is a file that ends it."""
    end = Path(str(spec.params["end"]))
    while not end.exists():
        sum(range(100_000))
    return {}


@contextmanager
def failing_children() -> Iterator[None]:
    """Let all interpreters that are started meanwhile fail on a signal, each in its way."""
    before = os.environ.get("PYTHONPATH")
    with hooked() as environment:
        os.environ["PYTHONPATH"] = environment["PYTHONPATH"]
        try:
            yield
        finally:
            if before is None:
                del os.environ["PYTHONPATH"]
            else:
                os.environ["PYTHONPATH"] = before


def strike(number: int, way: str, told: Callable[[], str]) -> Found:
    """Let the process fail; return who was named, and how long after it had."""
    asked_s = time.monotonic()
    os.kill(number, WAYS[way])
    until(told)
    return {"told_s": time.monotonic() - failed_s(number, asked_s), "named": told()}


def closed(found: Found, close: Callable[[], object], before: set[psutil.Process]) -> Found:
    """Close what is left; add how long that took, and what is left even then."""
    begun_s = time.monotonic()
    close()
    found["closed_s"] = time.monotonic() - begun_s
    found["left"] = len(children() - before)
    return found


def children() -> set[psutil.Process]:
    """Return the processes of this one."""
    return set(psutil.Process().children(recursive=True))


def emulated(way: str) -> Found:
    """The process of the emulated bench, while a live session stands on it."""
    before = children()
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(None))
    try:
        bench.session.prepare(SceneChoice())
        bench.session.open()
        (number,) = (p.pid for p in children() - before if "emulated_child" in p.cmdline()[-1])

        def told() -> str:
            codes = {fault.code for fault in bench.session.interlock.faults}
            return ", ".join(codes & NAMES)

        found = strike(number, way, told)
    except BaseException:
        bench.close()
        raise
    return closed(found, bench.close, before)


def next_scene() -> Found:
    """The thread that waits for the next scene deadlocks: what asking for that comes to."""
    before = children()
    bench = EmulatedBench(SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(None))
    try:
        bench.session.prepare(SceneChoice())
        (child,) = (p for p in children() - before if "emulated_child" in p.cmdline()[-1])
        os.kill(child.pid, WAYS["deadlock"])
        until(lambda: failed_s(child.pid, 0.0))
        asked_s, named = time.monotonic(), "nothing"
        try:
            bench.session.prepare(SceneChoice())
        except FaultError as error:
            named = error.fault.code
        found: Found = {"told_s": time.monotonic() - asked_s, "named": named}
        bench.session.prepare(SceneChoice())
    finally:
        begun_s = time.monotonic()
        bench.close()
    found["left"], found["closed_s"] = len(children() - before), time.monotonic() - begun_s
    return found


def reading(way: str) -> Found:
    """The reader of a foreign file, as soon as it is at work."""
    before, said = children(), list[str]()
    with tempfile.TemporaryDirectory() as folder:
        path = robomimic_file(Path(folder) / "demo.hdf5")

        def read() -> None:
            try:
                list(read_foreign("robomimic", path))
            except InputError as error:
                said.append(error.what)

        thread = threading.Thread(target=read)
        thread.start()
        until(lambda: children() - before)
        (child,) = children() - before
        until(lambda: child.cpu_times().user > BEGUN_S)
        found = strike(child.pid, way, lambda: "".join(said))
        return closed(found, thread.join, before)


class Told(Exception):  # noqa: N818 - what Ctrl-C is for its operator
    """Ends the wait for jobs as soon as something was told."""


def pooled(way: str) -> Found:
    """A worker of a pool, amid a job; whoever waits for it gives up when he is told."""
    before, said = children(), list[str]()

    def tell(text: str) -> None:
        said.append(text)
        raise Told

    with tempfile.TemporaryDirectory() as folder:
        end = Path(folder) / "end"
        pool = ProcessPool({"work": work}, JobStore(Path(folder) / "store"), 1, tell)
        job = JobSpec("work", {"end": str(end)})
        pool.submit(job)
        (worker,) = children() - before - trackers()
        until(lambda: pool._workers.has_begun(job.id))
        asked_s = time.monotonic()
        os.kill(worker.pid, WAYS[way])
        with suppress(Told):
            said.extend(result.error.splitlines()[-1] for result in pool.finished())
        told_s = time.monotonic() - failed_s(worker.pid, asked_s)
        found: Found = {"told_s": told_s, "named": said[0]}
        return closed(found, pool.close, before | trackers())


def trackers() -> set[psutil.Process]:
    """Return what the library keeps for the life of this process, beside its workers."""
    return {one for one in children() if "resource_tracker" in " ".join(one.cmdline())}


@figure("faults")
def failing_children_without_a_window() -> list[Figure]:
    """The emulated bench, the reader of an import and the workers of a pool, in every way."""
    found: dict[str, Found] = {}
    with failing_children():
        found |= {f"import {way}": reading(way) for way in READS}
        found |= {f"pool {way}": pooled(way) for way in WAYS}
        found |= {f"emulated bench {way}": emulated(way) for way in SERVES}
        later = {"next scene deadlock": next_scene()}
    named = later["next scene deadlock"]["named"]
    text = f"a scene that is never set is told after ({named})"
    found |= {case: {**one, "told_s": 0.0} for case, one in later.items()}
    return [
        worst(later, "told_s", text, "s", NEXT_SCENE_S),
        worst(found, "told_s", "a failing child is named after, worst", "s", TOLD_S),
        worst(found, "closed_s", "everything is closed after it, worst", "s", GONE_S),
        worst(found, "left", "processes left after it", "", 0.0),
    ]

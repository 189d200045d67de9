"""The processes of a pool: which job each has, and whether it stands still amid it."""

from __future__ import annotations

import multiprocessing
import os
import time
from collections.abc import Callable, Collection, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing.queues import SimpleQueue

import psutil  # type: ignore[import-untyped]

from backend.core.niceness import step_back
from backend.core.standstill import Standstill
from backend.jobs.running import JobResult, Kinds
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore

LOOK_S = 0.05
END_S = 1.0
"""A worker without a job ends at once; one that is stopped never does."""
Begun = tuple[int, str]
"""Number of a process, and the job that it begins ("" before its first)."""


class Workers:
    """``pool`` makes a pool whose workers say here what they begin."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._begun: SimpleQueue[Begun] = self._context.SimpleQueue()
        self._jobs: dict[int, tuple[str, Standstill]] = {}
        self._still: set[int] = set()

    def pool(self, count: int) -> ProcessPoolExecutor:
        """Return a pool of ``count`` spawned processes."""
        return ProcessPoolExecutor(count, self._context, _arrive, (self._begun,))

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Take those that are spawned meanwhile for workers of this pool."""
        before = set(multiprocessing.active_children())
        yield
        for process in set(multiprocessing.active_children()) - before:
            if process.pid is not None:
                self._note(process.pid, "")

    def has_begun(self, job: str) -> bool:
        """Whether a worker has begun the job."""
        self._take()
        return any(job == one for one, _ in self._jobs.values())

    def look(self, under_way: Collection[str]) -> tuple[dict[int, str], set[int]]:
        """Return who stands still amid which of those jobs, and who of them does so since now.

        One that stands still before its first job, which waits for it, is amid "".
        """
        self._take()
        begun = {job for job, _ in self._jobs.values()}
        wanted = {*under_way} if begun.issuperset(under_way) else {*under_way, ""}
        still = {}
        for number, (job, watch) in self._jobs.items():
            if watch.look(time.monotonic()) and job in wanted:
                still[number] = job
        news, self._still = set(still) - self._still, set(still)
        return still, news

    def kill(self, numbers: Iterable[int]) -> None:
        """End those processes now."""
        for number in numbers:
            with suppress(psutil.NoSuchProcess):
                psutil.Process(number).kill()

    def end(self) -> None:
        """Wait for all to end, for a while; afterwards none is there."""
        there = []
        for number in self._jobs:
            with suppress(psutil.NoSuchProcess):
                there.append(psutil.Process(number))
        _, left = psutil.wait_procs(there, END_S)
        self.kill(process.pid for process in left)
        psutil.wait_procs(left, END_S)

    def _take(self) -> None:
        while not self._begun.empty():
            self._note(*self._begun.get())

    def _note(self, number: int, job: str) -> None:
        with suppress(psutil.NoSuchProcess):
            self._jobs[number] = job, Standstill(number)


_here: list[SimpleQueue[Begun]] = []
"""Of a worker: where it says what it begins."""


def _arrive(begun: SimpleQueue[Begun]) -> None:
    step_back()
    _here.append(begun)


def in_worker(
    run: Callable[[JobSpec, Kinds, JobStore], JobResult],
    spec: JobSpec,
    kinds: Kinds,
    store: JobStore,
) -> JobResult:
    """Say that this worker begins the job, and do it."""
    _here[0].put((os.getpid(), spec.id))
    return run(spec, kinds, store)

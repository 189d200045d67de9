"""Execution of dependent jobs, in this process or in a pool of spawned processes.

A campaign runs each job once, after the jobs whose results it reads.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing.queues import SimpleQueue
from typing import Protocol

import psutil

from touchdown.backend.core import InputError, ProcessStallDetector, lower_priority
from touchdown.backend.jobs.job import JobFunctions, JobResult, JobSpec, JobStore, run_job

POLL_S = 0.05
EXIT_TIMEOUT_S = 1.0  # an idle worker ends at once; a stopped one never does
JobStart = tuple[int, str]  # process id and id of the job that it starts ("" before its first job)


class PoolWorkers:
    """Worker processes of a pool, which report the jobs they start."""

    def __init__(self) -> None:
        self._context = multiprocessing.get_context("spawn")
        self._begun: SimpleQueue[JobStart] = self._context.SimpleQueue()
        self._jobs: dict[int, tuple[str, ProcessStallDetector]] = {}
        self._still: set[int] = set()

    def pool(self, count: int) -> ProcessPoolExecutor:
        """Return a pool of ``count`` spawned processes."""
        return ProcessPoolExecutor(count, self._context, _register_worker, (self._begun,))

    @contextmanager
    def starting(self) -> Iterator[None]:
        """Register processes spawned in the block as workers of this pool."""
        before = set(multiprocessing.active_children())
        _block_interrupts(block=True)  # inherited
        try:
            yield
        finally:
            _block_interrupts(block=False)
        for process in set(multiprocessing.active_children()) - before:
            if process.pid is not None:
                self._note(process.pid, "")

    def has_begun(self, job: str) -> bool:
        """Return True if a worker has started the job."""
        self._take()
        return any(job == one for one, _ in self._jobs.values())

    def look(self, under_way: Collection[str]) -> tuple[dict[int, str], set[int]]:
        """Return stalled workers with their jobs of ``under_way``, and the newly stalled ones.

        A worker that is stalled before its first job has the job "".
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
        """Kill these processes."""
        for number in numbers:
            with suppress(psutil.NoSuchProcess):
                psutil.Process(number).kill()

    def end(self) -> None:
        """Wait for all workers to exit; kill the rest after a timeout."""
        there = []
        for number in self._jobs:
            with suppress(psutil.NoSuchProcess):
                there.append(psutil.Process(number))
        _, left = psutil.wait_procs(there, EXIT_TIMEOUT_S)
        self.kill(process.pid for process in left)
        psutil.wait_procs(left, EXIT_TIMEOUT_S)

    def _take(self) -> None:
        while not self._begun.empty():
            self._note(*self._begun.get())

    def _note(self, number: int, job: str) -> None:
        with suppress(psutil.NoSuchProcess):
            self._jobs[number] = job, ProcessStallDetector(number)


_job_starts: list[SimpleQueue[JobStart]] = []  # in a worker: queue that reports the jobs it starts


def _register_worker(begun: SimpleQueue[JobStart]) -> None:
    # Ctrl-C reaches the workers too. They end, also while they start, without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    _block_interrupts(block=False)
    lower_priority()
    _job_starts.append(begun)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _block_interrupts(*, block: bool) -> None:
    if sys.platform != "win32":
        how = signal.SIG_BLOCK if block else signal.SIG_UNBLOCK
        signal.pthread_sigmask(how, {signal.SIGINT})


def _end_with_parent() -> None:
    # A killed parent closes no queue: its workers would wait for jobs for ever.
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def run_in_worker(
    run: Callable[[JobSpec, JobFunctions, JobStore], JobResult],
    spec: JobSpec,
    kinds: JobFunctions,
    store: JobStore,
) -> JobResult:
    """Report the start of the job, and run it."""
    _job_starts[0].put((os.getpid(), spec.id))
    return run(spec, kinds, store)


MAX_WORKER_DEATHS = 2  # A job is repeated at most this often after its worker died
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Executor(Protocol):
    """Accepts jobs while it has room, and returns finished ones."""

    def room(self) -> int:
        """Return the number of jobs it would start at once."""

    def submit(self, spec: JobSpec) -> None:
        """Begin a job."""

    def finished(self) -> list[JobResult]:
        """Wait for at least one of the started jobs; at least one was started."""

    def close(self) -> None:
        """Discard jobs that were not started, and release all workers."""


class SerialExecutor:
    """One job after the other in this process."""

    def __init__(self, kinds: JobFunctions, store: JobStore) -> None:
        self._kinds, self._store = kinds, store
        self._next: list[JobSpec] = []

    def room(self) -> int:
        """One at a time."""
        return 1 - len(self._next)

    def submit(self, spec: JobSpec) -> None:
        """Keep the job for ``finished``."""
        self._next.append(spec)

    def finished(self) -> list[JobResult]:
        """Run the job now."""
        return [run_job(self._next.pop(), self._kinds, self._store)]

    def close(self) -> None:
        """Discard the waiting job."""
        self._next.clear()


class ProcessPool:
    """Spawned processes of one thread each, at low priority.

    When a worker dies, the running jobs are repeated in a new pool, at most ``MAX_WORKER_DEATHS``
    times each. ``tell`` receives a message about a dead or stalled worker within half a second; a
    stalled worker is killed only by ``close``.
    """

    def __init__(
        self,
        kinds: JobFunctions,
        store: JobStore,
        workers: int,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._kinds, self._store, self._count, self._tell = kinds, store, workers, tell
        self._running: dict[Future[JobResult], JobSpec] = {}
        self._deaths: Counter[str] = Counter()
        self._workers = PoolWorkers()
        self._pool = self._new_pool()

    def room(self) -> int:
        """Return the number of idle workers."""
        return self._count - len(self._running)

    def submit(self, spec: JobSpec) -> None:
        """Submit the job to a worker."""
        try:
            future = self._submitted(spec)
        except BrokenProcessPool:
            self._pool = self._new_pool()
            future = self._submitted(spec)
        self._running[future] = spec

    def finished(self) -> list[JobResult]:
        """Wait for finished jobs; jobs of a dead worker are started again."""
        while True:
            ended, _ = wait(self._running, POLL_S, return_when=FIRST_COMPLETED)
            results: list[JobResult] = []
            orphans: list[JobSpec] = []
            for future in ended:
                spec = self._running.pop(future)
                try:
                    results.append(future.result())
                except BrokenProcessPool:
                    orphans.append(spec)
            self._report_stalled()
            results += self._resubmit(orphans)
            if results:
                return results

    def close(self) -> None:
        """Finish the running jobs, start no others, end all workers; kill stalled ones."""
        # A shutdown that does not wait leaves its thread, whose end disturbs the exit of Python.
        ending = threading.Thread(target=lambda: self._pool.shutdown(cancel_futures=True))
        ending.start()
        while any(
            self._workers.has_begun(self._running[future].id)
            for future in wait(self._running, POLL_S).not_done
        ):
            still, _ = self._workers.look({spec.id for spec in self._running.values()})
            self._workers.kill(still)
        self._workers.end()
        ending.join()
        self._running.clear()

    def _submitted(self, spec: JobSpec) -> Future[JobResult]:
        with _single_threaded(), self._workers.starting():
            return self._pool.submit(run_in_worker, run_job, spec, self._kinds, self._store)

    def _report_stalled(self) -> None:
        under_way = {spec.id: spec.kind for spec in self._running.values()}
        still, news = self._workers.look(under_way)
        for number in news:
            kind = under_way.get(still[number])
            amid = f"in the job '{kind}'" if kind else "before its first job"
            self._tell(
                f"A worker is stalled {amid} (process {number}). "
                "Resume the process, or end it: its job is then started again."
            )

    def _resubmit(self, orphans: list[JobSpec]) -> list[JobResult]:
        lost: list[JobResult] = []
        if orphans:
            kinds = ", ".join(f"'{spec.kind}'" for spec in orphans)
            self._tell(f"A worker died while running the jobs {kinds}.")
        for spec in orphans:
            self._deaths[spec.id] += 1
            if self._deaths[spec.id] > MAX_WORKER_DEATHS:
                why = f"Its worker died {self._deaths[spec.id]} times: {spec.canonical()}"
                lost.append(JobResult(spec.id, spec.kind, "failed", error=why))
            else:
                self.submit(spec)
        return lost

    def _new_pool(self) -> ProcessPoolExecutor:
        self._workers = PoolWorkers()
        return self._workers.pool(self._count)


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Workers spawned in the block use one thread for linear algebra.

    The libraries read these variables once, on import.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def run_campaign(
    specs: Iterable[JobSpec], executor: Executor, store: JobStore
) -> Iterator[JobResult]:
    """Yield each job when it ends: first those finished before, then in order of completion.

    A job starts when its inputs among the jobs of the campaign are done. Jobs that depend on a
    failed job fail too. The executor is closed at the end, also if the iteration stops early.
    """
    waiting = {spec.id: spec for spec in specs}
    ahead = set(waiting)
    failed: set[str] = set()
    running = 0
    try:
        for spec in [spec for spec in waiting.values() if store.has(spec.id)]:
            del waiting[spec.id]
            ahead.discard(spec.id)
            yield JobResult(spec.id, spec.kind, "done")
        while waiting or running:
            for spec in list(waiting.values()):
                if cause := failed & set(spec.inputs):
                    del waiting[spec.id]
                    failed.add(spec.id)
                    ahead.discard(spec.id)
                    why = f"It needs the failed job {min(cause)}."
                    yield JobResult(spec.id, spec.kind, "failed", error=why)
            ready = [spec for spec in waiting.values() if not ahead & set(spec.inputs)]
            for spec in ready[: max(executor.room(), 0)]:
                del waiting[spec.id]
                executor.submit(spec)
                running += 1
            if not running:
                continue
            for result in executor.finished():
                running -= 1
                ahead.discard(result.id)
                if result.state == "failed":
                    failed.add(result.id)
                yield result
    finally:
        executor.close()


def shard_of(specs: Sequence[JobSpec], index: int, count: int) -> list[JobSpec]:
    """Return part ``index`` (from 0) of ``count``, for array schedulers.

    Every ``count``-th of the sorted ids is taken, so that processes need no communication. A job
    whose inputs belong to another part is left for a later call.
    """
    return [
        spec for k, spec in enumerate(sorted(specs, key=lambda spec: spec.id)) if k % count == index
    ]


def parse_shard(text: str) -> tuple[int, int]:
    """Return (i, n) of a text "i/n" with 0 <= i < n; raises ``InputError``."""
    index, slash, count = text.partition("/")
    if slash and index.isdecimal() and count.isdecimal() and int(index) < int(count):
        return int(index), int(count)
    raise InputError(f"'{text}' is not a part.", "--shard", "Give i/n with i from 0 to n - 1.")


def independent_jobs(
    specs: Iterable[JobSpec], part: Iterable[JobSpec], store: JobStore
) -> list[JobSpec]:
    """Return those of ``part`` that need no unfinished job outside ``part``."""
    chosen = {spec.id: spec for spec in part}
    outside = {spec.id for spec in specs if not store.has(spec.id)} - set(chosen)
    while True:
        blocked = {k for k, spec in chosen.items() if outside & set(spec.inputs)}
        if not blocked:
            return list(chosen.values())
        outside |= blocked
        chosen = {k: spec for k, spec in chosen.items() if k not in blocked}

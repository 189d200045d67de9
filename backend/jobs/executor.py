"""What runs jobs: in this process, or in spawned ones on this machine."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Protocol

from backend.jobs.running import JobResult, Kinds, run_job
from backend.jobs.spec import JobSpec
from backend.jobs.store import JobStore
from backend.jobs.workers import LOOK_S, Workers, in_worker

DEATHS = 2
"""A job that was under way when a worker died is tried again this often."""
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Executor(Protocol):
    """Takes jobs as long as it has room, and hands back finished ones."""

    def room(self) -> int:
        """Return how many more jobs it would start at once."""

    def submit(self, spec: JobSpec) -> None:
        """Begin a job."""

    def finished(self) -> list[JobResult]:
        """Wait for at least one of the begun jobs; at least one was begun."""

    def close(self) -> None:
        """Drop what was not begun, and let go of all workers."""


class Serial:
    """One job after the other in this process."""

    def __init__(self, kinds: Kinds, store: JobStore) -> None:
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
        """Nothing to let go of."""
        self._next.clear()


class LocalPool:
    """Spawned processes of one thread each, at low priority.

    When a worker is killed, the jobs that were under way are tried again in a new pool, at most
    ``DEATHS`` times each; what was finished stays finished. ``tell`` hears of a worker that died or
    stands still, within half a second; one that stands still is left to itself until ``close``.
    """

    def __init__(
        self,
        kinds: Kinds,
        store: JobStore,
        workers: int,
        tell: Callable[[str], None] = lambda text: None,
    ) -> None:
        self._kinds, self._store, self._count, self._tell = kinds, store, workers, tell
        self._running: dict[Future[JobResult], JobSpec] = {}
        self._deaths: Counter[str] = Counter()
        self._workers = Workers()
        self._pool = self._new_pool()

    def room(self) -> int:
        """No more than there are workers: then a death concerns few jobs."""
        return self._count - len(self._running)

    def submit(self, spec: JobSpec) -> None:
        """Hand the job to a worker."""
        try:
            future = self._submitted(spec)
        except BrokenProcessPool:
            self._pool = self._new_pool()
            future = self._submitted(spec)
        self._running[future] = spec

    def finished(self) -> list[JobResult]:
        """Return the jobs that ended; those of a dead worker begin again."""
        while True:
            ended, _ = wait(self._running, LOOK_S, return_when=FIRST_COMPLETED)
            results: list[JobResult] = []
            orphans: list[JobSpec] = []
            for future in ended:
                spec = self._running.pop(future)
                try:
                    results.append(future.result())
                except BrokenProcessPool:
                    orphans.append(spec)
            self._look()
            results += self._again(orphans)
            if results:
                return results

    def close(self) -> None:
        """Finish the jobs under way, start none, end the workers; those that stand still at once.

        Afterwards no process is left.
        """
        self._pool.shutdown(wait=False, cancel_futures=True)
        while any(
            self._workers.has_begun(self._running[future].id)
            for future in wait(self._running, LOOK_S).not_done
        ):
            still, _ = self._workers.look({spec.id for spec in self._running.values()})
            self._workers.kill(still)
        self._workers.end()
        self._pool.shutdown(wait=True)
        self._running.clear()

    def _submitted(self, spec: JobSpec) -> Future[JobResult]:
        with _one_thread_each(), self._workers.starting():
            return self._pool.submit(in_worker, run_job, spec, self._kinds, self._store)

    def _look(self) -> None:
        """Tell of workers that stand still amid a job."""
        under_way = {spec.id: spec.kind for spec in self._running.values()}
        still, news = self._workers.look(under_way)
        for number in news:
            kind = under_way.get(still[number])
            amid = f"amid the job '{kind}'" if kind else "before its first job"
            self._tell(
                f"A worker stands still {amid} (process {number}): nothing in it "
                "wants to run. Let it go on, or end it: its job begins again then."
            )

    def _again(self, orphans: list[JobSpec]) -> list[JobResult]:
        lost: list[JobResult] = []
        if orphans:
            kinds = ", ".join(f"'{spec.kind}'" for spec in orphans)
            self._tell(f"A worker died; under way were the jobs {kinds}.")
        for spec in orphans:
            self._deaths[spec.id] += 1
            if self._deaths[spec.id] > DEATHS:
                why = f"Its worker died {self._deaths[spec.id]} times: {spec.canonical()}"
                lost.append(JobResult(spec.id, spec.kind, "failed", error=why))
            else:
                self.submit(spec)
        return lost

    def _new_pool(self) -> ProcessPoolExecutor:
        self._workers = Workers()
        return self._workers.pool(self._count)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Let workers that are spawned meanwhile use one thread for linear algebra.

    The libraries read these variables once, as they load, and two threads beside another worker
    cost more than they bring.
    """
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

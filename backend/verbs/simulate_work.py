"""The work of ``touchdown simulate``: here, or shared out over spawned processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from multiprocessing.sharedctypes import Synchronized

from backend.dataset.pack_file import write_packs
from backend.experiments.collection import Job, metadata_of, rows_of
from backend.simulation.episodes import EpisodeBatch, simulate

POLL_S = 0.2


def run_jobs(jobs: Sequence[Job], workers: int, advance: Callable[[int], None]) -> int:
    """Run all jobs, here or in ``workers`` processes; returns the number of probes drawn again.

    ``advance`` gets the number of finished episodes. An error in a job stops the rest.
    """
    workers = min(workers, len(jobs))
    if workers == 1:
        return _run_here(jobs, advance)
    context = multiprocessing.get_context("spawn")
    finished = context.Value("q", 0)
    rejected = 0
    with ProcessPoolExecutor(workers, context, initializer=_count_in, initargs=(finished,)) as pool:
        waiting = {pool.submit(run_job, job) for job in jobs}
        try:
            while waiting:
                done, waiting = wait(waiting, timeout=POLL_S, return_when=FIRST_COMPLETED)
                rejected += sum(future.result() for future in done)
                advance(int(finished.value))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return rejected


def _run_here(jobs: Sequence[Job], advance: Callable[[int], None]) -> int:
    """Spare a process that would first have to load everything anew."""
    finished = 0

    def count(episodes: int) -> None:
        nonlocal finished
        finished += episodes
        advance(finished)

    return sum(run_job(job, count) for job in jobs)


def run_job(job: Job, count: Callable[[int], None] | None = None) -> int:
    """Simulate and write one job; returns the number of probes drawn again.

    ``count`` gets the size of each batch; without it the counter of this worker does.
    """
    batches: list[EpisodeBatch] = []
    for batch in simulate(job.plan, job.grips):
        batches.append(batch)
        (count or _count)(len(batch.episode))
    write_packs(job.folder, job.stem, rows_of(job, batches), metadata_of(job))
    return sum(batch.rejected for batch in batches)


_finished: Synchronized[int] | None = None


def _count_in(finished: Synchronized[int]) -> None:
    """Let this worker count its episodes in the parent's counter (set once, as it starts)."""
    global _finished
    _finished = finished


def _count(episodes: int) -> None:
    if _finished is not None:
        with _finished.get_lock():
            _finished.value += episodes

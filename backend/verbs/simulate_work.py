"""The work of ``touchdown simulate``, shared out over spawned processes."""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from pathlib import Path

import numpy as np

from backend.dataset.pack_file import EpisodeRow, write_packs
from backend.dataset.rows import patch_hex
from backend.simulation.episodes import EpisodeBatch, Plan, simulate

GRIPS_PER_JOB = 20
"""Grips solved side by side when a gripping has many probes."""
PROBES_PER_JOB = 128
"""At least this many probes make a job, whatever the number of probes per grip."""
POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Job:
    """Some grips of one plan, for one or more pack files of their own."""

    plan: Plan
    grips: range
    label: Mapping[str, object]
    folder: Path
    stem: str

    @property
    def episodes(self) -> int:
        """Number of episodes this job makes."""
        return sum(self.plan.probes_of(grip) for grip in self.grips)


def jobs_of(plan: Plan, label: Mapping[str, object], folder: Path) -> list[Job]:
    """Cut a plan into jobs; the cut depends on the plan only, so that results do too."""
    size = max(GRIPS_PER_JOB, -(-PROBES_PER_JOB // plan.probes_per_grip))
    stem = f"{plan.piece}-{plan.bottom}"
    return [
        Job(plan, range(start, min(start + size, plan.grips)), label, folder, f"{stem}-{k:03d}")
        for k, start in enumerate(range(0, plan.grips, size))
    ]


def run_jobs(jobs: Sequence[Job], workers: int, advance: Callable[[int], None]) -> int:
    """Run all jobs in ``workers`` spawned processes; returns the number of probes drawn again.

    ``advance`` gets the number of finished episodes. An error in a job stops the rest.
    """
    context = multiprocessing.get_context("spawn")
    finished = context.Value("q", 0)
    rejected = 0
    with ProcessPoolExecutor(
        min(workers, len(jobs)), context, initializer=_count_in, initargs=(finished,)
    ) as pool:
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


def run_job(job: Job) -> int:
    """Simulate and write one job; returns the number of probes drawn again."""
    batches: list[EpisodeBatch] = []
    for batch in simulate(job.plan, job.grips):
        batches.append(batch)
        _count(len(batch.episode))
    write_packs(job.folder, job.stem, rows_of(job, batches), _metadata(job))
    return sum(batch.rejected for batch in batches)


def rows_of(job: Job, batches: Sequence[EpisodeBatch]) -> Iterator[EpisodeRow]:
    """Yield the episodes in order of their number, with labels."""
    plan, pair = job.plan, f"{job.plan.piece}-{job.plan.bottom}-{job.plan.seed}"
    places = [(int(n), batch, i) for batch in batches for i, n in enumerate(batch.episode)]
    for number, batch, i in sorted(places, key=lambda place: place[0]):
        x_um, y_um = np.rint(1e3 * batch.offset_mm[i]).astype(int).tolist()
        label = {
            "episode": f"{pair}-{number}",
            "x_um": x_um,
            "y_um": y_um,
            "sigma_um": label_sigma_um(plan),
            "source": "commanded",
            "piece": plan.piece,
            "bottom": plan.bottom,
            "patch": patch_hex(batch.patch[i]),
            "points": len(plan.face_points_mm),
            "grip_id": f"{pair}-g{batch.grip[i]}",
            "mounting_id": f"{pair}-m{batch.mounting[i]}",
            "person": "simulation",
            "seed": plan.seed,
            **job.label,
        }
        yield EpisodeRow(batch.observation[i], label)


def label_sigma_um(plan: Plan) -> int:
    """Return the standard deviation of the label's larger axis (x: the grasp offset counts)."""
    spread = plan.settings.spread
    parts = (spread.grasp_offset_mm, spread.label_error_mm, spread.print_offset_mm)
    return round(1e3 * float(np.linalg.norm(parts)))


def _metadata(job: Job) -> dict[str, str]:
    plan = job.plan
    return {
        "simulated": "true",
        "piece": plan.piece,
        "bottom": plan.bottom,
        "seed": str(plan.seed),
        "probes_per_grip": str(plan.probes_per_grip),
        "grips_per_mounting": str(plan.grips_per_mounting),
        "settings": plan.settings.model_dump_json(),
    }


_finished: Synchronized[int] | None = None


def _count_in(finished: Synchronized[int]) -> None:
    """Let this worker count its episodes in the parent's counter (set once, as it starts)."""
    global _finished
    _finished = finished


def _count(episodes: int) -> None:
    if _finished is not None:
        with _finished.get_lock():
            _finished.value += episodes

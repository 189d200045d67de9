"""Simulated collections of labelled episodes, written as packs by independent jobs.

The split into jobs depends on the plan alone, so results do not depend on the executor.
The module does not import torch, because spawned workers import it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple
from zlib import crc32

import numpy as np

from touchdown.backend.config import SimulationSettings, parse_settings
from touchdown.backend.core import InputError, program_version, sync_folder
from touchdown.backend.episodes import START_KEY, PackedEpisode, patch_hex, write_packs
from touchdown.backend.experiments.nuisances import bench_within
from touchdown.backend.geometry import Piece, Tower, face_points, load_pieces
from touchdown.backend.jobs import JobContext, JobSpec, JobStore
from touchdown.backend.simulation import BatchPlan, EpisodeBatch, simulate_episodes

GRIPS_PER_JOB = range(20, 101)  # grips solved in one batch; beyond 100 it is not faster
JOBS_PER_PLAN = 4  # least number of jobs of a plan that has more grips than one small job
PROBES_PER_JOB = 128  # least number of probes of a job


@dataclass(frozen=True, slots=True)
class CollectionJob:
    """Some grips of one plan, written to one or more pack files.

    ``start_ns``: wall clock at the zero of the bench clock; None leaves log times on the bench
    clock.
    """

    plan: BatchPlan
    grips: range
    label: Mapping[str, object]
    folder: Path
    stem: str
    start_ns: int | None = None

    @property
    def episodes(self) -> int:
        """Number of episodes of this job."""
        return sum(self.plan.probes_of(grip) for grip in self.grips)


def batch_plan(  # noqa: PLR0913 - each is a value of the plan
    piece: Piece,
    bottom: Piece,
    settings: SimulationSettings,
    episodes: int,
    seed: int,
    probes_per_grip: int,
    grips_per_mounting: int,
) -> BatchPlan:
    """Return the plan of a pair; raises ``InputError`` for a piece that cannot be grasped."""
    if piece.grip_height_mm is None:
        what = f"'{piece.name}' cannot be grasped."
        raise InputError(what, piece.source, "Set its grip_height_mm.")
    return BatchPlan(
        piece=piece.name,
        bottom=bottom.name,
        face=piece.face,
        bottom_outline=bottom.upper or bottom.face,
        face_points_mm=face_points(piece.face, settings.face.lattice_mm),
        grip_height_mm=piece.grip_height_mm,
        width_mm=piece.width_mm,
        episodes=episodes,
        seed=seed,
        probes_per_grip=probes_per_grip,
        grips_per_mounting=grips_per_mounting,
        settings=settings,
        bottoms=Tower((bottom.body(),)),
    )


def split_jobs(
    plan: BatchPlan, label: Mapping[str, object], folder: Path, start_ns: int | None = None,
    least: int = JOBS_PER_PLAN,
) -> list[CollectionJob]:  # fmt: skip
    """Split a plan into ``least`` or more jobs; those of a large plan have more grips."""
    size = min(max(plan.grips // least, GRIPS_PER_JOB[0]), GRIPS_PER_JOB[-1])
    size = max(size, -(-PROBES_PER_JOB // plan.probes_per_grip))
    return [
        CollectionJob(
            plan,
            range(first, min(first + size, plan.grips)),
            label,
            folder,
            f"{plan.piece}-{plan.bottom}-{k:03d}",
            start_ns,
        )
        for k, first in enumerate(range(0, plan.grips, size))
    ]


def episode_rows(job: CollectionJob, batches: Sequence[EpisodeBatch]) -> Iterator[PackedEpisode]:
    """Yield the episodes in order of their number, with labels."""
    plan, pair = job.plan, f"{job.plan.piece}-{job.plan.bottom}-{job.plan.seed}"
    spread = plan.settings.spread
    # Standard deviation of the label along x, its larger axis.
    parts = (spread.grasp_offset_mm, spread.label_error_mm, spread.print_offset_mm)
    sigma_um = round(1e3 * float(np.linalg.norm(parts)))
    places = [(int(n), batch, i) for batch in batches for i, n in enumerate(batch.episode)]
    for number, batch, i in sorted(places, key=lambda place: place[0]):
        x_um, y_um = np.rint(1e3 * batch.offset_mm[i]).astype(int).tolist()
        label = {
            "episode": f"{pair}-{number}",
            "x_um": x_um,
            "y_um": y_um,
            "sigma_um": sigma_um,
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
        yield PackedEpisode(batch.observation[i], label)


def pack_metadata(job: CollectionJob) -> dict[str, str]:
    """Return the metadata of a pack."""
    plan = job.plan
    return {
        "simulated": "true",
        "piece": plan.piece,
        "bottom": plan.bottom,
        "seed": str(plan.seed),
        "probes_per_grip": str(plan.probes_per_grip),
        "grips_per_mounting": str(plan.grips_per_mounting),
        "settings": plan.settings.model_dump_json(),
    } | ({} if job.start_ns is None else {START_KEY: str(job.start_ns)})


class Redraws(NamedTuple):
    """Number of probes ``drawn_again``; of these ``unsolved`` had no balance in the simulation."""

    drawn_again: int
    unsolved: int


def collection_jobs(
    plan: BatchPlan, piece: Piece, start_ns: int, pieces: Path | None, *, last: bool = True,
    ranges: Mapping[str, Sequence[float]] | None = None,
) -> list[JobSpec]:  # fmt: skip
    """Return the jobs of a plan, smaller ones of the ``last``; ``pieces``: further piece files.

    Every job but the first draws its bench from ``ranges``, low and high of settings.
    """
    least = JOBS_PER_PLAN if last else 1  # large batches are faster; small last ones end together
    least = plan.grips if ranges else least  # the smallest jobs, for many benches

    def bench(job: int) -> dict[str, Any]:
        seed = crc32(f"{plan.bottom} {plan.seed} {job}".encode())
        drawn = bench_within(plan.settings, (ranges or {}) if job else {}, seed)
        return drawn.model_dump(mode="json")

    common = {
        "piece": plan.piece, "bottom": plan.bottom, "episodes": plan.episodes,
        "probes_per_grip": plan.probes_per_grip,
        "grips_per_mounting": plan.grips_per_mounting, "start_ns": start_ns,
        "pieces": None if pieces is None else str(pieces.resolve()), "least": least,
    }  # fmt: skip
    return [
        JobSpec(
            "collection", {**common, "bench": bench(k), "job": k, "probes": job.episodes},
            plan.seed, (piece.sha256,), program_version(),
        )
        for k, job in enumerate(split_jobs(plan, {}, Path(), least=least))
    ]  # fmt: skip


def collect_packs(spec: JobSpec, place: JobContext) -> Mapping[str, Any]:
    """Write the packs of one job of a collection into its folder; the answer counts redraws."""
    p = spec.params
    library = load_pieces(p["pieces"] and Path(p["pieces"]))
    piece = library.top(p["piece"])
    plan = batch_plan(
        piece, library.bottom(p["bottom"]), parse_settings(SimulationSettings, p["bench"], "job"),
        p["episodes"], spec.seed, p["probes_per_grip"], p["grips_per_mounting"],
    )  # fmt: skip
    jobs = split_jobs(plan, {"geometry": piece.sha256}, place.folder, p["start_ns"], p["least"])
    return run_job(jobs[p["job"]])._asdict()


def publish_packs(store: JobStore, specs: Iterable[JobSpec], out: Path) -> None:
    """Move the packs of the finished jobs to the folder ``out``; may be repeated."""
    for spec in specs:
        if store.has(spec.id):
            for path in store.folder(spec.id).glob("*.mcap"):
                with suppress(FileNotFoundError):  # moved by another process
                    path.replace(out / path.name)
    sync_folder(out)


def run_job(job: CollectionJob) -> Redraws:
    """Simulate and write one job; return the numbers of repeated probes."""
    batches = list(simulate_episodes(job.plan, job.grips))
    write_packs(job.folder, job.stem, episode_rows(job, batches), pack_metadata(job))
    return total_redraws([Redraws(batch.rejected, batch.unsolved) for batch in batches])


def total_redraws(parts: Sequence[Redraws]) -> Redraws:
    """Return the sums of all parts."""
    return Redraws(sum(p.drawn_again for p in parts), sum(p.unsolved for p in parts))

"""Collections of labelled episodes: cut into parts, each written to pack files of its own."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.dataset.pack_file import EpisodeRow
from backend.dataset.rows import patch_hex
from backend.simulation.episodes import EpisodeBatch, Plan

GRIPS_PER_JOB = 20
"""Grips solved side by side when a gripping has many probes."""
PROBES_PER_JOB = 128
"""At least this many probes make a job, whatever the number of probes per grip."""


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


def metadata_of(job: Job) -> dict[str, str]:
    """Return what a pack says about all its episodes."""
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

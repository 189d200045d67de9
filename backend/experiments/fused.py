"""From nothing to the fusing network: simulate sequences of probes, train, keep with its card."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from backend.config.bench_facts import bench_sha256
from backend.config.simulation import SimulationSettings
from backend.experiments.family import UNSEEN_BOTTOMS, UNSEEN_PIECES
from backend.experiments.fused_rules import WEIGHTS, fused_trials
from backend.experiments.sequences import load_sequences, probe_sequences
from backend.experiments.writing import program_version
from backend.jobs.running import Kinds, Workplace
from backend.jobs.spec import JobSpec
from backend.learning.device import device_of, name_of, one_thread
from backend.learning.fused.checkpoint import FusedCard, FusedSizes, save_fused
from backend.learning.fused.left_out import Part
from backend.learning.fused.training import FusedTrainer, FusedTraining, data_sha256
from backend.learning.job import DeviceName

FIRST_SEED, SEEDS_PER_JOB = 40_000_000, 1000
"""Far from the seeds of all tables."""
HELD_OUT = 16
"""One job in so many of each portion is held out: other pieces, bottoms, mountings."""
REPORTED = 500
FAMILY = (
    "faces and bottoms: circles, rectangles up to 1.5 to 1, rounded ones, random convex polygons; "
    "bottoms of 8 to 32 mm, {stands}, faces of 10 to 30 mm; "
    "nothing that covers a shape left out by more than 90 % (intersection over union)"
)
STANDS = ("fixed to the table", "most fixed to the table, some free to rock and slide")


@dataclass(frozen=True, slots=True)
class Portion:
    """What jobs of one kind press: ``pieces``, over ``bottoms`` of their own, ``probes`` each time.

    ``first``, ``most``: where their stretch of seeds begins, and how many jobs fit in.
    """

    first: int
    most: int
    pieces: int
    bottoms: int
    probes: int
    free: bool
    """Whether the bottoms rock and slide, as in a trial; such a press takes five times longer."""


PORTIONS = {
    "short": Portion(0, 60, 3, 80, 5, free=False),
    "more": Portion(60, 60, 3, 80, 5, free=False),
    "free": Portion(500, 100, 8, 30, 8, free=True),
    "long": Portion(600, 400, 8, 30, 8, free=False),
}
"""By name. The first two are alike: two machines can start at once."""
COUNTS = {"short": 50, "more": 50}


@dataclass(frozen=True, slots=True)
class FusedRecipe:
    """So many jobs of each of ``portions``, then a training of so many ``steps``."""

    bench: SimulationSettings
    code: str
    counts: Mapping[str, int] = field(default_factory=lambda: COUNTS)
    steps: int = 6000
    seed: int = 0
    without: Part | None = None
    """What an ablation leaves out."""
    device: DeviceName = "auto"
    portions: Mapping[str, Portion] = field(default_factory=lambda: PORTIONS)

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, the training last."""
        parts = [
            self._part(portion, portion.first + k)
            for name, portion in self.portions.items()
            for k in range(self.counts.get(name, 0))
        ]
        facts = {
            "bench_sha256": bench_sha256(self.bench),
            "steps": self.steps,
            "free": self.counts.get("free", 0),
            "counts": [n for name in self.portions if (n := self.counts.get(name, 0))],
            "without": self.without,
            "device": self.device,
        }
        inputs = tuple(part.id for part in parts)
        return [*parts, JobSpec("fuse", facts, self.seed, inputs, self.code)]

    def _part(self, portion: Portion, place: int) -> JobSpec:
        params = {
            "bench": self.bench.model_dump(mode="json"),
            "pieces": portion.pieces,
            "sequences": portion.bottoms,
            "probes": portion.probes,
            "free": portion.free,
        }
        first = FIRST_SEED + SEEDS_PER_JOB * (1000 * self.seed + place)
        return JobSpec("sequences", params, first, (), self.code)

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return how long a job takes compared with others."""
        if spec.kind == "sequences":
            return 8 if spec.params["free"] else 1
        if spec.kind == "fused-trials":
            return int(spec.params["trials"])
        return max(1, int(spec.params["steps"]) // 100)


def divided(folders: Sequence[Path], counts: Sequence[int]) -> tuple[list[Path], list[Path]]:
    """Return the folders to train on and those held out: the first of each portion."""
    train: list[Path] = []
    held_out: list[Path] = []
    for end, count in zip(np.cumsum(counts), counts, strict=True):
        kept = end - count + max(1, count // HELD_OUT)
        held_out += folders[end - count : kept]
        train += folders[kept:end]
    return train, held_out


def fuse(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Train the network on the sequences of the input jobs."""
    one_thread()
    folders = [place.store.folder(source) for source in spec.inputs]
    train, held_out = map(load_sequences, divided(folders, spec.params["counts"]))
    without = spec.params["without"]
    settings = FusedTraining(steps=spec.params["steps"], seed=spec.seed, without=without)
    device = device_of(spec.params["device"])
    trainer = FusedTrainer(train, held_out, settings, device)
    losses = list(trainer.steps())
    metrics = {
        "train_loss": round(float(np.mean(losses[-REPORTED:])), 4),
        "held_out_loss": round(trainer.held_out_loss(), 4),
    }
    card = FusedCard(
        hyper=FusedSizes(**settings.shape.as_json()),
        family=FAMILY.format(stands=STANDS[bool(spec.params["free"])]),
        left_out=(*UNSEEN_PIECES, *UNSEEN_BOTTOMS),
        bench_sha256=spec.params["bench_sha256"],
        data_sha256=data_sha256(train),
        seed=spec.seed,
        training={
            "sequences": len(train["count"]),
            "probes": int(train["count"].sum()),
            "held_out_sequences": len(held_out["count"]),
            "steps": settings.steps,
            "batch": settings.batch,
            "learning_rate": settings.learning_rate,
            "without": without,
            "device": name_of(device),
        },
        metrics=metrics,
        program_version=program_version(),
    )
    card = save_fused(place.folder / WEIGHTS, trainer.arrays(), card)
    return {"weights_sha256": card.weights_sha256, **metrics}


FUSED_KINDS: Kinds = {
    "sequences": probe_sequences,
    "fuse": fuse,
    "fused-trials": fused_trials,
}

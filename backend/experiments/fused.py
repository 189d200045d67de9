"""From nothing to the fusing network: simulate sequences of probes, train, keep with its card."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from backend.config.bench_facts import bench_sha256
from backend.config.simulation import SimulationSettings
from backend.experiments.family import UNSEEN_BOTTOMS, UNSEEN_PIECES
from backend.experiments.sequences import load_sequences, probe_sequences
from backend.experiments.writing import program_version
from backend.jobs.running import Kinds, Workplace
from backend.jobs.spec import JobSpec
from backend.learning.fused.checkpoint import FusedCard, FusedSizes, save_fused
from backend.learning.fused.training import FusedTrainer, FusedTraining, data_sha256
from backend.learning.training import one_thread

WEIGHTS = "fused.safetensors"
FIRST_SEED, SEEDS_PER_JOB = 40_000_000, 1000
"""Far from the seeds of all tables."""
STREAM = 60
PIECES_PER_JOB, BOTTOMS_PER_PIECE = 3, 80
HELD_OUT = 10
"""One job in so many is held out: other pieces, bottoms, mountings."""
REPORTED = 50
FAMILY = (
    "faces and bottoms: circles, rectangles up to 1.5 to 1, rounded ones, random convex polygons; "
    "bottoms of 8 to 32 mm fixed to the table, faces of 10 to 30 mm; nothing that covers a shape "
    "left out by more than 90 % (intersection over union)"
)


@dataclass(frozen=True, slots=True)
class FusedRecipe:
    """``parts`` jobs of ``pieces`` times ``bottoms`` sequences, a training of so many ``steps``."""

    bench: SimulationSettings
    code: str
    parts: int = 60
    steps: int = 6000
    seed: int = 0
    pieces: int = PIECES_PER_JOB
    bottoms: int = BOTTOMS_PER_PIECE

    def jobs(self) -> list[JobSpec]:
        """Return all jobs, the training last."""
        params = {
            "bench": self.bench.model_dump(mode="json"),
            "pieces": self.pieces,
            "sequences": self.bottoms,
        }
        first = FIRST_SEED + 1_000_000 * self.seed
        parts = [
            JobSpec("sequences", params, first + SEEDS_PER_JOB * place(k), (), self.code)
            for k in range(self.parts)
        ]
        facts = {"bench_sha256": bench_sha256(self.bench), "steps": self.steps}
        inputs = tuple(part.id for part in parts)
        return [*parts, JobSpec("fuse", facts, self.seed, inputs, self.code)]

    @staticmethod
    def effort(spec: JobSpec) -> int:
        """Return how long a job takes compared with others."""
        return 1 if spec.kind == "sequences" else max(1, spec.params["steps"] // 100)


def place(part: int) -> int:
    """Return which stretch of seeds a part has: two streams, so that two machines can start."""
    return STREAM * (part % 2) + part // 2


def fuse(spec: JobSpec, place: Workplace) -> Mapping[str, Any]:
    """Train the network on the sequences of the input jobs."""
    one_thread()
    folders = [place.store.folder(source) for source in spec.inputs]
    kept = max(1, len(folders) // HELD_OUT)
    train, held_out = load_sequences(folders[kept:]), load_sequences(folders[:kept])
    settings = FusedTraining(steps=spec.params["steps"], seed=spec.seed)
    trainer = FusedTrainer(train, held_out, settings)
    losses = list(trainer.steps())
    metrics = {
        "train_loss": round(float(np.mean(losses[-REPORTED:])), 4),
        "held_out_loss": round(trainer.held_out_loss(), 4),
    }
    card = FusedCard(
        hyper=FusedSizes(**settings.shape.as_json()),
        family=FAMILY,
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
        },
        metrics=metrics,
        program_version=program_version(),
    )
    card = save_fused(place.folder / WEIGHTS, trainer.arrays(), card)
    return {"weights_sha256": card.weights_sha256, **metrics}


FUSED_KINDS: Kinds = {"sequences": probe_sequences, "fuse": fuse}

"""Train a model from a folder of episodes to a checkpoint with its card."""

from __future__ import annotations

import dataclasses
import math
import time
from collections import Counter
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from backend.catalogue.training_set import LabelChoice, is_dataset, load_training_set
from backend.config.bench_facts import BenchFacts
from backend.config.method import StabilitySettings
from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.dataset.rows import TrainingRows, load_rows
from backend.learning.checkpoint import Card, Sizes, save_checkpoint
from backend.learning.device import compute_alike, device_of, name_of
from backend.learning.job import Cancelled, Epoch, Finished, Loaded, TrainingJob
from backend.learning.origin import (
    MANIFEST,
    benches_of,
    manifest_digest,
    manifest_of,
    only_simulated,
)
from backend.learning.resume import forget_state, load_state, resume_path, save_state
from backend.learning.samples import bottom_figures, choose_samples, save_samples
from backend.learning.shape import ARCH
from backend.learning.training import Trainer, fingerprint

DIVERGED_NATS = 2 * math.log(2)
"""Twice the loss of always answering 0.5."""
Tell = Callable[[Loaded | Epoch | Finished | Cancelled], None]


def fit(job: TrainingJob, tell: Tell, cancelled: Callable[[], bool]) -> None:
    """Do ``job``, telling every step; the state is kept after each epoch until the model is there.

    Raises ``InputError`` for bad data, a bad output name or a state that does not fit.
    """
    if job.out.suffix != ".safetensors":
        raise InputError(
            "A model file ends in .safetensors.", str(job.out), "Choose another --out."
        )
    began_s = time.monotonic()
    compute_alike(job.threads)
    rows = load_episodes(job.data, job.piece, job.labels)
    data = fingerprint(rows)
    trainer = Trainer(rows, job.settings, device_of(job.device))
    state = resume_path(job.out)
    if job.resume:
        load_state(state, trainer, data)
    tell(_loaded(rows, trainer))

    for report in trainer.epochs(cancelled):
        save_state(state, trainer, data)
        tell(Epoch(**dataclasses.asdict(report)))
    if not trainer.finished:
        tell(Cancelled(done=trainer.done, state=state))
        return
    if not trainer.best_loss < DIVERGED_NATS:
        raise InputError(
            "The training diverged: its loss never fell below that of guessing.",
            "learning_rate",
            "Choose a smaller --learning-rate.",
        )
    probability = trainer.predict_held_out()
    card = card_of(rows, trainer, data, benches_of(job.data, rows))
    card = _with_bottoms(card, bottom_figures(rows, trainer.split.held_out, probability))
    if job.keep is not None:
        write_atomically(job.keep / MANIFEST, manifest_of(rows, trainer.split))
        save_samples(job.keep, choose_samples(rows, trainer.split.held_out, probability))
    card = save_checkpoint(job.out, trainer.best_model().arrays(), card)
    forget_state(state)
    best = trainer.best_figures
    tell(
        Finished(
            out=job.out,
            weights_sha256=card.weights_sha256,
            best_epoch=trainer.best_epoch,
            iou=best[0],
            point_accuracy=best[1],
            seconds=time.monotonic() - began_s,
        )
    )


def load_episodes(data: Path, piece: str | None, labels: LabelChoice) -> TrainingRows:
    """Return the labelled episodes of a dataset, or of a folder of packs."""
    if is_dataset(data):
        return load_training_set(data, piece, labels)
    return load_rows(data, piece)


def _loaded(rows: TrainingRows, trainer: Trainer) -> Loaded:
    return Loaded(
        piece=rows.piece,
        episodes=len(rows),
        held_out=len(trainer.split.held_out),
        kept_together=trainer.split.kept_together,
        points=rows.patch.shape[1],
        parameters=sum(p.numel() for p in trainer.model.parameters()),
        base_rate=trainer.base_rate,
        done=trainer.done,
    )


def _with_bottoms(card: Card, figures: dict[str, dict[str, float]]) -> Card:
    validation = {**card.metrics["validation"], "bottoms": figures}
    return card.model_copy(update={"metrics": {**card.metrics, "validation": validation}})


def card_of(
    rows: TrainingRows, trainer: Trainer, data: str, benches: tuple[BenchFacts, ...] = ()
) -> Card:
    """Return the card of a finished training; ``data`` is the fingerprint of ``rows``."""
    settings, best = trainer.settings, trainer.best_figures
    sources = sorted({str(label.get("source")) for label in rows.labels})
    return Card(
        arch=ARCH,
        hyper=Sizes(**trainer.model.shape.as_json()),
        modality=settings.modality,
        piece=rows.piece,
        geometry=rows.geometry,
        delta=StabilitySettings().delta,
        base_rate=trainer.base_rate,
        metrics={
            "validation": {
                "iou": round(best[0], 4),
                "point_accuracy": round(best[1], 4),
                "loss": round(trainer.best_loss, 5),
                "epoch": trainer.best_epoch,
            }
        },
        data={
            "fingerprint_sha256": data,
            "episodes": dict(sorted(Counter(rows.bottom).items())),
            "held_out": len(trainer.split.held_out),
            "kept_together": trainer.split.kept_together,
            "grips": len(set(zip(rows.mounting_id, rows.grip_id, strict=True))),
            "mountings": len(set(rows.mounting_id)),
            "label_sources": sources,
        },
        training={
            **settings.model_dump(),
            "optimiser": "Adam",
            "torch": torch.__version__,
            "device": name_of(trainer.device),
        },
        seed=settings.seed,
        program_version=_version(),
        weights_sha256="",
        simulated=only_simulated(rows),
        benches=benches,
        manifest_sha256=manifest_digest(manifest_of(rows, trainer.split)),
    )


def _version() -> str:
    try:
        return version("touchdown")
    except PackageNotFoundError:
        return "source tree"

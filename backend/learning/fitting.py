"""Fitting of a model to labelled episodes, from data to an evaluated checkpoint."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from touchdown.backend.annotations import LabelChoice, is_dataset, load_training_set
from touchdown.backend.config import BenchDescription, StabilitySettings, TrainingSettings
from touchdown.backend.core import (
    FloatArray,
    InputError,
    errors_as_input,
    program_version,
    write_atomically,
)
from touchdown.backend.episodes import Split, TrainingRows, join_rows, load_rows, split_rows
from touchdown.backend.geometry import face_points, load_pieces
from touchdown.backend.learning import training
from touchdown.backend.learning.calibration import PatchCalibration, fit_calibration
from touchdown.backend.learning.checkpoint import (
    Checkpoint,
    ModelCard,
    check_face,
    load_checkpoint,
    save_checkpoint,
)
from touchdown.backend.learning.inference import ARCH, modality_columns
from touchdown.backend.learning.metrics import (
    EvaluationScores,
    bottom_figures,
    choose_samples,
    save_samples,
    score,
)
from touchdown.backend.learning.training_data import (
    MANIFEST,
    only_simulated,
    read_benches,
    training_manifest,
)
from touchdown.backend.learning.training_process import (
    ReportCallback,
    TrainingCancelled,
    TrainingFinished,
    TrainingJob,
    TrainingLoaded,
)

ALL = "all"


def hardware_rows(rows: TrainingRows) -> TrainingRows | None:
    """Return the episodes recorded on a real bench, None if there are none."""
    real = [i for i, label in enumerate(rows.labels) if label.get("mode") == "lab"]
    return rows.take(np.array(real)) if real else None


def evaluate(
    model: Path | str | Checkpoint,
    data: Path | str | TrainingRows,
    *,
    labels: LabelChoice = "approved",
    delta: float = StabilitySettings().delta,
    pieces: Path | str | None = None,
) -> dict[str, EvaluationScores]:
    """Measure a contact-patch model on labelled episodes; same as ``touchdown evaluate``.

    Parameters
    ----------
    model : Path, str or Checkpoint
        Model file (``.safetensors``), or a loaded model.
    data : Path, str or TrainingRows
        Dataset, folder of packs, or loaded episodes of the piece of the model.
    labels : {"approved", "submitted", "drafts"}
        Labels of a dataset to compare with. Packs hold final labels.
    delta : float
        Probability above which a face point supports the piece (0 to 1).
    pieces : Path or str, optional
        Folder with further piece files.

    Returns
    -------
    dict of str to EvaluationScores
        Scores by name of the bottom, and of all episodes under ``"all"``. IoU and point accuracy
        are shares (0 to 1); stability is judged from a single probe.

    Raises
    ------
    InputError
        If the model or the data cannot be read, or belong to different faces.

    Examples
    --------
    >>> scores = evaluate("pot.safetensors", "probes")  # doctest: +SKIP
    >>> scores["all"].iou  # doctest: +SKIP
    0.6412

    """
    if not 0 <= delta < 1:
        what = f"No point has a probability above {delta}."
        raise InputError(what, "--delta", "Give 0 to below 1.")
    checkpoint = model if isinstance(model, Checkpoint) else load_checkpoint(Path(model))
    piece = checkpoint.card.piece
    rows = data if isinstance(data, TrainingRows) else load_episodes(Path(data), piece, labels)
    points = face_points(load_pieces(pieces).piece(piece).face)
    return evaluate_model(checkpoint, rows, points, delta)


def evaluate_model(
    checkpoint: Checkpoint, rows: TrainingRows, points_mm: FloatArray, delta: float
) -> dict[str, EvaluationScores]:
    """Return the scores per bottom, and of every episode under "all".

    ``points_mm`` (N, 2) are the face points. Raises ``InputError`` if model and data belong to
    different faces.
    """
    card = checkpoint.card
    for count, where in ((rows.patch.shape[1], "labels"), (len(points_mm), "face of the piece")):
        check_face(card, rows.piece, rows.geometry, where, count)
    probability = _predictions(checkpoint, rows)
    bottoms, mounting = np.array(rows.bottom), np.array(rows.mounting_id)

    def scored(which: NDArray[np.bool_]) -> EvaluationScores:
        return score(
            probability[which], rows.patch[which], points_mm, delta, mounting[which].tolist()
        )

    scores = {name: scored(bottoms == name) for name in sorted(set(rows.bottom))}
    return {**scores, ALL: scored(np.ones(len(rows), dtype=np.bool_))}


def _predictions(checkpoint: Checkpoint, rows: TrainingRows) -> NDArray[np.float32]:
    model, seen = training.load_network(checkpoint), modality_columns(checkpoint.card.modality)
    parts = training.in_batches(np.arange(len(rows)))
    return np.concatenate([training.predict(model, rows.inputs(part), seen) for part in parts])


def calibrate_model(checkpoint: Checkpoint, rows: TrainingRows) -> ModelCard:
    """Return the card of ``checkpoint`` with a calibration fitted to ``rows``.

    Use probes of mountings that were not trained on: probes of a known mounting share its errors,
    so that the network appears surer than it is elsewhere. Raises ``InputError`` if the probes
    determine no calibration.
    """
    said, where = "No calibration can be fitted to these episodes", checkpoint.card.piece
    fix = "Use more episodes, over the whole range of displacements."
    with errors_as_input(said, f"model of '{where}'", fix, ValueError):
        fitted = fit_calibration(_predictions(checkpoint, rows), rows.patch)
    return checkpoint.card.model_copy(update={"calibration": fitted})


DIVERGED_NATS = 2 * math.log(2)  # twice the loss of a constant prediction of 0.5


def fit_model(job: TrainingJob, tell: ReportCallback, cancelled: Callable[[], bool]) -> None:
    """Run ``job`` and report each step; the state is saved after each epoch until the end.

    Raises ``InputError`` for invalid data, an invalid output name, a state of other settings, or a
    checkpoint to fine-tune that is damaged, or of another piece or modality.
    """
    if job.out.suffix != ".safetensors":
        fix = "Choose another --out."
        raise InputError("A model file ends in .safetensors.", str(job.out), fix)
    began_s = time.monotonic()
    training.use_deterministic_algorithms(job.threads)
    pretrained = None if job.pretrained is None else load_checkpoint(job.pretrained)
    rows = load_episodes(job.data, job.piece, job.labels)
    benches, settings, split = read_benches(job.data, rows), job.settings, None
    origin, key = dict[str, Any](), ""
    if pretrained is not None:
        card = pretrained.card
        check_face(card, rows.piece, rows.geometry, str(job.pretrained), rows.patch.shape[1])
        key, sizes = card.weights_sha256, (settings.hidden, settings.layers)
        if (card.modality, card.hyper.hidden, card.hyper.layers) != (settings.modality, *sizes):
            what = f"The model sees {card.modality}, the training asks for {settings.modality}"
            fix = "Leave out --modality, or choose another model."
            raise InputError(f"{what} (or other layers).", str(job.pretrained), fix)
        origin["pretrained"] = {"weights_sha256": key, "data": card.data}
    if job.mix is not None:
        own, more = len(rows), load_episodes(job.mix, rows.piece, job.labels)
        rows, split = mix_rows(rows, more, job.mix_share, settings)
        origin["mixed"] = {
            "episodes": len(rows) - own,
            "fingerprint_sha256": training.fingerprint(more),
        }
    data = training.fingerprint(rows)
    trainer = training.Trainer(rows, settings, training.select_device(job.device), split)
    before = None if pretrained is None else trainer.start_from(pretrained)
    state, key = training.resume_path(job.out), data + key
    if job.resume:
        training.load_training_state(state, trainer, key)
    tell(
        TrainingLoaded(
            piece=rows.piece,
            episodes=len(rows),
            held_out=len(trainer.split.held_out),
            kept_together=trainer.split.kept_together,
            points=rows.patch.shape[1],
            parameters=sum(p.numel() for p in trainer.model.parameters()),
            base_rate=trainer.base_rate,
            done=trainer.done,
        )
    )
    for report in trainer.epochs(cancelled):
        training.save_training_state(state, trainer, key)
        tell(report)
    if not trainer.finished:
        tell(TrainingCancelled(done=trainer.done, state=state))
        return
    if not trainer.best_loss < DIVERGED_NATS:
        what = "The training diverged: its loss never fell below that of a constant prediction."
        fix = "Choose a smaller --learning-rate."
        raise InputError(what, "learning_rate", fix)
    probability = trainer.predict_held_out()
    card = make_card(rows, trainer, data, benches, probability)
    if pretrained is not None and pretrained.card.simulated:
        # A few real probes do not replace its evaluation on hardware.
        card = card.model_copy(update={"simulated": True})
    card.data.update(origin)
    validation = card.metrics["validation"]
    if before is not None:
        validation["pretrained"] = before.model_dump(include={"iou", "validation_loss"})
    validation["bottoms"] = bottom_figures(rows, trainer.split.held_out, probability)
    if job.keep is not None:
        write_atomically(job.keep / MANIFEST, training_manifest(rows, trainer.split))
        save_samples(job.keep, choose_samples(rows, trainer.split.held_out, probability))
    card = save_checkpoint(job.out, trainer.best_model().arrays(), card)
    state.unlink(missing_ok=True)
    best = trainer.best_figures
    tell(
        TrainingFinished(
            out=job.out,
            weights_sha256=card.weights_sha256,
            best_epoch=trainer.best_epoch,
            iou=best[0],
            point_accuracy=best[1],
            seconds=time.monotonic() - began_s,
        )
    )


def mix_rows(
    rows: TrainingRows, more: TrainingRows, share: float, settings: TrainingSettings
) -> tuple[TrainingRows, Split]:
    """Split ``rows``, and add episodes of ``more`` at random as ``share`` of the training side.

    The validation side is that of ``rows`` alone. Raises ``InputError`` for too few episodes, and
    if one of them is held out.
    """
    seed, divide = settings.seed, settings.divide_series
    split = split_rows(rows, settings.validation_share, seed, divide_series=divide)
    count = round(len(split.train) * share / (1 - share))
    if not 0 < count <= len(more):
        what = f"A share of {share:g} needs {count} episodes to mix in; there are {len(more)}."
        raise InputError(what, "mix_share", "Choose another --mix-share, or simulate more.")
    chosen = np.sort(np.random.default_rng(seed).choice(len(more), count, replace=False))
    # Training caches have half precision.
    held_out = {one.astype(np.float16).tobytes() for one in rows.inputs(split.held_out)}
    if any(one.astype(np.float16).tobytes() in held_out for one in more.inputs(chosen)):
        what = "Some episodes to mix in are held out for validation, which would know them."
        raise InputError(what, "mix", "Name other episodes with --mix.")
    train = np.concatenate([split.train, len(rows) + np.arange(count)])
    return join_rows([rows, more.take(chosen)]), replace(split, train=train)


def load_episodes(data: Path, piece: str | None, labels: LabelChoice) -> TrainingRows:
    """Return the labelled episodes of a dataset or of a folder of packs."""
    if is_dataset(data):
        return load_training_set(data, piece, labels)
    return load_rows(data, piece)


def make_card(
    rows: TrainingRows,
    trainer: training.Trainer,
    data: str,
    benches: tuple[BenchDescription, ...] = (),
    probability: NDArray[np.float32] | None = None,
) -> ModelCard:
    """Return the card of a finished training; ``data`` is the fingerprint of ``rows``.

    ``probability`` (n, N): predictions of the held-out episodes; None: predict them here.
    """
    settings, best = trainer.settings, trainer.best_figures
    sources = sorted({str(label.get("source")) for label in rows.labels})
    return ModelCard(
        arch=ARCH,
        hyper=trainer.model.shape,
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
            "torch": torch.__version__,
            "device": training.device_name(trainer.device),
        },
        seed=settings.seed,
        program_version=program_version(),
        weights_sha256="",
        simulated=only_simulated(rows),
        benches=benches,
        manifest_sha256=sha256(training_manifest(rows, trainer.split)).hexdigest(),
        calibration=_calibration(rows, trainer, probability),
    )


def _calibration(
    rows: TrainingRows, trainer: training.Trainer, probability: NDArray[np.float32] | None
) -> PatchCalibration | None:
    """Return the calibration on the held-out episodes; None if they determine none."""
    held_out = trainer.predict_held_out() if probability is None else probability
    try:
        return fit_calibration(held_out, rows.patch[trainer.split.held_out])
    except ValueError:
        return None

"""Measure a model on labelled episodes, per bottom and in all."""

from __future__ import annotations

import numpy as np

from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.dataset.rows import TrainingRows
from backend.learning.checkpoint import Checkpoint
from backend.learning.features import columns
from backend.learning.metrics import Scores, score
from backend.learning.model import network
from backend.learning.training import in_parts, predict

ALL = "all"


def hardware_part(rows: TrainingRows) -> TrainingRows | None:
    """Return the episodes that a real bench recorded, None if there are none."""
    real = [i for i, label in enumerate(rows.labels) if label.get("mode") == "lab"]
    return rows.take(np.array(real)) if real else None


def evaluate(
    checkpoint: Checkpoint, rows: TrainingRows, points_mm: FloatArray, delta: float
) -> dict[str, Scores]:
    """Return the scores per bottom, and under "all" those of every episode.

    ``points_mm`` (N, 2) are the face points. Raises ``InputError`` if model and data do not belong
    to the same face.
    """
    card = checkpoint.card
    if card.piece != rows.piece or card.geometry != rows.geometry:
        raise InputError(
            f"The model of '{card.piece}' and the episodes of '{rows.piece}' are not of one face.",
            "geometry",
            "Evaluate on episodes of the piece, in the version, that the model was trained for.",
        )
    if not card.hyper.points == rows.patch.shape[1] == len(points_mm):
        raise InputError(
            f"The model has {card.hyper.points} points, the labels {rows.patch.shape[1]}, "
            f"the face {len(points_mm)}.",
            "points",
            "Simulate the episodes again with the present catalogue.",
        )
    model, seen = network(checkpoint), columns(card.modality)
    parts = in_parts(np.arange(len(rows)))
    probability = np.concatenate([predict(model, rows.inputs(part), seen) for part in parts])
    bottoms = np.array(rows.bottom)
    scores = {
        name: score(probability[bottoms == name], rows.patch[bottoms == name], points_mm, delta)
        for name in sorted(set(rows.bottom))
    }
    return {**scores, ALL: score(probability, rows.patch, points_mm, delta)}

"""Trained models as the experiments use them: many episodes at once."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.experiments.closed_loop import Model
from backend.learning.checkpoint import Checkpoint
from backend.learning.features import columns
from backend.learning.model import network
from backend.learning.training import predict
from backend.objects.catalogue import Piece
from backend.objects.surface import face_points


def batch_model(checkpoint: Checkpoint, piece: Piece) -> Model:
    """Return ``checkpoint`` for batches; raises ``InputError`` if it is not of ``piece``."""
    card = checkpoint.card
    if card.piece != piece.name or card.geometry != piece.sha256:
        raise InputError(
            f"The model is of '{card.piece}', not of this version of '{piece.name}'.",
            card.weights_sha256[:12],
            "Train a model for this piece.",
        )
    net, part = network(checkpoint), columns(card.modality)

    def probability(observation: NDArray[np.float32]) -> FloatArray:
        return predict(net, observation, part).astype(np.float64)

    return Model(probability, face_points(piece.face), card.base_rate)

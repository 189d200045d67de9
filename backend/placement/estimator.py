"""A trained model applied to one episode: the contact patch of this probe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from backend.config.method import SAMPLES_PER_PROBE
from backend.core.faults import InputError
from backend.core.flow import CHANNELS, ContactPatch, Episode, FloatArray
from backend.learning.checkpoint import Card, Checkpoint, load_checkpoint
from backend.learning.features import columns
from backend.objects.catalogue import Piece
from backend.objects.surface import face_points


class Estimator:
    """Estimates patches of one piece on one thread; every call takes a few milliseconds."""

    def __init__(self, checkpoint: Checkpoint, points_mm: FloatArray, where: str) -> None:
        self._model, self.card = checkpoint.model, checkpoint.card
        self._points_mm, self._where = points_mm, where
        self._columns = columns(self.card.modality)

    @classmethod
    def load(cls, path: Path, piece: Piece) -> Estimator:
        """Load and check the model ``path`` for ``piece``; raises ``InputError`` naming the file.

        Torch is limited to one thread: two cost more than they bring at this size.
        """
        checkpoint = load_checkpoint(path)
        points = face_points(piece.face)
        _check_fit(checkpoint.card, piece, len(points), str(path))
        torch.set_num_threads(1)
        estimator = cls(checkpoint, points, str(path))
        estimator.warm_up()
        return estimator

    @property
    def base_rate(self) -> float:
        """Share of contact points in the training data."""
        return self.card.base_rate

    def warm_up(self) -> None:
        """Let the first call pay for nothing: torch sets up its kernels on first use."""
        for _ in range(2):
            self._probability(np.zeros((SAMPLES_PER_PROBE, CHANNELS), np.float32))

    def estimate(self, episode: Episode) -> ContactPatch:
        """Return the contact probability of every face point.

        Raises ``InputError`` for an episode of another piece, of another shape, or with a value
        that is not finite: a missing sample is not an observation.
        """
        observation = episode.observation
        where = f"episode {episode.episode_id}"
        if episode.piece != self.card.piece:
            raise InputError(
                f"The episode is of '{episode.piece}', the model of '{self.card.piece}'.",
                where,
                "Choose the model of this piece.",
            )
        if observation.shape != (SAMPLES_PER_PROBE, CHANNELS):
            raise InputError(
                f"The observation has shape {observation.shape}, not (20, 258).",
                where,
                "Record the probe again.",
            )
        bad = np.flatnonzero(~np.isfinite(observation).all(axis=0))
        if bad.size:
            raise InputError(
                f"The observation holds values that are not finite (channel {bad[0]} first).",
                where,
                "Probe again; check the sensor that delivers this channel.",
            )
        return ContactPatch(self._points_mm.copy(), self._probability(observation))

    def _probability(self, observation: NDArray[np.float32]) -> FloatArray:
        part = np.array(observation[None, :, self._columns], dtype=np.float32, order="C")
        with torch.inference_mode():
            logits = self._model(torch.from_numpy(part))[0]
            return torch.sigmoid(logits.double()).numpy()


def _check_fit(card: Card, piece: Piece, points: int, where: str) -> None:
    fix = f"Choose the model of '{piece.name}', or train one: touchdown train --piece {piece.name}."
    if card.piece != piece.name:
        raise InputError(f"The model is of '{card.piece}', not of '{piece.name}'.", where, fix)
    if card.hyper.points != points:
        what = f"The model knows {card.hyper.points} face points, '{piece.name}' has {points}."
        raise InputError(what, where, fix)
    if card.geometry != piece.sha256:
        what = (
            f"The model was trained for another version of '{piece.name}' (content hash differs)."
        )
        raise InputError(what, where, fix)

"""A trained model applied to one episode: the contact patch of this probe."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from backend.config.method import EARLY_TICKS, SAMPLES_PER_PROBE
from backend.core.faults import InputError
from backend.core.flow import CHANNELS, ContactPatch, Episode, FloatArray
from backend.learning.checkpoint import Card, Checkpoint, load_checkpoint
from backend.learning.features import columns
from backend.learning.forward import PatchForward, State
from backend.learning.shape import Shape
from backend.objects.catalogue import Piece
from backend.objects.surface import face_points


class Estimator:
    """Estimates patches of one piece on one thread.

    The network reads a probe tick by tick, and all ticks but the last are there a while before
    the last: ``prepare`` works through them, so that ``estimate`` has one tick left to do.
    """

    def __init__(self, checkpoint: Checkpoint, points_mm: FloatArray) -> None:
        self.card = checkpoint.card
        shape = Shape(**self.card.hyper.model_dump())
        self._network = PatchForward(checkpoint.arrays, shape)
        self._points_mm = points_mm
        self._columns = columns(self.card.modality)
        self._prepared: tuple[NDArray[np.float32], State] | None = None

    @classmethod
    def load(cls, path: Path, piece: Piece) -> Estimator:
        """Load and check the model ``path`` of ``piece``; raises ``InputError`` naming the file."""
        checkpoint = load_checkpoint(path)
        points = face_points(piece.face)
        _check_fit(checkpoint.card, piece, len(points), str(path))
        return cls(checkpoint, points)

    @property
    def base_rate(self) -> float:
        """Share of contact points in the training data."""
        return self.card.base_rate

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Work through the first ticks, (19, 258), of the probe that will be estimated next.

        Never changes an estimate: ticks that turn out otherwise are worked through again.
        """
        self._prepared = early, self._after(early)

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
        early, last = observation[:EARLY_TICKS], observation[EARLY_TICKS:]
        if self._prepared is not None and np.array_equal(self._prepared[0], early):
            state = self._prepared[1]
        else:
            state = self._after(early)
        logits = self._network.logits(self._network.run(last[:, self._columns], state))
        # A sigmoid that cannot overflow.
        return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logits.astype(np.float64)))

    def _after(self, early: NDArray[np.float32]) -> State:
        return self._network.run(early[:, self._columns], self._network.start)


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

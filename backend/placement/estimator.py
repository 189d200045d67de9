"""Estimate of contact patch and offset from one episode, by one or several models."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.annotations import Pair
from touchdown.backend.config import EARLY_TICKS
from touchdown.backend.core import ContactPatch, Episode, FloatArray, InputError, read_only
from touchdown.backend.geometry import Outline, Piece, face_points, true_patch
from touchdown.backend.learning import (
    Checkpoint,
    LstmState,
    ModelCard,
    PatchCalibration,
    PatchForward,
    check_face,
    load_checkpoint,
    modality_columns,
)

STEP_MM = 0.5
CLIP = 0.02  # probabilities are clipped to [CLIP, 1 - CLIP], as in the belief map
# Number of neighbouring points with common errors, which count as one. A smaller number gives a too
# small uncertainty, a larger one a bias to the centre (measured over five bottoms, 200 episodes
# each).
CORRELATED_POINTS = 6.0
NOTABLE_SIGMAS = 3.0  # label and model differ notably above this many standard uncertainties


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """Offset ``offset_mm`` of the face in ``O``; ``sigma_mm``: standard uncertainty per axis."""

    offset_mm: tuple[float, float]
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class OffsetGrid:
    """Candidate offsets of one pair of faces: ``offsets_mm`` (G, 2), ``touching`` (G, N) 0 or 1.

    Build it once per pair; a fit is then one matrix product.
    """

    offsets_mm: FloatArray
    touching: NDArray[np.float32]
    step_mm: float

    def __post_init__(self) -> None:
        read_only(self.offsets_mm)
        read_only(self.touching)

    @classmethod
    def of(cls, points_mm: FloatArray, bottom: Outline, step_mm: float = STEP_MM) -> OffsetGrid:
        """Return the grid of all offsets with contact of at least one of ``points_mm`` (N, 2).

        Raises ``ValueError`` unless the step is positive.
        """
        if not step_mm > 0:
            raise ValueError("the step must be positive")
        reach = np.abs(points_mm).max(axis=0) + bottom.half_extents_mm
        x, y = (step_mm * np.arange(-math.ceil(r / step_mm), math.ceil(r / step_mm) + 1)
                for r in reach)  # fmt: skip
        offsets = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        touching = true_patch(points_mm, offsets, bottom)
        possible = touching.any(axis=1)
        return cls(offsets[possible], touching[possible].astype(np.float32), step_mm)

    def fit(self, patch: ContactPatch) -> OffsetFit:
        """Return the offset that explains ``patch``.

        Raises ``ValueError`` for a patch of another face or without probabilities.
        """
        probability = patch.probability
        if probability.shape != (self.touching.shape[1],):
            raise ValueError(f"{len(probability)} points, not {self.touching.shape[1]}")
        if not ((probability >= 0) & (probability <= 1)).all():
            raise ValueError("the patch holds no probabilities")
        p = np.clip(probability, CLIP, 1 - CLIP)
        fits = self.touching @ np.log(p / (1 - p)).astype(np.float32)
        weight = np.exp((fits - fits.max()).astype(np.float64) / CORRELATED_POINTS)
        weight /= weight.sum()
        mean = weight @ self.offsets_mm
        spread = float(weight @ ((self.offsets_mm - mean) ** 2).sum(axis=1)) / 2
        cell = self.step_mm**2 / 12
        return OffsetFit((float(mean[0]), float(mean[1])), math.sqrt(spread + cell))


@lru_cache(maxsize=16)
def pair_grid(pair: Pair) -> OffsetGrid:
    """Return the candidate offsets of a pair of a dataset; of the latest pairs, from a cache."""
    return OffsetGrid.of(pair.points_mm, pair.bottom)


def sigmas_apart(label_mm: tuple[float, float], label_sigma_mm: float, model: OffsetFit) -> float:
    """Return the distance of a label from a model's offset, in joint standard uncertainties."""
    distance = math.dist(label_mm, model.offset_mm)
    return distance / math.hypot(label_sigma_mm, model.sigma_mm)


def shipped_model(piece: str) -> Path:
    """Return the path of the shipped model of ``piece``; raises ``InputError`` without one."""
    path = Path(str(files("touchdown.resources"))) / "models" / f"{piece}.safetensors"
    if not path.is_file():
        raise InputError(
            f"No model ships for piece '{piece}'.",
            str(path),
            "Train one of this piece and choose it.",
        )
    return path


class Estimator:
    """Contact patches of one piece; not thread-safe.

    The network reads a probe tick by tick. ``prepare`` processes the first ticks while the probe is
    still running, so that ``estimate`` has one tick left.

    Attributes
    ----------
    card : ModelCard
        Origin, scores and limits of the model.

    Examples
    --------
    >>> from touchdown import Episode, Estimator, load_pieces
    >>> estimator = Estimator.shipped(load_pieces().top("pot"))
    >>> probe = Episode("0", "pot", np.zeros((20, 258), np.float32), np.zeros(2))
    >>> patch = estimator.estimate(probe)
    >>> len(patch.probability) == len(patch.points_mm)
    True

    """

    def __init__(self, checkpoint: Checkpoint, points_mm: FloatArray) -> None:
        self.card: ModelCard = checkpoint.card
        self._network = PatchForward(checkpoint.arrays, self.card.hyper)
        self._points_mm = points_mm
        self._columns = modality_columns(self.card.modality)
        self._prepared: tuple[NDArray[np.float32], LstmState] | None = None

    @classmethod
    def shipped(cls, piece: Piece) -> Estimator:
        """Load the shipped model of a piece; raises ``InputError`` without one."""
        return cls.load(shipped_model(piece.name), piece)

    @classmethod
    def load(cls, path: Path | str, piece: Piece) -> Estimator:
        """Load a model for a piece.

        Parameters
        ----------
        path : Path or str
            Model file (``.safetensors``).
        piece : Piece
            Grasped piece, in the version that the model was trained for.

        Returns
        -------
        Estimator
            Estimator of the piece.

        Raises
        ------
        InputError
            If the model is damaged or belongs to another piece.

        """
        checkpoint = load_checkpoint(Path(path))
        points = face_points(piece.face)
        check_face(checkpoint.card, piece.name, piece.sha256, str(path), len(points))
        return cls(checkpoint, points)

    @property
    def base_rate(self) -> float:
        """Share of contact points in the training data."""
        return self.card.base_rate

    @property
    def calibration(self) -> PatchCalibration | None:
        """Calibration of the probabilities, None if none was fitted."""
        return self.card.calibration

    def prepare(self, early: NDArray[np.float32]) -> None:
        """Process the first ticks, (19, 258), of the probe that will be estimated next.

        Never changes an estimate: ticks that differ later are processed again.
        """
        self._prepared = early, self._after(early)

    def estimate(self, episode: Episode) -> ContactPatch:
        """Return the contact probability of every face point.

        Parameters
        ----------
        episode : Episode
            Probe with an observation (20, 258).

        Returns
        -------
        ContactPatch
            Face points (N, 2) in mm in frame ``F`` and their probabilities (N,).

        Raises
        ------
        InputError
            If the episode has another piece, or values that are not finite.

        """
        observation = episode.observation
        where = f"episode {episode.episode_id}"
        if episode.piece != self.card.piece:
            raise InputError(
                f"The episode is of '{episode.piece}', the model of '{self.card.piece}'.",
                where,
                "Choose the model of this piece.",
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
        # sigmoid without overflow
        return np.asarray(0.5 + 0.5 * np.tanh(0.5 * logits.astype(np.float64)))

    def _after(self, early: NDArray[np.float32]) -> LstmState:
        return self._network.run(early[:, self._columns], self._network.start)


@dataclass(frozen=True, slots=True)
class EnsembleEstimate:
    """Offset with its joint sigma, and the mean patch of the members.

    ``spread_mm``: standard deviation between the members per axis.
    """

    fit: OffsetFit
    patch: ContactPatch
    spread_mm: float


class Ensemble:
    """One or more models of one piece; raises ``ValueError`` for none, or for several pieces."""

    def __init__(self, members: Sequence[Estimator]) -> None:
        if len({member.card.piece for member in members}) != 1:
            raise ValueError("an ensemble has members, all of one piece")
        self.members: tuple[Estimator, ...] = tuple(members)

    @property
    def weights(self) -> str:
        """Hashes of the weights of all members, joined by ``+``."""
        return "+".join(sorted(member.card.weights_sha256 for member in self.members))

    def judge(self, episode: Episode, grid: OffsetGrid) -> EnsembleEstimate:
        """Return the joint estimate for ``episode``.

        Raises ``InputError`` or ``ValueError`` if a member cannot process it.
        """
        patches = [member.estimate(episode) for member in self.members]
        fits = [grid.fit(patch) for patch in patches]
        p = np.stack([patch.probability for patch in patches])
        mean = ContactPatch(patches[0].points_mm.copy(), p.mean(axis=0))
        fit, spread_mm = mix_fits(fits)
        return EnsembleEstimate(fit, mean, spread_mm)


def mix_fits(fits: Sequence[OffsetFit]) -> tuple[OffsetFit, float]:
    """Return the mean offset with its sigma, and the deviation between ``fits`` per axis."""
    at = np.array([fit.offset_mm for fit in fits], dtype=np.float64)
    between = float(at.var(axis=0).mean())
    own = float(np.mean([fit.sigma_mm**2 for fit in fits]))
    x_mm, y_mm = at.mean(axis=0).tolist()
    return OffsetFit((x_mm, y_mm), math.sqrt(own + between)), math.sqrt(between)

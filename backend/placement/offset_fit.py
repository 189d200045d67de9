"""Where must the face be, so that geometry gives the patch that the model felt?

The reverse of ``objects.surface.true_patch``: a posterior over displacements on a grid, flat prior
over every displacement at which the faces touch, Bernoulli likelihood of the estimated patch. Its
mean is the model's label, its spread the label's standard uncertainty: a face that lies wholly
inside the bottom says little about where it is, and then the uncertainty is large.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import ContactPatch, FloatArray, read_only
from backend.objects.shapes import Outline
from backend.objects.surface import true_patch

STEP_MM = 0.5
CLIP = 0.02
"""No point is trusted further than the belief map trusts it."""
CORRELATED_POINTS = 6.0
"""Neighbouring points err together: so many count as one. Smaller makes the uncertainty too
small, larger draws the mean to the centre (measured over five bottoms, 200 episodes each)."""
NOTABLE_SIGMAS = 3.0
"""Label and model differ notably beyond this many standard uncertainties."""


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """``offset_mm`` of the face in ``O``; ``sigma_mm``: standard uncertainty per axis."""

    offset_mm: tuple[float, float]
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class OffsetGrid:
    """All displacements of one pair of faces: ``offsets_mm`` (G, 2), ``touching`` (G, N) 0 or 1.

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
        """Return the grid of every displacement at which one of ``points_mm`` (N, 2) touches.

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
        """Return the displacement that explains ``patch``.

        Raises ``ValueError`` if the patch is of another face or holds no probabilities.
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


def sigmas_apart(label_mm: tuple[float, float], label_sigma_mm: float, model: OffsetFit) -> float:
    """Return the distance of a label from the model's, in joint standard uncertainties."""
    distance = math.dist(label_mm, model.offset_mm)
    return distance / math.hypot(label_sigma_mm, model.sigma_mm)


def mean_entropy(probability: FloatArray) -> float:
    """Return the mean entropy in nat of the points (N,): how unsure the model is of a patch."""
    p = np.clip(probability, 1e-12, 1 - 1e-12)
    return float(-(p * np.log(p) + (1 - p) * np.log1p(-p)).mean())

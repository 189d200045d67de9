"""Fusion network without torch, for the probes of one trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import erf, sqrt

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.learning.fused.features import (
    LENGTH_MM,
    FusedShape,
    GraspedFace,
    probe_inputs,
)

Array = NDArray[np.float32]
LEAST_LOG_SD, MOST_LOG_SD = -4.0, 2.0
# Inputs farther than this from their training mean are refused, in standard deviations. None of
# 14,000 training probes exceeded 40.
FARTHEST_SD = 100.0


@dataclass(frozen=True, slots=True)
class InsetDistribution:
    """Distribution of the inset of points (n,) in the support: a mixture of normal distributions.

    ``weight``, ``mean_mm``, ``sd_mm``: (n, parts).
    """

    weight: FloatArray
    mean_mm: FloatArray
    sd_mm: FloatArray

    def expected_mm(self) -> FloatArray:
        """Return the mean (n,)."""
        return np.asarray((self.weight * self.mean_mm).sum(axis=-1))

    def variance_mm2(self) -> FloatArray:
        """Return the variance (n,)."""
        squared = (self.weight * (self.mean_mm**2 + self.sd_mm**2)).sum(axis=-1)
        return np.asarray(squared - self.expected_mm() ** 2)

    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return weight, mean and sd."""
        return self.weight, self.mean_mm, self.sd_mm

    def exceeds(self, least_mm: float | FloatArray) -> FloatArray:
        """Return the probability of an inset above ``least_mm``, one number or (n,)."""
        z = (self.mean_mm - np.asarray(least_mm)[..., None]) / self.sd_mm
        return np.asarray((self.weight * np.interp(z, _STEPS, _NORMAL)).sum(axis=-1))


class FusedForward:
    """Weights prepared for use; stateless."""

    def __init__(self, arrays: Mapping[str, Array], shape: FusedShape) -> None:
        self._arrays = {name: array.astype(np.float64) for name, array in arrays.items()}
        self._shape = shape

    def known(
        self, wrench: Array, field: Array, offset_mm: FloatArray, face: GraspedFace
    ) -> FloatArray:
        """Return the state (P, width) after each probe of one grasp so far.

        ``wrench`` (P, 8, 6) in N and N·m, ``field`` (P, 8, 252) in px, ``offset_mm`` (P, 2). NaN
        from the first probe that differs too much from the training data.
        """
        modes = self._arrays["modes"].astype(np.float32)
        probes = probe_inputs(wrench, field, offset_mm, face, modes)
        piece = np.broadcast_to(face.inputs(), (len(probes), face.inputs().shape[-1]))
        x = np.concatenate([probes, piece], axis=-1)
        x = (x - self._arrays["mean"]) / self._arrays["scale"]
        x = np.where(np.abs(x) <= FARTHEST_SD, x, np.nan)
        x = self._linear("probe2", _relu(self._linear("probe", x)))
        for layer in range(self._shape.layers):
            x = x + self._attended(layer, _rms_norm(x))
            x = x + self._linear(f"{layer}.down", _relu(self._linear(f"{layer}.up", _rms_norm(x))))
        return _rms_norm(x)

    def inset(
        self, known: FloatArray, points_mm: FloatArray, from_first_mm: FloatArray
    ) -> InsetDistribution:
        """Return the inset of ``points_mm`` (n, 2), relative to the last offset, in the support.

        ``known`` (width,) after the last probe; ``from_first_mm`` (2,): its offset from the first.
        """
        points = point_inputs(points_mm, from_first_mm)
        about = self._linear("about", known) + self._linear("point", points)
        answer = self._linear("answer", _relu(self._linear("both", _relu(about))))
        weight, mean, log_sd = np.split(answer, 3, axis=-1)
        weight = np.exp(weight - weight.max(axis=-1, keepdims=True))
        sd = np.exp(np.clip(log_sd, LEAST_LOG_SD, MOST_LOG_SD))
        share = weight / weight.sum(axis=-1, keepdims=True)
        return InsetDistribution(share, LENGTH_MM * mean, LENGTH_MM * sd)

    def _attended(self, layer: int, x: FloatArray) -> FloatArray:
        count, width = x.shape
        heads = self._shape.heads
        asked = self._linear(f"{layer}.asks", x).reshape(count, 3, heads, width // heads)
        query, key, value = asked.transpose(1, 2, 0, 3)
        score = query @ key.swapaxes(-1, -2) / sqrt(width // heads)
        score[:, np.triu(np.ones((count, count), dtype=np.bool_), k=1)] = -np.inf
        share = np.exp(score - score.max(axis=-1, keepdims=True))
        share /= share.sum(axis=-1, keepdims=True)
        joined = (share @ value).transpose(1, 0, 2).reshape(count, width)
        return self._linear(f"{layer}.joins", joined)

    def _linear(self, name: str, x: FloatArray) -> FloatArray:
        weight, bias = self._arrays[f"{name}.weight"], self._arrays[f"{name}.bias"]
        return np.asarray(x @ weight.T + bias, dtype=np.float64)


def point_inputs(points_mm: FloatArray, from_first_mm: FloatArray) -> FloatArray:
    """Return (..., 5): points (..., 2) from the last and the first offset, and distance."""
    away = np.hypot(points_mm[..., :1], points_mm[..., 1:])
    joined = np.concatenate([points_mm, points_mm + from_first_mm, away], axis=-1)
    return np.asarray(joined / LENGTH_MM, dtype=np.float64)


def _relu(x: FloatArray) -> FloatArray:
    return np.maximum(x, 0.0)


def _rms_norm(x: FloatArray) -> FloatArray:
    tiny = float(np.finfo(np.float32).eps)
    return np.asarray(x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + tiny))


# Table of the normal distribution function.
_STEPS = np.linspace(-8.0, 8.0, 3201)
_NORMAL = np.array([0.5 * (1.0 + erf(z / sqrt(2.0))) for z in _STEPS])

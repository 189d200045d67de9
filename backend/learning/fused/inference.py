"""Fusion network without torch, for the probes of one trial."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from touchdown.backend.core import FloatArray
from touchdown.backend.learning.fused import features

Array = NDArray[np.float32]
LEAST_LOG_SD, MOST_LOG_SD = -4.0, 2.0
# Inputs farther than this from their training mean are refused, in standard deviations. None of
# 14,000 training probes exceeded 40.
FARTHEST_SD = 100.0
POINT_LAYERS = ("about", "point", "both", "answer")
LARGEST_SD = 4.0  # limit of one input in the distance from the training data
LATE = 5  # first of the eight ticks at which the marker fields are large


@dataclass(frozen=True, slots=True)
class InsetDistribution:
    """Distribution of the inset of points (n,) in the support: a mixture of normal distributions.

    ``weight``, ``mean_mm``, ``sd_mm``: (n, parts), the parts of each of ``networks`` together.
    """

    weight: FloatArray
    mean_mm: FloatArray
    sd_mm: FloatArray
    networks: int = 1

    def expected_mm(self) -> FloatArray:
        """Return the mean (n,)."""
        return np.asarray((self.weight * self.mean_mm).sum(axis=-1))

    def variance_mm2(self) -> FloatArray:
        """Return the variance (n,)."""
        squared = (self.weight * (self.mean_mm**2 + self.sd_mm**2)).sum(axis=-1)
        return np.asarray(squared - self.expected_mm() ** 2)

    def at(self, points: NDArray[np.intp] | NDArray[np.bool_]) -> InsetDistribution:
        """Return the distribution at some of the points."""
        weight, mean_mm, sd_mm = (x[points] for x in (self.weight, self.mean_mm, self.sd_mm))
        return InsetDistribution(weight, mean_mm, sd_mm, self.networks)

    def exceeds(self, least_mm: float | FloatArray) -> FloatArray:
        """Return the probability of an inset above ``least_mm``, one number or (n,)."""
        return np.asarray(self._by_network(least_mm).mean(axis=-1))

    def surely_exceeds(self, least_mm: float | FloatArray) -> FloatArray:
        """Return the probability that the least confident network gives, see ``exceeds``."""
        return np.asarray(self._by_network(least_mm).min(axis=-1))

    def _by_network(self, least_mm: float | FloatArray) -> FloatArray:
        z = (self.mean_mm - np.asarray(least_mm)[..., None]) / self.sd_mm
        share = self.weight * ndtr(z)
        each = share.reshape(len(share), self.networks, -1).sum(axis=-1)
        return np.asarray(self.networks * each)


class FusedForward:
    """Weights prepared for use; stateless. Networks of an ensemble run in one pass."""

    def __init__(self, arrays: Mapping[str, Array], shape: features.FusedShape) -> None:
        shared, self._shape = features.shared_arrays(), shape
        self._mean, self._scale = (arrays[name].astype(np.float64) for name in ("mean", "scale"))
        self._modes = arrays["modes"]
        every = {
            name: array.astype(np.float64).reshape(
                shape.networks, *features.weight_shapes(shape)[name]
            )
            for name, array in arrays.items()
            if name not in shared
        }
        # (networks, inputs, outputs) and (networks, 1, outputs)
        self._arrays: dict[str, NDArray[np.floating]] = {
            name: array.swapaxes(-1, -2).copy() if array.ndim == 3 else array[:, None]
            for name, array in every.items()
        }
        # Many points are evaluated: their layers compute in single precision.
        for name in self._arrays:
            if name.split(".")[0] in POINT_LAYERS:
                self._arrays[name] = self._arrays[name].astype(np.float32)

    def known(
        self, wrench: Array, field: Array, offset_mm: FloatArray, face: features.GraspedFace
    ) -> FloatArray:
        """Return the state (P, networks, width) after each probe of one grasp so far.

        ``wrench`` (P, 8, 6) in N and N·m, ``field`` (P, 8, 252) in px, ``offset_mm`` (P, 2). NaN
        from the first probe that differs too much from the training data.
        """
        states = self._states(self._standardised(wrench, field, offset_mm, face)[None])
        return np.asarray(states[0])

    def known_by_mirror(
        self, wrench: Array, field: Array, offset_mm: FloatArray, face: features.GraspedFace
    ) -> FloatArray:
        """Return the states (4, P, networks, width) of the signals and of their mirror images."""
        inputs = [
            self._standardised(
                *features.mirror_signals(wrench, field, across_x=across_x, across_y=across_y),
                offset_mm * signs,
                face.mirrored(across_x=across_x, across_y=across_y),
            )
            for (across_x, across_y), signs in zip(
                features.MIRRORS, features.MIRROR_SIGNS, strict=True
            )
        ]
        return self._states(np.stack(inputs))

    def _states(self, inputs: FloatArray) -> FloatArray:
        """Return the states (m, P, networks, width) of standardised inputs (m, P, inputs)."""
        x = np.where(np.abs(inputs) <= FARTHEST_SD, inputs, np.nan)[:, None]
        x = self._linear("probe2", _relu(self._linear("probe", x)))
        for layer in range(self._shape.layers):
            x = x + self._attended(layer, _rms_norm(x))
            x = x + self._linear(f"{layer}.down", _relu(self._linear(f"{layer}.up", _rms_norm(x))))
        return _rms_norm(x).swapaxes(1, 2)

    def distances(
        self, wrench: Array, field: Array, offset_mm: FloatArray, face: features.GraspedFace
    ) -> tuple[float, float]:
        """Return mean square of the standardised inputs, and share of field energy it cannot see.

        Arguments as for ``known``. NaN for signals that are not finite. The share is 0 for a
        network that does not read the fields.
        """
        inputs = self._standardised(wrench, field, offset_mm, face)[:, : features.PROBE_INPUTS]
        near = float((np.clip(inputs, -LARGEST_SD, LARGEST_SD) ** 2).mean())
        if (self._scale[features.FIELDS] == features.UNREAD_SCALE).all():
            return near, 0.0
        fields, modes = features.centre_fields(field), self._modes.astype(np.float64)
        seen = (fields @ modes.swapaxes(-1, -2)) @ modes
        late = np.s_[:, :, LATE:]
        unseen = float(((fields - seen)[late] ** 2).sum() / (fields[late] ** 2).sum())
        return near, unseen

    def _standardised(
        self, wrench: Array, field: Array, offset_mm: FloatArray, face: features.GraspedFace
    ) -> FloatArray:
        probes = features.probe_inputs(wrench, field, offset_mm, face, self._modes)
        piece = np.broadcast_to(face.inputs(), (len(probes), face.inputs().shape[-1]))
        x = np.concatenate([probes, piece], axis=-1)
        return np.asarray((x - self._mean) / self._scale)

    def inset(
        self, known: FloatArray, points_mm: FloatArray, from_first_mm: FloatArray
    ) -> InsetDistribution:
        """Return the inset of ``points_mm`` (n, 2), relative to the last offset, in the support.

        ``known`` (m, networks, width) after the last probe, of the signals and their mirror images
        or of the signals alone, whose distributions are mixed; ``from_first_mm`` (2,): offset of
        the last probe from the first.
        """
        images, networks, _ = known.shape
        parts = [
            self._inset(state, points_mm * signs, from_first_mm * signs)
            for state, signs in zip(known, np.array(features.MIRROR_SIGNS), strict=False)
        ]
        weight, mean_mm, sd_mm = (
            np.stack(of, axis=2).reshape(len(points_mm), -1) for of in zip(*parts, strict=True)
        )
        return InsetDistribution(weight / images, mean_mm, sd_mm, networks)

    def _inset(
        self, known: FloatArray, points_mm: FloatArray, from_first_mm: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return weight, mean and standard deviation (n, networks, parts) of one image."""
        points = point_inputs(points_mm, from_first_mm)[None].astype(np.float32)
        about = self._linear("about", known[:, None].astype(np.float32))
        x = _relu(about + self._linear("point", points))
        answer = self._linear("answer", _relu(self._linear("both", x)))
        weight, mean, log_sd = np.split(answer.astype(np.float64).swapaxes(0, 1), 3, axis=-1)
        weight = np.exp(weight - weight.max(axis=-1, keepdims=True))
        share = weight / weight.sum(axis=-1, keepdims=True) / len(known)
        sd = np.exp(np.clip(log_sd, LEAST_LOG_SD, MOST_LOG_SD))
        return share, features.LENGTH_MM * mean, features.LENGTH_MM * sd

    def _attended(self, layer: int, x: FloatArray) -> FloatArray:
        images, networks, count, width = x.shape
        heads = self._shape.heads
        asked = self._linear(f"{layer}.asks", x)
        asked = asked.reshape(images, networks, count, 3, heads, width // heads)
        query, key, value = asked.transpose(3, 0, 1, 4, 2, 5)
        score = query @ key.swapaxes(-1, -2) / sqrt(width // heads)
        score[..., np.triu(np.ones((count, count), dtype=np.bool_), k=1)] = -np.inf
        share = np.exp(score - score.max(axis=-1, keepdims=True))
        share /= share.sum(axis=-1, keepdims=True)
        joined = (share @ value).swapaxes(2, 3).reshape(images, networks, count, width)
        return self._linear(f"{layer}.joins", joined)

    def _linear(self, name: str, x: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(x @ self._arrays[f"{name}.weight"] + self._arrays[f"{name}.bias"])


def point_inputs(points_mm: FloatArray, from_first_mm: FloatArray) -> FloatArray:
    """Return (..., 5): points (..., 2) from the last and the first offset, and distance."""
    away = np.hypot(points_mm[..., :1], points_mm[..., 1:])
    joined = np.concatenate([points_mm, points_mm + from_first_mm, away], axis=-1)
    return np.asarray(joined / features.LENGTH_MM, dtype=np.float64)


def _relu(x: NDArray[Any]) -> NDArray[Any]:
    return np.asarray(np.maximum(x, 0.0, dtype=x.dtype))


def _rms_norm(x: FloatArray) -> FloatArray:
    tiny = float(np.finfo(np.float32).eps)
    return np.asarray(x / np.sqrt((x**2).mean(axis=-1, keepdims=True) + tiny))

"""Generalised least squares of the press model, with per-mounting and per-grip unknowns.

The covariance of a press contains sensor noise, drift since contact, and the uncertain depth and
position of the press, which are marginalised by their derivatives. The fit is repeated with the
covariance at its own solution.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S
from touchdown.backend.core import FloatArray
from touchdown.backend.identification.press_model import CHANNELS, PressModel, Unknown

DEPTH_SD_MM = 0.08  # of the contact height from the onset
STEP_SHARE = 0.02  # step of a numerical derivative relative to the width of the prior
# The face touches on cells of 1 mm, so that a prediction changes in steps with the position.
POSITIONS, POSITION_STEP_MM = ("print_x", "print_y", "grasp_x"), 0.5
# Error of the model and of the tracker that is constant over a press, of the measured value
MODEL_SHARE = 0.004
FLOOR = np.r_[np.repeat([0.004, 0.0001], 3), np.tile([0.02, 0.02, 0.001], 2)]  # N, N·m, px


@dataclass(frozen=True, slots=True)
class ChannelNoise:
    """Noise of the 12 channels: ``white`` at a tick, ``base`` in air, drift ``walk`` per √s."""

    white: FloatArray
    base: FloatArray
    walk: FloatArray


class Layout:
    """Places of the unknowns in one vector, and their values per press."""

    def __init__(
        self, unknowns: tuple[Unknown, ...], mounting: NDArray[np.intp], grip: NDArray[np.intp]
    ) -> None:
        self.unknowns = unknowns
        self._of = {"common": np.zeros(len(grip), np.intp), "mounting": mounting, "grip": grip}
        self.parts: dict[str, NDArray[np.intp]] = {}
        self._column: dict[str, NDArray[np.intp]] = {}
        self.size = 0
        for unknown in unknowns:
            used, number = np.unique(self._of[unknown.scope], return_inverse=True)
            self.parts[unknown.name] = self.size + np.arange(len(used))
            self._column[unknown.name] = self.size + number
            self.size += len(used)

    def vector(self, of: Callable[[Unknown], float]) -> FloatArray:
        """Return the vector with ``of(unknown)`` in every place of an unknown."""
        result = np.zeros(self.size)
        for unknown in self.unknowns:
            result[self.parts[unknown.name]] = of(unknown)
        return result

    def values(self, x: FloatArray) -> dict[str, FloatArray]:
        """Return the value of each unknown for each press."""
        return {u.name: u.outer(x[self._column[u.name]]) for u in self.unknowns}

    def column(self, name: str) -> NDArray[np.intp]:
        """Return (B,): place of the unknown of each press."""
        return self._column[name]


@dataclass
class GlsFit:
    """Fit of ``measured`` (B, 20, 12) by ``model``; call ``run`` for the solution.

    ``sigma_mm``: standard uncertainty of the position of a press. ``tell`` is called after every
    evaluation and may raise to cancel.
    """

    model: PressModel
    layout: Layout
    measured: FloatArray
    noise: ChannelNoise
    sigma_mm: float = 0.05
    tell: Callable[[], None] = lambda: None
    _roots: FloatArray = field(default_factory=lambda: np.zeros(0))

    def run(self, start: FloatArray, rounds: int = 2, evaluations: int = 8) -> FitResult:
        """Fit from ``start``; the covariance of the presses is renewed before each round."""
        layout = self.layout
        prior = layout.vector(lambda u: u.prior_sd)
        centre = layout.vector(lambda u: u.prior_mean)
        low = layout.vector(lambda u: float(u.inner(u.low)) if u.low or not u.log else -20.0)
        high = layout.vector(lambda u: float(u.inner(u.high)))
        x = np.clip(start, low + 1e-6, high - 1e-6)

        def left(v: FloatArray) -> FloatArray:
            return np.concatenate([self._whitened(self._left(v)).ravel(), (v - centre) / prior])

        def slopes(v: FloatArray) -> FloatArray:
            return np.concatenate([self._jacobian(v), np.diag(1.0 / prior)])

        for _ in range(rounds):
            self._roots = self._press_roots(x)
            found = least_squares(
                left,
                x,
                slopes,
                (low, high),
                x_scale=prior,
                max_nfev=evaluations,
                ftol=1e-4,
                xtol=1e-5,
            )
            x = found.x
        used = self.measured.size
        jacobian, residual = np.asarray(found.jac), np.asarray(found.fun)
        curvature = jacobian.T @ jacobian
        inverse = np.linalg.pinv(curvature)
        misfit = float((residual[:used] ** 2).sum() / max(used - layout.size, 1))
        clustered = _sandwich(jacobian[:used], residual[:used], self.model.presses.grip, inverse)
        return FitResult(x, inverse * max(misfit, 1.0), clustered, float(found.cost), misfit)

    def _left(self, x: FloatArray) -> FloatArray:
        self.tell()
        left = self.measured - self.model.predict(self.layout.values(x))
        return np.nan_to_num(left, nan=0.0)

    def _whitened(self, left: FloatArray) -> FloatArray:
        flat = left.reshape(len(left), -1, 1)
        return np.stack(
            [
                solve_triangular(r, f, lower=True)[:, 0]
                for r, f in zip(self._roots, flat, strict=True)
            ]
        )

    def _derivatives(self, x: FloatArray, names: list[str]) -> dict[str, FloatArray]:
        """Return the derivative (B, 20, 12) of the prediction by the unknowns of each press."""
        values = self.layout.values(x)
        at = self.model.predict(values)
        result = {}
        for name in names:
            self.tell()
            if name in ("scale_left", "scale_right"):
                first = 6 if name == "scale_left" else 9
                slope = np.zeros_like(at)
                slope[..., first : first + 3] = at[..., first : first + 3]
            elif name == "deeper_mm":
                step = 0.02
                slope = (self.model.predict({**values, name: np.full(len(at), step)}) - at) / step
            else:
                slope = self._slope(x, at, name)
            result[name] = np.nan_to_num(slope, nan=0.0)
        return result

    def _slope(self, x: FloatArray, at: FloatArray, name: str) -> FloatArray:
        """Return the derivative by one unknown; central over whole cells for a position."""
        unknown = next(u for u in self.layout.unknowns if u.name == name)
        where = self.layout.parts[name]
        ahead, behind = x.copy(), x.copy()
        if name in POSITIONS:
            ahead[where] += POSITION_STEP_MM
            behind[where] -= POSITION_STEP_MM
            pair = [self.model.predict(self.layout.values(v)) for v in (ahead, behind)]
            return np.asarray((pair[0] - pair[1]) / (2.0 * POSITION_STEP_MM))
        step = STEP_SHARE * unknown.prior_sd
        ahead[where] += step
        return np.asarray((self.model.predict(self.layout.values(ahead)) - at) / step)

    def _jacobian(self, x: FloatArray) -> FloatArray:
        names = [u.name for u in self.layout.unknowns]
        slopes = self._derivatives(x, names)
        rows = self.measured.shape[1] * self.measured.shape[2]
        result = np.zeros((len(self.measured), rows, self.layout.size))
        for name in names:
            whitened = self._whitened(slopes[name])
            result[np.arange(len(whitened)), :, self.layout.column(name)] = -whitened
        return result.reshape(-1, self.layout.size)

    def _press_roots(self, x: FloatArray) -> FloatArray:
        """Return (B, 240, 240): lower Cholesky factors of the covariance of each press."""
        slopes = self._derivatives(x, ["deeper_mm", "print_x", "print_y"])
        sds = (DEPTH_SD_MM, self.sigma_mm, self.sigma_mm)
        roots = []
        noise = noise_covariance(self.noise)
        for k in range(len(self.measured)):
            covariance = noise.copy()
            for slope, sd in zip(slopes.values(), sds, strict=True):
                column = sd * slope[k].ravel()
                covariance += np.outer(column, column)
            # One scale error per channel
            for channel in range(len(CHANNELS)):
                column = np.zeros_like(self.measured[k])
                column[:, channel] = MODEL_SHARE * self.measured[k][:, channel]
                covariance += np.outer(column.ravel(), column.ravel())
            roots.append(np.linalg.cholesky(covariance))
        return np.stack(roots)


def noise_covariance(noise: ChannelNoise) -> FloatArray:
    """Return (240, 240): covariance of one press by noise, drift and the level in air."""
    t_s = TICK_S * np.arange(1, SAMPLES_PER_PROBE + 1)
    same = np.minimum(t_s[:, None], t_s)
    floor = FLOOR**2
    size = len(CHANNELS)
    result = np.zeros((SAMPLES_PER_PROBE, size, SAMPLES_PER_PROBE, size))
    for k in range(size):
        block = (noise.white[k] ** 2 + 0.1 * floor[k]) * np.eye(SAMPLES_PER_PROBE)
        block += noise.base[k] ** 2 + floor[k] + noise.walk[k] ** 2 * same
        result[:, k, :, k] = block
    return result.reshape(size * SAMPLES_PER_PROBE, -1)


@dataclass(frozen=True, slots=True)
class FitResult:
    """Solution ``x`` with covariances: from the noise, and from the scatter between grippings.

    ``misfit``: mean square of the whitened residuals, 1 for a perfect model.
    """

    x: FloatArray
    covariance: FloatArray
    clustered: FloatArray
    cost: float
    misfit: float

    @property
    def sigma(self) -> FloatArray:
        """Standard uncertainties: the larger of both estimates."""
        variances = np.maximum(np.diag(self.covariance), np.diag(self.clustered))
        return np.sqrt(np.maximum(variances, 0.0))


def _sandwich(
    jacobian: FloatArray, residual: FloatArray, grip: NDArray[np.intp], inverse: FloatArray
) -> FloatArray:
    """Return the covariance that is robust to errors common to a gripping."""
    per_press = jacobian.reshape(len(grip), -1, jacobian.shape[1])
    scores = np.einsum("bkp,bk->bp", per_press, residual.reshape(len(grip), -1))
    names = np.unique(grip)
    total = np.stack([scores[grip == name].sum(axis=0) for name in names])
    count = len(names)
    scatter = inverse @ (total.T @ total) @ inverse
    return np.asarray(scatter * count / max(count - 1, 1))

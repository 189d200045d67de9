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
from scipy.optimize import least_squares

from touchdown.backend.config import SAMPLES_PER_PROBE, TICK_S
from touchdown.backend.core import FloatArray
from touchdown.backend.identification.press_model import (
    CHANNELS,
    LATE,
    PressModel,
    Unknown,
    field_basis,
    project_fields,
)
from touchdown.backend.identification.recordings import PressSet

DEPTH_SD_MM = 0.08  # of the contact height from the onset
HOLD = slice(14, None)  # ticks with the largest strain, for the shape of the field
STEP_SHARE = 0.02  # step of a numerical derivative relative to the width of the prior
# The face touches on cells of 1 mm, so that a prediction changes in steps with the position.
SCALES = {"scale_left": slice(6, 9), "scale_right": slice(9, 12)}  # and their channels
POSITIONS, POSITION_STEP_MM = ("print_x", "print_y", "grasp_x"), 0.5
# Channels of each sensor by the one that shows its time stamps best, and their largest error
STAMPS = {2: slice(0, 6), 7: slice(6, 9), 10: slice(9, 12)}
LATEST_S = 0.02
# Error of the model and of the tracker that is constant over a press, of the measured value
MODEL_SHARE = 0.004
# Correlation time of a further error of the model, a share of the size of each channel
DISCREPANCY_S = 0.5
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

    ``sigma_mm``: standard uncertainty of the position of a press. ``discrepancy``: standard
    deviation of a slow error of the model, over the size of each channel. ``tell`` is called
    after every prediction and may raise to cancel. ``prior``: mean and standard deviation of the
    unknowns, without limits, instead of those of their prior ranges.
    """

    model: PressModel
    layout: Layout
    measured: FloatArray
    noise: ChannelNoise
    sigma_mm: float = 0.05
    discrepancy: float = 0.0
    tell: Callable[[], None] = lambda: None
    prior: tuple[FloatArray, FloatArray] | None = None
    _whitening: FloatArray = field(default_factory=lambda: np.zeros(0))

    def run(self, start: FloatArray, evaluations: int = 8) -> FitResult:
        """Fit from ``start`` with the covariance of the presses there."""
        layout = self.layout
        prior = layout.vector(lambda u: u.prior_sd)
        centre = layout.vector(lambda u: u.prior_mean)
        low = layout.vector(lambda u: float(u.inner(u.low)) if u.low or not u.log else -20.0)
        high = layout.vector(lambda u: float(u.inner(u.high)))
        if self.prior is not None:
            (centre, prior), low, high = self.prior, low - np.inf, high + np.inf
        begin = np.clip(start, low + 1e-6, high - 1e-6)
        self._whitening = self._press_whitening(begin)

        def left(v: FloatArray) -> FloatArray:
            self.tell()
            error = np.nan_to_num(self.measured - self.model.predict(layout.values(v)), nan=0.0)
            return np.concatenate([self._whitened(error).ravel(), (v - centre) / prior])

        def slopes(v: FloatArray) -> FloatArray:
            return np.concatenate([self._jacobian(v), np.diag(1.0 / prior)])

        found = least_squares(
            left, begin, slopes, (low, high), x_scale=prior, max_nfev=evaluations, ftol=1e-4,
            xtol=1e-5,
        )  # fmt: skip
        used = self.measured.size
        jacobian, residual = np.asarray(found.jac), np.asarray(found.fun)
        inverse = np.linalg.pinv(jacobian.T @ jacobian)
        misfit = float((residual[:used] ** 2).sum() / max(used - layout.size, 1))
        clustered = sandwich(jacobian[:used], residual[:used], self.model.presses.grip, inverse)
        sigma = np.sqrt(np.maximum(np.diag(inverse) * max(misfit, 1.0), np.diag(clustered)))
        moved = float(np.max(np.abs(found.x - begin) / sigma))
        return FitResult(
            found.x, inverse * max(misfit, 1.0), sigma, float(found.cost), misfit, moved
        )

    def _whitened(self, left: FloatArray) -> FloatArray:
        return np.asarray(self._whitening @ left.reshape(len(left), -1, 1))[..., 0]

    def _derivatives(self, x: FloatArray, names: list[str]) -> dict[str, FloatArray]:
        """Return the derivative (B, 20, 12) of the prediction by the unknowns of each press.

        That by a position is central over whole cells. ``deeper_mm`` is the depth of a press.
        """
        values, unknowns = self.layout.values(x), {u.name: u for u in self.layout.unknowns}
        at = self.model.predict(values)

        def moved(name: str, step: float) -> FloatArray:
            self.tell()
            one = unknowns.get(name)
            known = self.model.fixed.get(name, 0.0) if one is None else one.inner(values[name])
            now = known + np.full(len(at), step)
            return self.model.predict({**values, name: now if one is None else one.outer(now)})

        result = {}
        for name in names:
            if name in SCALES:
                slope = np.zeros_like(at)
                slope[..., SCALES[name]] = at[..., SCALES[name]]
            elif name in LATE:
                slope = np.zeros_like(at)
                slope[..., LATE[name]] = -np.gradient(at, TICK_S, axis=1)[..., LATE[name]]
            elif name in POSITIONS:
                step = POSITION_STEP_MM
                slope = (moved(name, step) - moved(name, -step)) / (2.0 * step)
            else:
                step = STEP_SHARE * (unknowns[name].prior_sd if name in unknowns else 1.0)
                slope = (moved(name, step) - at) / step
            result[name] = np.nan_to_num(slope, nan=0.0)
        return result

    def _jacobian(self, x: FloatArray) -> FloatArray:
        names = [u.name for u in self.layout.unknowns]
        slopes = self._derivatives(x, names)
        rows = self.measured.shape[1] * self.measured.shape[2]
        result = np.zeros((len(self.measured), rows, self.layout.size))
        for name in names:
            whitened = self._whitened(slopes[name])
            result[np.arange(len(whitened)), :, self.layout.column(name)] = -whitened
        return result.reshape(-1, self.layout.size)

    def _press_whitening(self, x: FloatArray) -> FloatArray:
        """Return (B, 240, 240): inverse Cholesky factors of the covariance of each press."""
        slopes = self._derivatives(x, ["deeper_mm", "print_x", "print_y"])
        sds = (DEPTH_SD_MM, self.sigma_mm, self.sigma_mm)
        # One scale error per channel
        scales = MODEL_SHARE * self.measured[..., None] * np.eye(len(CHANNELS))
        columns = np.concatenate(
            [scales.reshape(len(self.measured), -1, len(CHANNELS)),
             self._late(x, slopes["deeper_mm"]),
             *(sd * slope.reshape(len(slope), -1, 1)
               for slope, sd in zip(slopes.values(), sds, strict=True))], axis=2,
        )  # fmt: skip
        covariance = noise_covariance(self.noise) + columns @ columns.swapaxes(1, 2)
        if self.discrepancy:
            covariance += self._slow_error()
        return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))

    def _slow_error(self) -> FloatArray:
        """Return (240, 240): covariance of the error of the model, which changes slowly."""
        t_s = TICK_S * np.arange(SAMPLES_PER_PROBE)
        size = self.discrepancy * np.sqrt((self.measured**2).mean(axis=0))
        alike = np.exp(-np.abs(t_s[:, None] - t_s) / DISCREPANCY_S)
        every = np.einsum("tk,uk,tu,kl->tkul", size, size, alike, np.eye(len(CHANNELS)))
        return np.asarray(every.reshape(size.size, -1))

    def _late(self, x: FloatArray, deeper: FloatArray) -> FloatArray:
        """Return (B, 240, 63): errors by the time stamps of each sensor, per press and per tick.

        Their size follows from the residuals at ``x``: a late stamp shows while the force rises,
        an error of the depth, with the slope ``deeper``, in the hold as well.
        """
        at = np.nan_to_num(self.model.predict(self.layout.values(x)))
        rate = np.gradient(at, TICK_S, axis=1)
        ticks, columns = np.eye(at.shape[1]), []
        for lead, own in STAMPS.items():
            both = np.stack([rate[..., lead], deeper[..., lead]], axis=-1)
            left = self.measured[..., lead] - at[..., lead]
            late_s = (np.linalg.pinv(both) @ left[..., None])[..., 0]
            left = left - (both @ late_s[..., None])[..., 0]
            excess = (left**2).sum(axis=1) - at.shape[1] * self.noise.white[lead] ** 2
            share = excess / np.maximum((both[..., 0] ** 2).sum(axis=1), 1e-12)
            sd_s = 1.4826 * float(np.median(np.abs(late_s[:, 0])))
            tick_s = float(np.sqrt(max(np.median(share), 0.0)))
            part = np.zeros_like(at)
            part[..., own] = rate[..., own]
            columns.append(min(sd_s, LATEST_S) * part[..., None])
            columns.append(min(tick_s, LATEST_S) * part[..., None] * ticks[:, None])
        return np.concatenate(columns, axis=3).reshape(len(at), at[0].size, -1)


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
    """Solution ``x`` with the ``covariance`` from the noise.

    ``sigma``: standard uncertainties, the larger of those from the noise and from the scatter
    between grippings. ``misfit``: mean square of the whitened residuals, 1 for a perfect model.
    ``moved``: largest distance from the start of the fit, in ``sigma``.
    """

    x: FloatArray
    covariance: FloatArray
    sigma: FloatArray
    cost: float
    misfit: float
    moved: float


def sandwich(
    jacobian: FloatArray, residual: FloatArray, grip: NDArray[np.intp], inverse: FloatArray
) -> FloatArray:
    """Return the covariance that is robust to errors common to a gripping.

    Rows of ``jacobian`` are those of the presses of ``grip`` (B,) in order; ``inverse`` is that of
    its normal matrix.
    """
    per_press = jacobian.reshape(len(grip), -1, jacobian.shape[1])
    scores = np.einsum("bkp,bk->bp", per_press, residual.reshape(len(grip), -1))
    total = np.stack([scores[grip == name].sum(axis=0) for name in np.unique(grip)])
    return np.asarray(inverse @ (total.T @ total) @ inverse * len(total) / max(len(total) - 1, 1))


def fit_roll_off(
    presses: PressSet, pitch_mm: float, start_mm: tuple[float, float]
) -> tuple[FloatArray, FloatArray]:
    """Return roll-off (2,) along x and z, mm, and its covariance (2, 2), scattered by gripping.

    Amplitudes are projected out of the fields of the hold (variable projection).
    """
    field_px, seen = presses.field_px[:, HOLD], presses.seen[:, HOLD]

    def left(roll_off: FloatArray) -> FloatArray:
        basis = field_basis(pitch_mm, (float(roll_off[0]), float(roll_off[1])))
        found, _ = project_fields(field_px, seen, basis)
        rest = field_px - np.einsum("...fi,fima->...fma", found, basis)
        # Mean over the ticks of the hold, whose noise is correlated.
        return np.asarray((seen[..., None] * rest).mean(axis=1).ravel())

    fit = least_squares(left, start_mm, bounds=([2.0, 2.0], [40.0, 40.0]))
    jacobian = np.asarray(fit.jac)
    inverse = np.linalg.inv(jacobian.T @ jacobian)
    return fit.x, sandwich(jacobian, np.asarray(fit.fun), presses.grip, inverse)

"""The ceiling: what could be known of the place of the piece by one who knows the bench itself.

An ensemble of worlds is moved step by step to those that would feel what was felt (ensemble
smoother with multiple data assimilation: Emerick and Reynolds, Comput. Geosci. 55 (2013) 3). Sensor
errors are those of the bench; what the tare leaves on the wrench is unknown in every probe, and a
uniform shift of a marker field says nothing. It is a strategy like others, for comparison only.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import (
    TACTILE_CHANNELS,
    BeliefMap,
    FloatArray,
    PlaceAction,
    Stability,
    SupportKind,
)
from backend.experiments.worlds import TILT_X, Setting, Worlds, diameters_mm, draw_worlds, feel
from backend.objects.shapes import inset_mm
from backend.placement.policy import Aim, give_up, situation, towards
from backend.placement.strategy import XY, Conclusion, Touched
from backend.simulation.episodes import gel_of

TICKS = (0, 1, 2, 4, 7, 10, 14, 19)
FIRST_STEPS, NEXT_STEPS = (156.0, 31.2, 6.24, 1.248), (5.0, 1.25)
"""Factors on the variance of the errors, step by step; their inverses sum to 1."""
WORLDS = 112
KEPT = 0.8
DIRECTIONS = 48
"""Signals are compared along so many directions in which the worlds differ most."""
FLOOR_N, FLOOR_NM, FLOOR_STRAIN = 0.03, 0.003, (0.004, 0.004, 0.0005, 0.02)
"""Errors beyond those of the sensors: time steps, lost markers, worlds between which none lies."""
RISK_SD = 2.33
"""Released where the mean margin is so many standard deviations inside: a risk of 1 %."""
MAX_PROBES, LONGEST_MM, NEAREST_MM = 8, 3.0, 0.2
MAP_CELLS, PITCH_MM = 65, 1.0


class CeilingReasoner:
    """Knows the forward model of the bench, its nuisances' distributions and, if so set, the
    outline of the bottom; not where the bottom is, nor any nuisance.
    """

    def __init__(self, setting: Setting, origin_mm: XY, seed: int) -> None:
        self._setting, self._origin = setting, origin_mm
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 991])))
        self._signals = Signals(setting)
        self.worlds = draw_worlds(setting, origin_mm, WORLDS, self._rng)
        self._probes = 0

    def conclude(self, touched: Touched) -> Conclusion:
        """Assimilate the probe, judge by the risk, step towards the middle of the support."""
        here = touched.offset_mm
        self._assimilate(touched)
        self._probes += 1
        at_risk = self._at_risk_mm(here)
        shift = self.worlds.value[:, :TILT_X].mean(axis=0)
        stability = Stability(
            at_risk >= 0.0,
            at_risk,
            SupportKind.AREA,
            self._setting.bottom.face.placed((-float(shift[0]), -float(shift[1])), segments=48),
            here,
            "belief",
        )
        return Conclusion(self._map(), stability, self._choose(stability, here, shift))

    def stable_at(self, offset_mm: XY) -> bool:
        """Whether the risk of letting go there is small."""
        return self._at_risk_mm(offset_mm) >= 0.0

    def likely_at(self, offset_mm: XY) -> bool:
        """Whether it would stand in most worlds."""
        return bool(np.median(self.margins_mm(offset_mm)) > 0.0)

    def _at_risk_mm(self, here: XY) -> float:
        margin = self.margins_mm(here)
        return float(margin.mean() - RISK_SD * margin.std())

    def margins_mm(self, here: XY) -> FloatArray:
        """Return (n,): by how much the piece would stand at the commanded place in each world."""
        setting, value = self._setting, self.worlds.value
        true = value[:, :TILT_X] + np.asarray(here) + np.asarray(setting.piece.com_xy_mm)
        share = setting.piece.mass_g / (setting.piece.mass_g + setting.bottom.mass_g)
        if setting.diameter_known:
            face = setting.bottom.face
            return np.minimum(inset_mm(face, true), inset_mm(face, share * true))
        return np.asarray(0.5 * diameters_mm(setting, value) - np.hypot(true[:, 0], true[:, 1]))

    def _assimilate(self, touched: Touched) -> None:
        seen = self._signals.of(touched.observation[None])[0]
        prior = self.worlds
        for factor in NEXT_STEPS if self._probes else FIRST_STEPS:
            felt = feel(self._setting, prior, touched.offset_mm, self._rng)
            signals = self._signals.of(felt.observation)
            kept = likely(signals, felt.usable, seen, self._signals.spread, self._rng)
            value = prior.value[kept]
            drift, after = felt.worlds.value[kept] - value, felt.worlds.carried.take(kept)
            value = moved(value, signals[kept], seen, self._signals.spread, factor, self._rng)
            prior = Worlds(value, prior.carried.take(kept))
        # The press itself moved the piece; that is kept for the worlds as they are now.
        self.worlds = Worlds(prior.value + drift, after)

    def _choose(self, stability: Stability, here: XY, shift: FloatArray) -> PlaceAction:
        words = situation(stability)
        if stability.stable:
            return PlaceAction("release", (0.0, 0.0), None, False, f"{words}: release.")
        if self._probes >= MAX_PROBES:
            return give_up(f"{words} after {self._probes} probes, the most allowed: giving up.")
        target = -float(shift[0]), -float(shift[1])
        if np.hypot(target[0] - here[0], target[1] - here[1]) < NEAREST_MM:
            return PlaceAction("shift", (0.0, 0.0), target, False, f"{words}: probing again.")
        return towards(stability, Aim(target, ""), here, LONGEST_MM, 0.0)

    def _map(self) -> BeliefMap:
        """Return in how many worlds each cell supports, in commanded places."""
        reach = PITCH_MM * (MAP_CELLS // 2)
        corner = self._origin[0] - reach, self._origin[1] - reach
        covered = np.ones((MAP_CELLS, MAP_CELLS), dtype=np.bool_)
        empty = BeliefMap(np.zeros(covered.shape), covered, corner, PITCH_MM, self._probes)
        cells = empty.cell_centres_mm()
        held = np.zeros(covered.shape)
        radius = 0.5 * diameters_mm(self._setting, self.worlds.value)
        for shift, r in zip(self.worlds.value[:, :TILT_X], radius, strict=True):
            if self._setting.diameter_known:
                held += self._setting.bottom.face.contains(cells + shift)
            else:
                held += np.hypot(*np.moveaxis(cells + shift, -1, 0)) <= r
        p = (held + 0.5) / (self.worlds.count + 1.0)
        return BeliefMap(np.log(p / (1.0 - p)), covered, corner, PITCH_MM, self._probes)


class Signals:
    """What of an observation is compared, and how its errors spread.

    At each of ``TICKS`` the six of the wrench and, for each finger, the four pad motions that fit
    its marker field best beside a uniform shift. ``spread`` (F, F): covariance of the errors.
    """

    def __init__(self, setting: Setting) -> None:
        gel = gel_of(setting.settings)
        self._fits = [_fit(gel.map[finger]) for finger in range(2)]
        tactile, wrist = setting.settings.tactile, setting.settings.wrist
        ticks = len(TICKS)
        slow = np.repeat([wrist.offset_n, wrist.offset_nm], 3)
        quick = np.repeat([wrist.white_n, wrist.white_nm], 3) / np.sqrt(0.1 * wrist.rate_hz)
        floor = np.repeat([FLOOR_N, FLOOR_NM], 3)
        blocks = [
            s**2 * np.ones((ticks, ticks)) + (q**2 + f**2) * np.eye(ticks)
            for s, q, f in zip(slow, quick, floor, strict=True)
        ]
        for fit in self._fits:
            error = tactile.white_px * np.sqrt((fit**2).sum(axis=1))
            blocks += [
                (e**2 + f**2) * np.eye(ticks) for e, f in zip(error, FLOOR_STRAIN, strict=True)
            ]
        size = ticks * len(blocks)
        self.spread = np.zeros((size, size))
        for k, block in enumerate(blocks):
            at = slice(k * ticks, (k + 1) * ticks)
            self.spread[at, at] = block

    def of(self, observation: NDArray[np.float32]) -> FloatArray:
        """Return (n, F) of observations (n, 20, 258)."""
        chosen = observation[:, TICKS].astype(np.float64)
        parts = [chosen[..., TACTILE_CHANNELS:]]
        fields = chosen[..., :TACTILE_CHANNELS].reshape(*chosen.shape[:2], 2, 2, -1)
        flat = fields.swapaxes(-1, -2).reshape(*chosen.shape[:2], 2, -1)
        parts += [flat[:, :, finger] @ fit.T for finger, fit in enumerate(self._fits)]
        joined = np.concatenate(parts, axis=-1)
        return np.asarray(joined.swapaxes(1, 2).reshape(len(joined), -1), dtype=np.float64)


def likely(
    felt: FloatArray,
    usable: NDArray[np.bool_],
    seen: FloatArray,
    spread: FloatArray,
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Return which of n worlds go on, n of them, likelier ones more than once.

    The likelihood of what was ``seen`` (F,) given ``felt`` (n, F) is flattened until the worlds
    that go on count as many as ``KEPT`` of all: strays are dropped, no single world takes over.
    """
    misfit = np.where(usable | ~usable.any(), _misfit(felt, seen, spread), np.inf)
    misfit -= misfit.min()
    low, high = 1e-9, 1.0
    for _ in range(60):
        share = (low * high) ** 0.5
        weight = np.exp(-0.5 * share * misfit)
        if weight.sum() ** 2 / (weight**2).sum() < KEPT * len(felt):
            high = share
        else:
            low = share
    ends = np.cumsum(weight) / weight.sum()
    places = (np.arange(len(felt)) + rng.random()) / len(felt)
    return np.asarray(np.minimum(np.searchsorted(ends, places), len(felt) - 1), dtype=np.intp)


def _misfit(felt: FloatArray, seen: FloatArray, spread: FloatArray) -> FloatArray:
    root = np.linalg.cholesky(spread)
    return np.asarray((np.linalg.solve(root, (felt - seen).T) ** 2).sum(axis=0))


def moved(
    value: FloatArray,
    felt: FloatArray,
    seen: FloatArray,
    spread: FloatArray,
    factor: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the worlds (n, P) after a step towards those that feel ``seen`` (F,).

    ``felt`` (n, F): what each feels; errors of covariance ``factor * spread``.
    """
    root = np.linalg.cholesky(spread)
    centre = felt.mean(axis=0)
    y = np.linalg.solve(root, (felt - centre).T).T
    target = np.linalg.solve(root, seen - centre)
    _, _, along = np.linalg.svd(y, full_matrices=False)
    along = along[:DIRECTIONS]
    y, target = y @ along.T, along @ target
    n = len(value) - 1
    inner = y.T @ y / n + factor * np.eye(len(target))
    gain = np.linalg.solve(inner, y.T @ (value - value.mean(axis=0)) / n)
    scatter = np.sqrt(factor) * rng.standard_normal(y.shape)
    return np.asarray(value + (target - y + scatter) @ gain, dtype=np.float64)


def _fit(gel_map: FloatArray) -> FloatArray:
    """Return (4, 126): pad motions of a marker field, a uniform shift taken out."""
    shifts = np.zeros((2, gel_map.shape[1]))
    shifts[0, 0::2] = shifts[1, 1::2] = 1.0
    return np.asarray(np.linalg.pinv(np.concatenate([gel_map, shifts]).T)[:4], dtype=np.float64)

"""Upper bound for strategies: an oracle that knows the physics of the simulated bench.

It estimates the place of the piece with an ensemble smoother with multiple data assimilation
(Emerick and Reynolds, Comput. Geosci. 55 (2013) 3). A hypothesis is a place of the piece over its
bottom with every nuisance of bench-v1 that changes the signals, in standard normal units. Sensor
errors are those of the bench. The offset of the wrench after the tare is unknown in every probe,
and a uniform shift of a marker field carries no information. The oracle reads the simulation, so it
serves comparison only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import erf

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import geometry, placement, simulation
from touchdown.backend.config import ProbeSettings, SimulationSettings
from touchdown.backend.core import (
    TACTILE_CHANNELS,
    BeliefMap,
    FloatArray,
    PlaceAction,
    Stability,
    SupportKind,
)

_Point = tuple[float, float]
SHIFT_X, SHIFT_Y, TILT_X, TILT_Y, STIFFNESS, GEL, MU_GRIP, GRIP, GRASP_X, GRASP_Z = range(10)
YAW, GAIN_LEFT, GAIN_RIGHT, MU = range(10, 14)
COLUMNS = 15  # the last one is not read; it keeps the random draws
NORMAL = slice(TILT_X, COLUMNS)  # columns that are standard normal before any probe
# More columns on a bench that draws piece, wrist sensor and grasp of each probe (bench-v2).
DAY = slice(COLUMNS, COLUMNS + simulation.DAY_SCORES)
SEAT = slice(DAY.stop, DAY.stop + simulation.SEAT_SCORES)


@dataclass(frozen=True, slots=True)
class OracleSetting:
    """Knowledge of the oracle about a trial: bench, piece and bottom."""

    piece: geometry.Piece
    bottom: geometry.Piece
    settings: SimulationSettings
    probe: ProbeSettings = field(default_factory=ProbeSettings)


@dataclass(frozen=True, slots=True)
class HypothesisEnsemble:
    """Ensemble of n hypotheses.

    ``value`` (n, 15 or 37): columns as named above, the first two in mm: true minus commanded
    place.
    ``carried``: slip and gel of each gripping so far.
    """

    value: FloatArray
    carried: simulation.GraspHistory

    @property
    def count(self) -> int:
        """Number n of hypotheses."""
        return len(self.value)


@dataclass(frozen=True, slots=True)
class PredictedPress:
    """Predicted signals of one press for n hypotheses.

    ``observation`` (n, 20, 258) without sensor errors; ``worlds``: hypotheses after the press;
    ``usable`` (n,): contact was found and the press converged, as in every recorded press.
    """

    observation: NDArray[np.float32]
    worlds: HypothesisEnsemble
    usable: NDArray[np.bool_]


def draw_hypotheses(
    setting: OracleSetting, at_mm: _Point, count: int, rng: np.random.Generator
) -> HypothesisEnsemble:
    """Return hypotheses before any probe; all places with enough overlap are equally likely."""
    value = np.zeros((count, SEAT.stop if _draws_more(setting.settings) else COLUMNS))
    value[:, NORMAL] = rng.standard_normal((count, COLUMNS - TILT_X))
    value[:, COLUMNS:] = rng.spawn(1)[0].standard_normal((count, value.shape[1] - COLUMNS))
    places = geometry.draw_offset(rng, setting.piece.face, setting.bottom.face, count)
    value[:, :TILT_X] = places - np.asarray(at_mm)
    return HypothesisEnsemble(value, simulation.GraspHistory.fresh(count))


def predict_press(
    setting: OracleSetting, worlds: HypothesisEnsemble, at_mm: _Point, rng: np.random.Generator
) -> PredictedPress:
    """Press at the commanded place in every hypothesis, with a random moment of contact detection.

    A hypothesis without convergence at the first attempt is unusable.
    """
    settings, value = setting.settings, worlds.value
    conditions = _conditions(setting, value)
    true = value[:, :TILT_X] + np.asarray(at_mm)
    outline = setting.bottom.face
    subcells = settings.face.subcells
    lattice = settings.face.lattice_mm / subcells
    points = geometry.face_points(setting.piece.face, lattice)
    state = simulation.begin_probes(
        points, outline, true, conditions, worlds.carried, lattice, subcells
    )
    rule = simulation.onset_rule(settings, setting.probe)
    still = _errorless(settings)
    noise = [_noise(settings, still, setting.probe, rng) for _ in range(worlds.count)]
    state = state.on(_stand(setting, value), splits=0)
    pressed = simulation.press_with_noise(state, noise, settings, setting.probe, rule)
    moved = value.copy()
    slip = (pressed.state.slip - worlds.carried.slip)[:, :, 0].mean(axis=1)
    moved[:, SHIFT_X] += slip
    moved[:, :TILT_X] -= pressed.state.pose.slide_mm.sum(axis=1)
    # The next probe draws its own friction and error of the arm.
    moved[:, MU] = rng.standard_normal(worlds.count)
    moved[:, :TILT_X] += settings.spread.label_error_mm * rng.standard_normal((worlds.count, 2))
    if _draws_more(settings):
        moved[:, SEAT] = rng.standard_normal((worlds.count, simulation.SEAT_SCORES))
        moved[:, SHIFT_X] += _seat_shift_mm(setting, value) - _seat_shift_mm(setting, moved)
    after = HypothesisEnsemble(
        moved, simulation.GraspHistory(pressed.state.slip, pressed.state.relaxed)
    )
    seen = simulation.observe_presses(
        pressed, conditions, still, noise, simulation.gel_from_settings(settings)
    )
    return PredictedPress(
        seen, after, pressed.detected & (pressed.state.residual <= simulation.RESIDUAL_LIMIT)
    )


def _draws_more(settings: SimulationSettings) -> bool:
    return any(
        getattr(settings.spread, name)
        for name in (*simulation.DAY_SPREADS, *simulation.SEAT_SPREADS)
    )


def _seat_shift_mm(setting: OracleSetting, value: FloatArray) -> FloatArray:
    """Return by how much the grasp of this probe moves the face along -x (n,)."""
    spread, height_mm = setting.settings.spread, setting.piece.grip_height_mm or 0.0
    seats = [simulation.seat_draw(spread, z) for z in value[:, SEAT]]
    return np.array([seat["reseat_mm"][0] + height_mm * seat["pitch_rad"] for seat in seats])


def _stand(setting: OracleSetting, value: FloatArray) -> simulation.SupportStack | None:
    stand = simulation.support_stack(
        geometry.Tower((setting.bottom.body(),)), setting.settings.support
    )
    return None if stand is None else simulation.join_support_stacks([stand] * len(value))


def _conditions(setting: OracleSetting, value: FloatArray) -> simulation.Conditions:
    settings, spread = setting.settings, setting.settings.spread
    more = _draws_more(settings)
    draws = []
    for v in value:
        tilt = np.clip(spread.tilt_rad * v[[TILT_X, TILT_Y]], -0.02, 0.02)
        foundation = settings.face.foundation_n_mm3
        if settings.face.foundation_range_n_mm3 is not None:
            low, high = np.log(settings.face.foundation_range_n_mm3)
            foundation = float(np.exp(low + (high - low) * _share(v[[STIFFNESS]])[0]))
        mounting = simulation.MountingDraw((float(tilt[0]), float(tilt[1])), (0.0, 0.0), foundation)
        if more:
            mounting = replace(mounting, **simulation.day_draw(spread, v[DAY]))
        grasp = np.clip(spread.grasp_offset_mm * v[[GRASP_X, GRASP_Z]], -2.0, 2.0)
        gain = np.clip(1.0 + spread.gain * v[[GAIN_LEFT, GAIN_RIGHT]], 0.8, 1.2)
        grip_n = setting.probe.grip_force_n + spread.grip_force_n * v[GRIP]
        gripping = simulation.GripDraw(
            gel_factor=float(np.clip(1.0 + spread.gel * v[GEL], 0.7, 1.3)),
            mu_grip=float(np.clip(settings.mu_grip * (1 + spread.mu_grip * v[MU_GRIP]), 0.35, 1.1)),
            grip_force_n=float(np.clip(grip_n, 4.0, 15.0)),
            grasp_offset_mm=(float(grasp[0]), float(grasp[1])),
            yaw_rad=spread.yaw_rad * float(v[YAW]),
            gain=(float(gain[0]), float(gain[1])),
        )
        mu = float(np.clip(settings.mu * (1.0 + spread.mu * v[MU]), 0.2, 0.6))
        probe = simulation.ProbeDraw(mu, (0.0, 0.0), np.zeros((2, 2)), np.zeros(6))
        if more:
            probe = replace(probe, **simulation.seat_draw(spread, v[SEAT]))
        draws.append((mounting, gripping, probe))
    height = setting.piece.grip_height_mm
    assert height is not None
    return simulation.conditions_from_draws(
        settings, setting.probe, height, setting.piece.width_mm, draws
    )


def _share(score: FloatArray) -> FloatArray:
    """Return the normal distribution function of ``score``, for uniform ranges."""
    return np.array([0.5 * (1.0 + erf(s / 2**0.5)) for s in score])


def _errorless(settings: SimulationSettings) -> SimulationSettings:
    """Return the bench with sensors without errors and without dropped frames."""
    tactile = settings.tactile.model_copy(
        update={"white_px": 0.0, "drift_px_sqrt_s": 0.0, "lost_share": 0.0, "drop_share": 0.0}
    )
    wrist = settings.wrist.model_copy(
        update={
            "white_n": 0.0, "white_nm": 0.0, "drift_n_sqrt_min": 0.0, "drift_nm_sqrt_min": 0.0,
        }
    )  # fmt: skip
    return settings.model_copy(update={"tactile": tactile, "wrist": wrist})


def _noise(
    settings: SimulationSettings,
    still: SimulationSettings,
    probe: ProbeSettings,
    rng: np.random.Generator,
) -> simulation.SensorNoise:
    """Return sensor noise that only changes the moment of contact detection."""
    quiet = simulation.draw_noise(still, simulation.onset_rule(settings, probe), rng)
    force_n = settings.wrist.white_n * rng.standard_normal(len(quiet.force_n))
    return replace(quiet, force_n=force_n)


TICKS = (0, 1, 2, 4, 7, 10, 14, 19)
# Factors on the error variance, step by step; their inverses sum to 1.
FIRST_STEPS, NEXT_STEPS = (156.0, 31.2, 6.24, 1.248), (5.0, 1.25)
ENSEMBLE_SIZE = 112
KEPT_SHARE = 0.8
DIRECTIONS = 48  # number of principal directions in which signals are compared
# Errors beyond those of the sensors: time steps, lost markers, sampling of the ensemble.
FLOOR_N, FLOOR_NM, FLOOR_STRAIN = 0.03, 0.003, (0.004, 0.004, 0.0005, 0.02)
RISK_SD = 2.33  # release if the mean margin exceeds this many standard deviations: a risk of 1 %
MAX_PROBES, LONGEST_MM, NEAREST_MM = 8, 3.0, 0.2
MAP_CELLS, PITCH_MM = 65, 1.0


class OracleStrategy:
    """Strategy with complete knowledge of the bench model and its nuisance distributions.

    It does not know the place of the bottom or any nuisance value.
    """

    def __init__(self, setting: OracleSetting, origin_mm: placement.XY, seed: int) -> None:
        self._setting, self._origin = setting, origin_mm
        self._rng = np.random.default_rng([seed, 991])
        self._signals = SignalFeatures(setting)
        self.worlds = draw_hypotheses(setting, origin_mm, ENSEMBLE_SIZE, self._rng)
        self._probes = 0

    def conclude(self, touched: placement.ProbeObservation) -> placement.PlaceDecision:
        """Assimilate the probe, judge by the risk, and step towards the middle of the support."""
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
        return placement.PlaceDecision(self._map(), stability, self._choose(stability, here, shift))

    def _at_risk_mm(self, here: placement.XY) -> float:
        margin = self.margins_mm(here)
        # The opening fingers shift the piece by a distance that no probe shows.
        sd = np.hypot(margin.std(), self._setting.settings.release_disturbance_mm)
        return float(margin.mean() - RISK_SD * sd)

    def margins_mm(self, here: placement.XY) -> FloatArray:
        """Return the stability margin at the commanded place in each hypothesis (n,)."""
        setting, value = self._setting, self.worlds.value
        true = value[:, :TILT_X] + np.asarray(here) + np.asarray(setting.piece.com_xy_mm)
        if setting.settings.spread.com_mm:
            # The entered centre of mass is wrong, and no probe tells by how much.
            true += [
                simulation.day_draw(setting.settings.spread, z)["com_mm"] for z in value[:, DAY]
            ]
        share = setting.piece.mass_g / (setting.piece.mass_g + setting.bottom.mass_g)
        piece, face = setting.piece, setting.bottom.face
        own = geometry.inset_mm(face, share * true)
        if "region" in (face.kind, piece.face.kind):
            return np.minimum(
                geometry.contact_margins_mm(piece.face, piece.com_xy_mm, face, true), own
            )
        return np.minimum(geometry.inset_mm(face, true), own)

    def _assimilate(self, touched: placement.ProbeObservation) -> None:
        seen = self._signals.of(touched.observation[None])[0]
        prior = self.worlds
        for factor in NEXT_STEPS if self._probes else FIRST_STEPS:
            predicted = predict_press(self._setting, prior, touched.offset_mm, self._rng)
            signals = self._signals.of(predicted.observation)
            kept = select_likely(signals, predicted.usable, seen, self._signals.spread, self._rng)
            value = prior.value[kept]
            drift, after = predicted.worlds.value[kept] - value, predicted.worlds.carried.take(kept)
            value = assimilate(value, signals[kept], seen, self._signals.spread, factor, self._rng)
            prior = HypothesisEnsemble(value, prior.carried.take(kept))
        # The motion of the piece by the press is added at the end.
        self.worlds = HypothesisEnsemble(prior.value + drift, after)

    def _choose(self, stability: Stability, here: placement.XY, shift: FloatArray) -> PlaceAction:
        situation = placement.describe_situation(stability)
        if stability.stable:
            return PlaceAction("release", (0.0, 0.0), None, False, f"{situation}: release.")
        if self._probes >= MAX_PROBES:
            return placement.give_up(
                f"{situation} after {self._probes} probes, the most allowed: giving up."
            )
        target = -float(shift[0]), -float(shift[1])
        if np.hypot(target[0] - here[0], target[1] - here[1]) < NEAREST_MM:
            return PlaceAction("shift", (0.0, 0.0), target, False, f"{situation}: probing again.")
        return placement.shift_towards(
            stability, placement.ShiftTarget(target, ""), here, LONGEST_MM, 0.0
        )

    def _map(self) -> BeliefMap:
        """Return the share of hypotheses that support each cell, in commanded places."""
        reach = PITCH_MM * (MAP_CELLS // 2)
        corner = self._origin[0] - reach, self._origin[1] - reach
        covered = np.ones((MAP_CELLS, MAP_CELLS), dtype=np.bool_)
        empty = BeliefMap(np.zeros(covered.shape), covered, corner, PITCH_MM, self._probes)
        cells = empty.cell_centres_mm()
        count_in = np.zeros(covered.shape)
        for shift in self.worlds.value[:, :TILT_X]:
            count_in += self._setting.bottom.face.contains(cells + shift)
        p = (count_in + 0.5) / (self.worlds.count + 1.0)
        return BeliefMap(np.log(p / (1.0 - p)), covered, corner, PITCH_MM, self._probes)


class SignalFeatures:
    """Features of an observation that are compared, and their error covariance.

    At each of ``TICKS`` the six components of the wrench and, for each finger, the four pad motions
    that fit its marker field best beside a uniform shift. ``spread`` (F, F): covariance of the
    errors.
    """

    def __init__(self, setting: OracleSetting) -> None:
        gel = simulation.gel_from_settings(setting.settings)
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
        """Return the features (n, F) of observations (n, 20, 258)."""
        chosen = observation[:, TICKS].astype(np.float64)
        parts = [chosen[..., TACTILE_CHANNELS:]]
        fields = chosen[..., :TACTILE_CHANNELS].reshape(*chosen.shape[:2], 2, 2, -1)
        flat = fields.swapaxes(-1, -2).reshape(*chosen.shape[:2], 2, -1)
        parts += [flat[:, :, finger] @ fit.T for finger, fit in enumerate(self._fits)]
        joined = np.concatenate(parts, axis=-1)
        return np.asarray(joined.swapaxes(1, 2).reshape(len(joined), -1), dtype=np.float64)


def select_likely(
    predicted: FloatArray,
    usable: NDArray[np.bool_],
    seen: FloatArray,
    spread: FloatArray,
    rng: np.random.Generator,
) -> NDArray[np.intp]:
    """Return n indices of hypotheses, resampled by likelihood.

    The likelihood of ``seen`` (F,) given ``predicted`` (n, F) is flattened until the effective
    sample size is ``KEPT_SHARE`` of n: outliers are dropped, no single hypothesis dominates.
    """
    whitened = np.linalg.solve(np.linalg.cholesky(spread), (predicted - seen).T)
    misfit = np.where(usable | ~usable.any(), (whitened**2).sum(axis=0), np.inf)
    misfit -= misfit.min()
    low, high = 1e-9, 1.0
    for _ in range(60):
        share = (low * high) ** 0.5
        weight = np.exp(-0.5 * share * misfit)
        if weight.sum() ** 2 / (weight**2).sum() < KEPT_SHARE * len(predicted):
            high = share
        else:
            low = share
    ends = np.cumsum(weight) / weight.sum()
    places = (np.arange(len(predicted)) + rng.random()) / len(predicted)
    return np.asarray(np.minimum(np.searchsorted(ends, places), len(predicted) - 1), dtype=np.intp)


def assimilate(
    value: FloatArray,
    predicted: FloatArray,
    seen: FloatArray,
    spread: FloatArray,
    factor: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Return the hypotheses (n, P) after a Kalman step towards the observation ``seen`` (F,).

    ``predicted`` (n, F): predicted features; the errors have the covariance ``factor * spread``.
    """
    root = np.linalg.cholesky(spread)
    centre = predicted.mean(axis=0)
    y = np.linalg.solve(root, (predicted - centre).T).T
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
    """Return (4, 126): pad motions of a marker field without its uniform shift."""
    shifts = np.zeros((2, gel_map.shape[1]))
    shifts[0, 0::2] = shifts[1, 1::2] = 1.0
    return np.asarray(np.linalg.pinv(np.concatenate([gel_map, shifts]).T)[:4], dtype=np.float64)

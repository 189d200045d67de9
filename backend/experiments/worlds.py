"""Worlds that a trial on the simulated bench may be in: all that is drawn there, as hypotheses.

A world is a place of the piece over its bottom and every nuisance of bench-v1 that changes what is
felt, in units in which the bench draws it from a standard normal distribution. ``press`` is the
bench's own physics. Only for measuring what a method could know at best: it sees the bench.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from math import erf

import numpy as np
from numpy.typing import NDArray

from backend.config.method import ProbeSettings
from backend.config.simulation import SimulationSettings
from backend.core.flow import FloatArray
from backend.objects.catalogue import Piece
from backend.objects.shapes import circle
from backend.objects.starts import draw_offset
from backend.objects.surface import face_points
from backend.objects.tower import Tower
from backend.simulation import nuisance
from backend.simulation.conditions import Conditions
from backend.simulation.episodes import Eye, SensorNoise, draw_noise, gel_of, observe, rule_of
from backend.simulation.equilibrium import RESIDUAL_LIMIT
from backend.simulation.mechanics import Carried, Region, begin
from backend.simulation.pressing import press
from backend.simulation.support import Stand, join_stands, stand_of

XY = tuple[float, float]
DIAMETERS_MM = (10.0, 30.0)
"""Of a round bottom whose diameter is not known."""
SHIFT_X, SHIFT_Y, TILT_X, TILT_Y, STIFFNESS, GEL, MU_GRIP, GRIP, GRASP_X, GRASP_Z = range(10)
YAW, GAIN_LEFT, GAIN_RIGHT, MU, DIAMETER = range(10, 15)
NORMAL = slice(TILT_X, DIAMETER + 1)
"""Columns that are standard normal before any probe."""
COLUMNS = 15


@dataclass(frozen=True, slots=True)
class Setting:
    """What is known of a trial: bench, piece, and the bottom, whose outline may not be.

    ``diameter_known``: else the bottom is round with a diameter within ``DIAMETERS_MM``.
    """

    piece: Piece
    bottom: Piece
    settings: SimulationSettings
    diameter_known: bool = True
    probe: ProbeSettings = field(default_factory=ProbeSettings)


@dataclass(frozen=True, slots=True)
class Worlds:
    """``value`` (n, 15): columns as named above, the first two in mm: true minus commanded place.

    ``carried``: slip and gel of each gripping so far.
    """

    value: FloatArray
    carried: Carried

    @property
    def count(self) -> int:
        """Number n of worlds."""
        return len(self.value)


@dataclass(frozen=True, slots=True)
class Felt:
    """``observation`` (n, 20, 258) without sensor errors; ``worlds`` after the press.

    ``usable`` (n,): contact was found and the press converged, as in every press that is observed.
    """

    observation: NDArray[np.float32]
    worlds: Worlds
    usable: NDArray[np.bool_]


def draw_worlds(setting: Setting, at_mm: XY, count: int, rng: np.random.Generator) -> Worlds:
    """Return worlds before any probe: every place with enough overlap is as likely as any other."""
    value = np.zeros((count, COLUMNS))
    value[:, NORMAL] = rng.standard_normal((count, COLUMNS - TILT_X))
    if setting.diameter_known:
        places = draw_offset(rng, setting.piece.face, setting.bottom.face, count)
    else:
        sizes = diameters_mm(setting, value)
        places = np.concatenate(
            [draw_offset(rng, setting.piece.face, circle(float(d)), 1) for d in sizes]
        )
    value[:, :TILT_X] = places - np.asarray(at_mm)
    return Worlds(value, Carried.fresh(count))


def diameters_mm(setting: Setting, value: FloatArray) -> FloatArray:
    """Return (n,) the diameter of a bottom that is round but not known."""
    low, high = DIAMETERS_MM
    return np.asarray(low + (high - low) * _share(value[:, DIAMETER]), dtype=np.float64)


def feel(setting: Setting, worlds: Worlds, at_mm: XY, rng: np.random.Generator) -> Felt:
    """Press at the commanded place in every world; when contact is noticed is left to chance.

    A world that finds no balance at once is not searched further: it will be left out.
    """
    settings, value = setting.settings, worlds.value
    conditions = _conditions(setting, value)
    true = value[:, :TILT_X] + np.asarray(at_mm)
    outline: Region = setting.bottom.face
    if not setting.diameter_known:
        outline = _Discs(0.5 * diameters_mm(setting, value)[:, None])
    points = face_points(setting.piece.face, settings.face.lattice_mm)
    lattice = settings.face.lattice_mm
    state = begin(points, outline, true, conditions, worlds.carried, lattice)
    rule = rule_of(settings, setting.probe)
    still = _errorless(settings)
    noise = [_noise(settings, still, setting.probe, rng) for _ in range(worlds.count)]
    pressed = press(
        state.on(_stand(setting, value), splits=0),
        np.array([n.phase_s for n in noise]),
        np.stack([n.force_n for n in noise]),
        setting.probe,
        rule,
        1e-6 * settings.cycle_us,
    )
    moved = value.copy()
    slip = (pressed.state.slip - worlds.carried.slip)[:, :, 0].mean(axis=1)
    moved[:, SHIFT_X] += slip
    moved[:, :TILT_X] -= pressed.state.pose.slide_mm.sum(axis=1)
    # The next probe draws its own friction and error of the arm.
    moved[:, MU] = rng.standard_normal(worlds.count)
    moved[:, :TILT_X] += settings.spread.label_error_mm * rng.standard_normal((worlds.count, 2))
    after = Worlds(moved, Carried(pressed.state.slip, pressed.state.relaxed))
    seen = observe(pressed, conditions, still, noise, Eye(gel_of(settings)))
    return Felt(seen, after, pressed.detected & (pressed.state.residual <= RESIDUAL_LIMIT))


@dataclass(frozen=True, slots=True)
class _Discs:
    """A disc of its own radius (n, 1) under each face."""

    radius_mm: FloatArray

    def contains(self, points_mm: FloatArray, /) -> NDArray[np.bool_]:
        return np.asarray(np.hypot(points_mm[..., 0], points_mm[..., 1]) <= self.radius_mm)


def _stand(setting: Setting, value: FloatArray) -> Stand | None:
    support = setting.settings.support
    if setting.diameter_known:
        stand = stand_of(Tower((setting.bottom.body(),)), support)
        return None if stand is None else join_stands([stand] * len(value))
    stands = []
    for diameter in diameters_mm(setting, value):
        face = circle(float(diameter))
        body = replace(setting.bottom.body(), lower=face, upper=face)
        stands.append(stand_of(Tower((body,)), support))
    found = [stand for stand in stands if stand is not None]
    return join_stands(found) if found else None


def _conditions(setting: Setting, value: FloatArray) -> Conditions:
    settings, spread = setting.settings, setting.settings.spread
    draws = []
    for v in value:
        tilt = np.clip(spread.tilt_rad * v[[TILT_X, TILT_Y]], -0.02, 0.02)
        mounting = nuisance.Mounting(
            (float(tilt[0]), float(tilt[1])), (0.0, 0.0), _foundation(settings, v[STIFFNESS])
        )
        grasp = np.clip(spread.grasp_offset_mm * v[[GRASP_X, GRASP_Z]], -2.0, 2.0)
        gain = np.clip(1.0 + spread.gain * v[[GAIN_LEFT, GAIN_RIGHT]], 0.8, 1.2)
        grip_n = setting.probe.grip_force_n + spread.grip_force_n * v[GRIP]
        gripping = nuisance.Gripping(
            gel_factor=float(np.clip(1.0 + spread.gel * v[GEL], 0.7, 1.3)),
            mu_grip=float(np.clip(settings.mu_grip * (1 + spread.mu_grip * v[MU_GRIP]), 0.35, 1.1)),
            grip_force_n=float(np.clip(grip_n, 4.0, 15.0)),
            grasp_offset_mm=(float(grasp[0]), float(grasp[1])),
            yaw_rad=spread.yaw_rad * float(v[YAW]),
            gain=(float(gain[0]), float(gain[1])),
        )
        mu = float(np.clip(settings.mu * (1.0 + spread.mu * v[MU]), 0.2, 0.6))
        probe = nuisance.ProbeDraw(mu, (0.0, 0.0), np.zeros((2, 2)), np.zeros(6))
        draws.append((mounting, gripping, probe))
    height = setting.piece.grip_height_mm
    assert height is not None
    return nuisance.conditions_of(settings, setting.probe, height, setting.piece.width_mm, draws)


def _foundation(settings: SimulationSettings, score: float) -> float:
    between = settings.face.foundation_range_n_mm3
    if between is None:
        return settings.face.foundation_n_mm3
    low, high = np.log(between)
    return float(np.exp(low + (high - low) * _share(np.array([score]))[0]))


def _share(score: FloatArray) -> FloatArray:
    """Return the share of a uniform range that stands for standard normal scores."""
    return np.array([0.5 * (1.0 + erf(s / 2**0.5)) for s in score])


def _errorless(settings: SimulationSettings) -> SimulationSettings:
    """Return the bench with sensors that make no errors; frames come in time."""
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
) -> SensorNoise:
    """Return errors that only change when the contact is noticed."""
    quiet = draw_noise(still, rule_of(settings, probe), rng)
    force_n = settings.wrist.white_n * rng.standard_normal(len(quiet.force_n))
    return replace(quiet, force_n=force_n)

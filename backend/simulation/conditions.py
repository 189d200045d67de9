"""Physical conditions of a probe, drawn per mounting, per grip and per probe.

Each scope has its own generator, derived from the seed and its numbers (mounting, grip, probe), so
that draws do not depend on the division or order of the work.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import (
    ProbeSettings,
    SimulationSettings,
    SpreadSettings,
    SurfaceSettings,
)
from touchdown.backend.core import FloatArray
from touchdown.backend.geometry import FLAT, Surface
from touchdown.backend.simulation.rows import Rows


@dataclass(frozen=True, slots=True)
class Conditions(Rows):
    """True physical parameters and sensor errors of B probes (leading dimension B everywhere).

    Grasp: ``shear_n_mm``, ``normal_n_mm`` (N/mm) and ``torsion_nmm`` (N·mm/rad) are those of one
    finger; ``width_mm`` between the pads; ``robot_n_mm`` (B, 3); ``grip_height_mm`` pivot above
    the face; ``grasp_offset_mm`` (B, 2) = (g_x, g_z): the face sits at commanded minus g_x.
    Contact: ``mu``, ``foundation_n_mm3``, ``tangential_n_mm3``, ``tilt_rad`` (B, 2).
    Hysteresis: ``alpha`` (0: off) and ``relax_s``; ``creep`` and ``creep_s`` of a slower branch.
    ``slips`` switches grip slip. ``tilt_rad`` is that of board, face and pitch together;
    ``crown_rad`` (B,): slope of the face at its rim, positive if domed.
    Position: ``print_offset_mm`` (B, 2) of the bottom, ``label_error_mm`` (B, 2) of the arm.
    Sensors: ``gain`` (B, 2) per finger; ``bias_px`` (B, 2, 2) finger, axis; ``ft_offset`` (B, 6)
    in N and N·m; ``wrist_yaw_rad`` (B,) and ``wrist_lever_mm`` (B, 3): errors of the sensor's
    place; ``cable_n_mm`` (B, 3, 3): force per travel.
    """

    shear_n_mm: FloatArray
    normal_n_mm: FloatArray
    torsion_nmm: FloatArray
    width_mm: FloatArray
    robot_n_mm: FloatArray
    grip_height_mm: FloatArray
    grip_force_n: FloatArray
    mu_grip: FloatArray
    limit_radius_mm: FloatArray
    slips: NDArray[np.bool_]
    grasp_offset_mm: FloatArray
    yaw_rad: FloatArray
    alpha: FloatArray
    relax_s: FloatArray
    creep: FloatArray
    creep_s: FloatArray
    mu: FloatArray
    foundation_n_mm3: FloatArray
    tangential_n_mm3: FloatArray
    tilt_rad: FloatArray
    crown_rad: FloatArray
    print_offset_mm: FloatArray
    label_error_mm: FloatArray
    gain: FloatArray
    bias_px: FloatArray
    ft_offset: FloatArray
    wrist_yaw_rad: FloatArray
    wrist_lever_mm: FloatArray
    cable_n_mm: FloatArray

    @property
    def count(self) -> int:
        """Number of probes B."""
        return len(self.mu)


def true_offset_mm(
    commanded_mm: FloatArray, conditions: Conditions, slip: FloatArray | None = None
) -> FloatArray:
    """Return (B, 2) true displacement of the face in ``O`` for the ``commanded_mm`` (B, 2).

    The grasp offset moves the piece (not only the lever arm), the print offset moves the bottom,
    the label error belongs to the arm. ``slip`` (B, 2, 3) in the hand moves the piece too.
    """
    shift = conditions.label_error_mm - conditions.print_offset_mm
    moved = commanded_mm + shift
    moved[:, 0] -= conditions.grasp_offset_mm[:, 0]
    if slip is not None:
        moved[:, 0] += slip[:, :, 0].mean(axis=1)
    return np.asarray(moved, dtype=np.float64)


STEP_REACH = 0.6  # largest distance of a step from the centre over the half extent of the face


class SeedScope(IntEnum):
    """Scope of a generator (part of its seed)."""

    MOUNTING = 1
    GRIPPING = 2
    PROBE = 3
    SURFACE = 4


def scoped_generator(seed: int, scope: SeedScope, *place: int) -> np.random.Generator:
    """Return the generator of one ``place``: (scene, mounting), (..., grip), (..., probe).

    ``scene``: number of piece and bottoms, so that one seed gives each pair draws of its own.
    """
    return np.random.default_rng([seed, scope, *place])


@dataclass(frozen=True, slots=True)
class MountingDraw:
    """A bottom on the bench: tilt (rad), position error (mm), stiffness of the pair (N/mm³).

    The others are those of the day, which begins with each mounting. Piece: ``face_tilt_rad`` and
    ``crown_rad`` of its face, ``com_mm`` true minus entered centre of mass, ``pad_area`` relative
    gripped area of the gels. Bench: ``wrist_yaw_rad``, ``wrist_lever_mm`` (x, y, height) and
    ``cable_n_mm`` (3, 3), the change of the force of the cables with the position of the hand.
    """

    tilt_rad: tuple[float, float]
    print_offset_mm: tuple[float, float]
    foundation_n_mm3: float
    face_tilt_rad: tuple[float, float] = (0.0, 0.0)
    crown_rad: float = 0.0
    com_mm: tuple[float, float] = (0.0, 0.0)
    pad_area: float = 1.0
    wrist_yaw_rad: float = 0.0
    wrist_lever_mm: tuple[float, ...] = (0.0, 0.0, 0.0)
    cable_n_mm: tuple[tuple[float, ...], ...] = ((0.0,) * 3,) * 3


@dataclass(frozen=True, slots=True)
class GripDraw:
    """A piece between the fingers, until the gripper opens again."""

    gel_factor: float
    mu_grip: float
    grip_force_n: float
    grasp_offset_mm: tuple[float, float]
    yaw_rad: float
    gain: tuple[float, float]


@dataclass(frozen=True, slots=True)
class ProbeDraw:
    """Draws of one probe; ``bias_px`` (2, 2), ``ft_offset`` (6,) in N and N·m.

    ``reseat_mm``: change of the grasp offset (g_x, g_z); ``pitch_rad`` of the piece in the grasp.
    """

    mu: float
    label_error_mm: tuple[float, float]
    bias_px: FloatArray
    ft_offset: FloatArray
    reseat_mm: tuple[float, float] = (0.0, 0.0)
    pitch_rad: float = 0.0


def _limited(rng: np.random.Generator, mean: float, sd: float, low: float, high: float) -> float:
    return float(np.clip(mean + sd * rng.standard_normal(), low, high))


def draw_mounting(settings: SimulationSettings, rng: np.random.Generator) -> MountingDraw:
    """Draw the conditions of a mounting."""
    spread = settings.spread
    tilt = np.clip(spread.tilt_rad * rng.standard_normal(2), -0.02, 0.02)
    print_offset = np.clip(spread.print_offset_mm * rng.standard_normal(2), -0.5, 0.5)
    foundation = settings.face.foundation_n_mm3
    if settings.face.foundation_range_n_mm3 is not None:
        low, high = np.log(settings.face.foundation_range_n_mm3)
        foundation = float(np.exp(rng.uniform(low, high)))
    drawn = MountingDraw(_pair(tilt), _pair(print_offset), foundation)
    if not any(getattr(spread, name) for name in DAY_SPREADS):
        return drawn
    # A stream of its own: the draws above stay as they were.
    return replace(drawn, **day_draw(spread, rng.spawn(1)[0].standard_normal(DAY_SCORES)))


DAY_SPREADS = (
    "face_tilt_rad", "face_crown_rad", "com_mm", "pad_area", "wrist_yaw_rad", "wrist_lever_mm",
    "cable_n_mm",
)  # fmt: skip
SEAT_SPREADS = ("reseat_mm", "pitch_rad")
DAY_SCORES, SEAT_SCORES = 19, 3


def day_draw(spread: SpreadSettings, z: FloatArray) -> dict[str, Any]:
    """Return piece, wrist sensor and cables of a day for standard normal ``z`` (19,)."""
    cable = spread.cable_n_mm * z[10:].reshape(3, 3)
    return {
        "face_tilt_rad": _pair(np.clip(spread.face_tilt_rad * z[:2], -0.02, 0.02)),
        "crown_rad": float(np.clip(spread.face_crown_rad * z[2], -0.02, 0.02)),
        "com_mm": _pair(np.clip(spread.com_mm * z[3:5], -2.0, 2.0)),
        "pad_area": float(np.exp(np.clip(spread.pad_area * z[5], -0.5, 0.5))),
        "wrist_yaw_rad": spread.wrist_yaw_rad * float(z[6]),
        "wrist_lever_mm": tuple((spread.wrist_lever_mm * z[7:10]).tolist()),
        "cable_n_mm": tuple(map(tuple, cable.tolist())),
    }


def draw_surface(settings: SurfaceSettings, half_mm: float, rng: np.random.Generator) -> Surface:
    """Draw the heights of a touched face with the half extent ``half_mm``."""
    kind, size, angle, share = rng.random(4).tolist()
    bearing = 2.0 * np.pi * angle
    if kind < settings.tilted_share:
        tilt = size * settings.tilt_rad
        return Surface(tilt_rad=(tilt * np.cos(bearing), tilt * np.sin(bearing)))
    if kind < settings.tilted_share + settings.stepped_share:
        line = bearing, STEP_REACH * half_mm * (2.0 * share - 1.0)
        return Surface(step_mm=(1.0 - size) * settings.step_mm, step_line=line)
    if kind < settings.tilted_share + settings.stepped_share + settings.domed_share:
        return Surface(dome_mm=settings.dome_mm / (1.0 - size))
    return FLAT


def draw_gripping(
    settings: SimulationSettings, grip_force_n: float, rng: np.random.Generator
) -> GripDraw:
    """Draw the conditions of a grip with the commanded force per finger."""
    spread = settings.spread
    offset = np.clip(spread.grasp_offset_mm * rng.standard_normal(2), -2.0, 2.0)
    gain = np.clip(1.0 + spread.gain * rng.standard_normal(2), 0.8, 1.2)
    return GripDraw(
        gel_factor=_limited(rng, 1.0, spread.gel, 0.7, 1.3),
        mu_grip=_limited(rng, settings.mu_grip, settings.mu_grip * spread.mu_grip, 0.35, 1.1),
        grip_force_n=_limited(rng, grip_force_n, spread.grip_force_n, 4.0, 15.0),
        grasp_offset_mm=_pair(offset),
        yaw_rad=spread.yaw_rad * float(rng.standard_normal()),
        gain=_pair(gain),
    )


def draw_probe(settings: SimulationSettings, rng: np.random.Generator) -> ProbeDraw:
    """Draw the conditions of a probe."""
    spread, wrist = settings.spread, settings.wrist
    label_error = np.clip(spread.label_error_mm * rng.standard_normal(2), -0.3, 0.3)
    scale = np.repeat([wrist.offset_n, wrist.offset_nm], 3)
    drawn = ProbeDraw(
        mu=_limited(rng, settings.mu, settings.mu * spread.mu, 0.2, 0.6),
        label_error_mm=_pair(label_error),
        bias_px=np.clip(settings.tactile.bias_px * rng.standard_normal((2, 2)), -1.0, 1.0),
        ft_offset=scale * rng.standard_normal(6),
    )
    if not any(getattr(spread, name) for name in SEAT_SPREADS):
        return drawn
    return replace(drawn, **seat_draw(spread, rng.spawn(1)[0].standard_normal(SEAT_SCORES)))


def seat_draw(spread: SpreadSettings, z: FloatArray) -> dict[str, Any]:
    """Return the change of the grasp before a probe for standard normal ``z`` (3,)."""
    reseat = np.clip(spread.reseat_mm * z[:2], -0.5, 0.5)
    pitch = float(np.clip(spread.pitch_rad * z[2], -0.02, 0.02))
    return {"reseat_mm": _pair(reseat), "pitch_rad": pitch}


def conditions_from_draws(
    settings: SimulationSettings,
    probe: ProbeSettings,
    grip_height_mm: float,
    width_mm: float,
    draws: Sequence[tuple[MountingDraw, GripDraw, ProbeDraw]],
) -> Conditions:
    """Join the draws of B probes with the fixed settings.

    The pitch of a piece turns its face about the pivot: the face tilts and moves along x.
    """
    mounting, gripping, each = zip(*draws, strict=True)
    count = len(draws)
    ones = np.ones(count)
    grasp = settings.grasp
    drawn: dict[str, Any] = {
        field.name: np.array([getattr(draw, field.name) for draw in scope])
        for scope in (mounting, gripping, each)
        for field in fields(scope[0])
    }
    drawn.pop("com_mm")
    gel, area = drawn.pop("gel_factor"), drawn.pop("pad_area")
    if grasp.pad_width_mm:
        area = area * np.sqrt(width_mm / grasp.pad_width_mm)
    # A thin layer under a patch: k ~ A, torsion ~ A r² ~ A², lever of friction ~ r.
    gel, torsion, lever = gel * area, gel * area**2, np.sqrt(area)
    pitch, reseat = drawn.pop("pitch_rad"), drawn.pop("reseat_mm")
    drawn["tilt_rad"] = drawn["tilt_rad"] + drawn.pop("face_tilt_rad")
    drawn["tilt_rad"][:, 1] += pitch
    drawn["grasp_offset_mm"] = drawn["grasp_offset_mm"] + reseat
    drawn["grasp_offset_mm"][:, 0] += pitch * grip_height_mm
    return Conditions(
        **drawn,
        shear_n_mm=grasp.shear_n_mm * gel,
        normal_n_mm=grasp.normal_n_mm * gel,
        torsion_nmm=grasp.torsion_nmm_rad * torsion,
        width_mm=width_mm * ones,
        robot_n_mm=np.tile(np.array(probe.stiffness_n_mm), (count, 1)),
        grip_height_mm=grip_height_mm * ones,
        limit_radius_mm=grasp.limit_radius_mm * lever,
        slips=np.full(count, grasp.slip),
        alpha=(grasp.hysteresis_share if grasp.hysteresis else 0.0) * ones,
        relax_s=grasp.hysteresis_s * ones,
        creep=grasp.creep_share * ones,
        creep_s=grasp.creep_s * ones,
        tangential_n_mm3=settings.face.tangential_n_mm3 * ones,
    )


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])

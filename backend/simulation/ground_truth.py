"""Ground truth of a simulated trial: the true scene, and the true margin at the release.

It is used for scoring and for the display after a trial only.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from touchdown.backend import geometry
from touchdown.backend.config import SimulationSettings
from touchdown.backend.core import Fall, FloatArray
from touchdown.backend.simulation import conditions
from touchdown.backend.simulation.conditions import MountingDraw, SeedScope, draw_surface
from touchdown.backend.simulation.release_mujoco import (
    contradicts_analysis,
    mujoco_available,
    simulate_release,
)


@dataclass(frozen=True, slots=True)
class Scene:
    """A piece in a jig between the open jaws, a tower of bottoms below it, and a seed.

    ``bottoms``: from the lowest up; ``O`` is on the topmost. ``start_mm``: true displacement of the
    face from ``O`` before the first probe, errors of grasp and print included.
    ``start_height_mm``: height of the commanded face above the support at the start. ``mounting``:
    number of the mounting of bottom and gels. With ``jig`` the piece stands in a jig at
    ``start_mm``, where it can be put back and gripped again.
    """

    piece: geometry.Piece
    bottoms: geometry.Tower
    start_mm: tuple[float, float]
    seed: int
    settings: SimulationSettings = field(default_factory=SimulationSettings)
    start_height_mm: float = 3.0
    mounting: int = 0
    jig: bool = False

    def __post_init__(self) -> None:
        if self.piece.grip_height_mm is None:
            raise ValueError(f"{self.piece.name} cannot be grasped")
        if not self.piece.com_known:
            raise ValueError(f"the centre of mass of {self.piece.name} is unknown")
        if self.bottoms.bodies[-1].upper is None:
            raise ValueError(f"{self.bottoms.bodies[-1].name} carries nothing")
        *below, top = self.bottoms.bodies
        if top.surface.flat and (surface := self._drawn_surface()) is not geometry.FLAT:
            drawn = geometry.Tower((*below, replace(top, surface=surface)))
            object.__setattr__(self, "bottoms", drawn)
        # Refuses towers with a face that is not flat below another bottom.
        self.bottoms.with_top(self.piece.body())

    def _drawn_surface(self) -> geometry.Surface:
        rng = conditions.scoped_generator(self.seed, SeedScope.SURFACE, self.number)
        return draw_surface(self.settings.surface, max(self.surface.half_extents_mm), rng)

    @property
    def grip_height_mm(self) -> float:
        """Nominal height of the grasp pivot above the face."""
        assert self.piece.grip_height_mm is not None
        return self.piece.grip_height_mm

    @property
    def number(self) -> int:
        """Number of piece and bottoms, a part of the seed of every draw."""
        return geometry.scene_number(self.piece.name, *(body.name for body in self.bottoms.bodies))

    @property
    def surface(self) -> geometry.Outline:
        """Outline of the surface that is touched."""
        upper = self.bottoms.bodies[-1].upper
        assert upper is not None
        return upper


def scene_mounting(scene: Scene) -> MountingDraw:
    """Return the draw of the scene's mounting."""
    place = (scene.number, scene.mounting)
    rng = conditions.scoped_generator(scene.seed, conditions.SeedScope.MOUNTING, *place)
    return conditions.draw_mounting(scene.settings, rng)


def true_com_xy_mm(scene: Scene) -> tuple[float, float]:
    """Return the true centre of mass of the piece in ``F``; the entered one is only near it."""
    x, y = scene.piece.com_xy_mm
    if not scene.settings.spread.com_mm:
        return x, y
    dx, dy = scene_mounting(scene).com_mm
    return x + dx, y + dy


def touched_margins_mm(
    scene: Scene, com_xy_mm: tuple[float, float], places_mm: FloatArray
) -> FloatArray:
    """Return the margins (n,) on the touched face alone with the centre of mass at ``places_mm``.

    ``com_xy_mm``: centre of mass in ``F``. The piece is not rotated.
    """
    piece, top = scene.piece, scene.bottoms.bodies[-1]
    return geometry.surface_margins_mm(
        piece.face, com_xy_mm, piece.com_height_mm, scene.surface, top.surface, places_mm
    )


MAX_RELEASE_GAP_MM = 2.0  # released higher above the support, the piece counts as fallen


@dataclass(frozen=True, slots=True)
class SceneTruth:
    """Ground truth of a scene.

    ``offset_mm``: displacement of the face from ``O``. ``margin_mm``: signed margin of the whole
    tower, as if released here; after the release the one that decided. ``stands``: None before the
    release. ``slip_mm``: largest slip of a pad in the present grip. ``contradicted``: True if
    MuJoCo disagrees with the exact analysis beyond its own error, None if it did not run.
    ``kick_mm``: distance by which the opening fingers shifted the centre of mass.
    """

    offset_mm: tuple[float, float]
    yaw_rad: float
    margin_mm: float
    stands: bool | None
    fall: Fall | None
    slip_mm: float
    knocked_over: bool
    contradicted: bool | None = None
    kick_mm: float = 0.0


def tower_with_piece(
    scene: Scene, offset_mm: tuple[float, float], yaw_rad: float
) -> geometry.Tower:
    """Return the true tower with the piece at ``offset_mm`` from its topmost bottom."""
    carrier = scene.bottoms.bodies[-1]
    at_mm = (carrier.at_mm[0] + offset_mm[0], carrier.at_mm[1] + offset_mm[1])
    body = replace(scene.piece.body(at_mm, yaw_rad), com_xy_mm=true_com_xy_mm(scene))
    return scene.bottoms.with_top(body)


def true_margin_mm(
    scene: Scene,
    offset_mm: tuple[float, float],
    yaw_rad: float,
    kick_mm: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return the signed margin of the whole tower; ``kick_mm`` moves the top's centre of mass."""
    return judge_release(scene, offset_mm, yaw_rad, kick_mm).margin_mm


def judge_release(
    scene: Scene,
    offset_mm: tuple[float, float],
    yaw_rad: float,
    kick_mm: tuple[float, float] = (0.0, 0.0),
    *,
    sign_only: bool = False,
) -> geometry.TowerVerdict:
    """Return the margins of the tower with the piece released at ``offset_mm``.

    ``sign_only``: infinite on a face that is not flat, without the search for the margin.
    """
    tower = tower_with_piece(scene, offset_mm, yaw_rad)
    return geometry.judge_tower(tower, kick_mm, scene.settings.mu, sign_only=sign_only)


def release_kick_mm(scene: Scene, release: int) -> tuple[float, float]:
    """Return the effect of the opening fingers as a random shift of the centre of mass."""
    sigma = scene.settings.release_disturbance_mm
    x, y = sigma * np.random.default_rng([scene.seed, scene.number, 5, release]).standard_normal(2)
    return float(x), float(y)


def mujoco_opinion(
    scene: Scene, offset_mm: tuple[float, float], yaw_rad: float, kick_mm: tuple[float, float]
) -> tuple[Fall | None, bool] | None:
    """Simulate the release with MuJoCo: (motion of a fall, True if it contradicts the analysis).

    None if MuJoCo is not installed.
    """
    if not mujoco_available():
        return None
    tower = tower_with_piece(scene, offset_mm, yaw_rad)
    fallen, motion = simulate_release(tower, disturbance_mm=kick_mm)
    verdict = judge_release(scene, offset_mm, yaw_rad, kick_mm)
    return (motion if fallen else None), contradicts_analysis(verdict, fallen)

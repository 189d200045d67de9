"""The truth about a simulated scene, for scoring and display after the trial only."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.core.flow import Fall
from backend.objects.tower import Tower, judge
from backend.simulation.release_mujoco import available, differs, simulate_release
from backend.simulation.scene import Scene

DROP_MM = 2.0
"""Let go higher than this above the support the piece is counted as fallen."""


@dataclass(frozen=True, slots=True)
class Truth:
    """How things really are.

    ``offset_mm``: displacement of the face from ``O``. ``margin_mm``: signed margin of the whole
    tower, as if released here; after the release the one that decided. ``stands``: None before the
    release. ``slip_mm``: largest slip of a pad in the present gripping. ``contradicted``: whether
    the physics engine disagrees with the exact judge beyond its own error, None if not asked.
    """

    offset_mm: tuple[float, float]
    yaw_rad: float
    margin_mm: float
    stands: bool | None
    fall: Fall | None
    slip_mm: float
    knocked_over: bool
    contradicted: bool | None = None


def stacked(scene: Scene, offset_mm: tuple[float, float], yaw_rad: float) -> Tower:
    """Return the tower with the piece at ``offset_mm`` from its topmost bottom."""
    carrier = scene.bottoms.bodies[-1]
    at_mm = (carrier.at_mm[0] + offset_mm[0], carrier.at_mm[1] + offset_mm[1])
    return scene.bottoms.with_top(scene.piece.body(at_mm, yaw_rad))


def margin_mm(
    scene: Scene,
    offset_mm: tuple[float, float],
    yaw_rad: float,
    kick_mm: tuple[float, float] = (0.0, 0.0),
) -> float:
    """Return the signed margin of the whole tower; ``kick_mm`` moves the top's centre of mass."""
    return judge(stacked(scene, offset_mm, yaw_rad), kick_mm).margin_mm


def release_kick_mm(scene: Scene, release: int) -> tuple[float, float]:
    """Return the kick of the opening fingers, normal per axis (settings: equivalent CoM shift)."""
    sigma = scene.settings.release_disturbance_mm
    seed = np.random.SeedSequence([scene.seed, 5, release])
    x, y = sigma * np.random.Generator(np.random.PCG64(seed)).standard_normal(2)
    return float(x), float(y)


def drops(gap_mm: float) -> bool:
    """Return whether a piece let go at this height counts as fallen."""
    return not (math.isfinite(gap_mm) and gap_mm <= DROP_MM)


def second_opinion(
    scene: Scene, offset_mm: tuple[float, float], yaw_rad: float, kick_mm: tuple[float, float]
) -> tuple[Fall | None, bool] | None:
    """Ask the physics engine: (motion if the piece fell, whether it contradicts the exact judge).

    None where the optional engine is not installed.
    """
    if not available():
        return None
    tower = stacked(scene, offset_mm, yaw_rad)
    fallen, motion = simulate_release(tower, disturbance_mm=kick_mm)
    return (motion if fallen else None), differs(judge(tower, kick_mm), fallen)

"""Rigid motion of the marker grid in its image plane, and what is left of it: grasp slip.

A held piece that turns or slides as a whole moves the markers under it as one rigid body; what a
rigid motion does not explain is shear of the gel.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray, MarkerField, MarkerState


@dataclass(frozen=True, slots=True)
class RigidMotion:
    """``shift_px`` (2,) of the grid's centre, ``turn_rad`` (u towards v), rms ``residual_px``."""

    shift_px: FloatArray
    turn_rad: float
    residual_px: float


def fit_rigid(rest_px: FloatArray, displacement_px: FloatArray) -> RigidMotion:
    """Fit a rotation and a shift to ``displacement_px`` (n, 2) at ``rest_px`` (n, 2).

    Least squares in the plane (Kabsch 1976, two dimensions). Without markers all is zero.
    """
    if not len(rest_px):
        return RigidMotion(np.zeros(2), 0.0, 0.0)
    # Complex numbers: a turn is one product.
    before, moved = _complex(rest_px), _complex(displacement_px)
    shift = moved.mean()
    before = before - before.mean()
    after = before + (moved - shift)
    turn = cmath.phase(complex(np.vdot(before, after)))
    left = after - before * cmath.rect(1.0, turn)
    residual = math.sqrt(float(np.vdot(left, left).real) / len(left))
    return RigidMotion(np.array([shift.real, shift.imag]), turn, residual)


def slip_mm(before: MarkerField, after: MarkerField, mm_per_px: float) -> float:
    """Return how far the held piece slipped between two fields at the same load, in mm.

    The largest movement of any marker seen in both, after a rigid fit of the change of
    displacement: an unloaded gel that comes back to its place has not slipped.
    """
    seen = (before.state == MarkerState.SEEN) & (after.state == MarkerState.SEEN)
    if not seen.any():
        return float("nan")
    rest = before.position_px[seen]
    change = after.displacement_px[seen] - before.displacement_px[seen]
    motion = fit_rigid(rest, change)
    arm = rest - rest.mean(axis=0)
    swirl = motion.turn_rad * np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    return mm_per_px * float(np.linalg.norm(motion.shift_px + swirl, axis=1).max())


def _complex(points_px: FloatArray) -> NDArray[np.complex128]:
    """Return (n,) u + iv of (n, 2) points."""
    return np.ascontiguousarray(points_px).view(np.complex128)[:, 0]

"""What a displacement means: which points touch, what hull they span, how the piece would stand.

The patch is never drawn by hand: it follows from the two faces and the displacement (Ota et al.
2023, section III; the stable flag is "centre of mass inside the hull of the patch").
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray, SupportKind, read_only
from backend.objects.shapes import Outline, turned
from backend.objects.surface import true_patch
from backend.placement.hull import convex_hull, signed_margin_mm

TOO_CLOSE_MM = 0.2
"""Nearer to the edge than this nobody can say whether the piece stands."""

_KINDS = (SupportKind.NONE, SupportKind.POINT, SupportKind.LINE)


@dataclass(frozen=True, slots=True)
class Resting:
    """The face at one displacement, all in the bottom frame ``O``.

    ``points_mm`` (N, 2) and ``touching`` (N,): the face's lattice; ``hull_mm`` (k, 2) of the points
    that touch, counter-clockwise; ``centre_mm``: the centre of mass; ``margin_mm`` signed, positive
    inside the hull, ``-inf`` without contact.
    """

    points_mm: FloatArray
    touching: NDArray[np.bool_]
    hull_mm: FloatArray
    centre_mm: tuple[float, float]
    margin_mm: float
    support: SupportKind

    def __post_init__(self) -> None:
        for array in (self.points_mm, self.touching, self.hull_mm):
            read_only(array)

    @property
    def stable(self) -> bool:
        """Whether the centre of mass lies inside the hull or on its edge."""
        return self.support is SupportKind.AREA and self.margin_mm >= 0

    @property
    def too_close(self) -> bool:
        """Whether the margin is too small for a verdict."""
        return abs(self.margin_mm) < TOO_CLOSE_MM

    @property
    def share(self) -> float:
        """Part of the face that touches, 0..1."""
        return float(self.touching.mean()) if len(self.touching) else 0.0


def rest_at(
    points_mm: FloatArray,
    com_xy_mm: tuple[float, float],
    bottom: Outline,
    offset_mm: tuple[float, float],
    yaw_rad: float = 0.0,
) -> Resting:
    """Return what the face does at ``offset_mm``, turned by ``yaw_rad``.

    ``points_mm`` (N, 2) is the lattice of the face and ``com_xy_mm`` the centre of mass, both in
    ``F``. Raises ``ValueError`` unless the displacement is finite.
    """
    if not all(map(math.isfinite, (*offset_mm, yaw_rad))):
        raise ValueError("the displacement is not finite")
    touching = true_patch(points_mm, offset_mm, bottom, yaw_rad)
    shift = np.asarray(offset_mm)
    hull = turned(convex_hull(points_mm[touching]), yaw_rad) + shift
    centre = turned(np.asarray([com_xy_mm], dtype=np.float64), yaw_rad)[0] + shift
    at = (float(centre[0]), float(centre[1]))
    support = _KINDS[len(hull)] if len(hull) < 3 else SupportKind.AREA
    placed = turned(points_mm, yaw_rad) + shift
    return Resting(placed, touching, hull, at, signed_margin_mm(hull, at), support)

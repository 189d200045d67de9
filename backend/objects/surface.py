"""Points of a contact face, and which of them truly touch: the label of the method.

Ota et al. 2023, section III: the face is a set of points, and a point is in contact if it lies
inside the outline of the surface below.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from backend.core.flow import FloatArray
from backend.objects import clipping
from backend.objects.shapes import CIRCLE_SEGMENTS, EDGE_TOLERANCE_MM, Outline, turned


def face_points(outline: Outline, pitch_mm: float = 1.0) -> FloatArray:
    """Return the lattice points (N, 2) of a face in mm, row by row (y, then x, ascending).

    Points lie at whole multiples of ``pitch_mm``, the face centre among them: 177 for a circle of
    15 mm, 349 for 21.2 mm, 505 for 25.4 mm. Raises ValueError unless the pitch is positive.
    """
    if not pitch_mm > 0.0:
        raise ValueError("the pitch must be positive")
    reach_x, reach_y = (
        int((extent + EDGE_TOLERANCE_MM) / pitch_mm) for extent in outline.half_extents_mm
    )
    x = pitch_mm * np.arange(-reach_x, reach_x + 1)
    y = pitch_mm * np.arange(-reach_y, reach_y + 1)
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    return np.asarray(lattice[outline.contains(lattice)], dtype=np.float64)


def true_patch(
    points_mm: FloatArray, offset_mm: ArrayLike, bottom: Outline, yaw_rad: float = 0.0
) -> NDArray[np.bool_]:
    """Return (..., N): which face points touch when the face sits at ``offset_mm`` (..., 2).

    ``yaw_rad`` turns the face about its centre; the bottom outline is that of frame ``O``.
    """
    offset = np.asarray(offset_mm, dtype=np.float64)
    return bottom.contains(turned(points_mm, yaw_rad) + offset[..., None, :])


def overlap_polygon(
    face: Outline, offset_mm: tuple[float, float], bottom: Outline, yaw_rad: float = 0.0
) -> FloatArray:
    """Return the true overlap (k, 2) in frame ``O``, counter-clockwise; k = 0 without overlap."""
    return clipping.ring(clipping.overlap(face.placed(offset_mm, yaw_rad), bottom.polygon()))


def overlap_area_mm2(
    face: Outline,
    offset_mm: ArrayLike,
    bottom: Outline,
    yaw_rad: float = 0.0,
    segments: int = CIRCLE_SEGMENTS,
) -> FloatArray:
    """Return the overlap area (...,) in mm² of the face at each offset (..., 2).

    Exact for two circles; otherwise a circle counts as a polygon of ``segments`` corners.
    """
    offset = np.asarray(offset_mm, dtype=np.float64)
    if face.kind == bottom.kind == "circle":
        return _lens_mm2(np.hypot(offset[..., 0], offset[..., 1]), face.radius_mm, bottom.radius_mm)
    moved = turned(face.polygon(segments), yaw_rad) + offset[..., None, :]
    return clipping.area_mm2(clipping.overlap(moved, bottom.polygon(segments)))


def _lens_mm2(distance_mm: FloatArray, r: float, s: float) -> FloatArray:
    """Return the common area of two circles of radius r and s mm, their centres apart."""
    apart = np.clip(distance_mm, abs(r - s), r + s)
    # Distance from each centre to the common chord; concentric equal circles share a diameter.
    near = np.divide(apart**2 + r**2 - s**2, 2 * apart, out=np.zeros_like(apart), where=apart > 0)
    segments = [
        radius**2 * np.arccos(np.clip(chord / radius, -1.0, 1.0))
        - chord * np.sqrt(np.maximum(radius**2 - chord**2, 0.0))
        for radius, chord in ((r, near), (s, apart - near))
    ]
    return np.asarray(np.maximum(segments[0] + segments[1], 0.0), dtype=np.float64)

"""Would the piece stand? The centre of mass against the hull of confident support (method 9)."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from backend.config.method import StabilitySettings
from backend.core.flow import ContactPatch, FloatArray, Stability, SupportKind
from backend.placement.belief import Belief, is_finite
from backend.placement.coverage import CellGrid, cover, face_lattice
from backend.placement.hull import convex_hull, signed_margin_mm

KINDS = (SupportKind.NONE, SupportKind.POINT, SupportKind.LINE)


def judge(
    belief: Belief,
    patch: ContactPatch,
    com_xy_mm: tuple[float, float],
    offset_mm: tuple[float, float],
    settings: StabilitySettings,
) -> Stability:
    """Judge the piece at ``offset_mm`` (frame of the map).

    ``patch`` is the latest estimate; its points are the face. ``com_xy_mm`` is the centre of mass
    in ``F``. Only support under the present face counts: a cell beside the piece carries nothing.
    """
    centre = (offset_mm[0] + com_xy_mm[0], offset_mm[1] + com_xy_mm[1])
    finite = is_finite(patch) and bool(np.isfinite(belief.map.log_odds).all())
    if not finite or not all(map(math.isfinite, centre)):
        return Stability(
            False, math.nan, SupportKind.NO_ESTIMATE, np.zeros((0, 2)), centre, settings.judge_from
        )
    if settings.judge_from == "belief":
        hull = _hull_on_map(belief, patch, offset_mm, settings.delta)
    else:
        hull = _hull_on_face(belief, patch, offset_mm, settings.delta)
    margin_mm = signed_margin_mm(hull, centre)
    support = KINDS[len(hull)] if len(hull) < 3 else SupportKind.AREA
    stable = support is SupportKind.AREA and margin_mm >= settings.margin_mm
    return Stability(stable, margin_mm, support, hull, centre, settings.judge_from)


def confident(belief: Belief, delta: float) -> NDArray[np.bool_]:
    """(ny, nx) cells whose probability of support exceeds ``delta``."""
    return np.asarray(belief.map.log_odds > threshold(delta), dtype=np.bool_)


def threshold(delta: float) -> float:
    """Return the log odds of ``delta``; 2.1972 for 0.9."""
    return math.log(delta / (1.0 - delta))


def support_hull_mm(belief: Belief, cells: NDArray[np.bool_]) -> FloatArray:
    """(k, 2) hull in mm of the centres of the marked ``cells`` (ny, nx)."""
    rows, columns = np.nonzero(cells)
    # Cell indices are whole numbers: collinear cells are found exactly.
    hull = convex_hull(np.stack((columns, rows), axis=1))
    return CellGrid.of(belief.map).to_mm(hull)


def _hull_on_map(
    belief: Belief, patch: ContactPatch, offset_mm: tuple[float, float], delta: float
) -> FloatArray:
    last = belief.evidence[-1] if belief.evidence else None
    if last is None or last.offset_mm != offset_mm:
        last = cover(CellGrid.of(belief.map), patch.points_mm, patch.probability, offset_mm)
    under = last.covered
    return support_hull_mm(belief, confident(belief, delta) & under)


def _hull_on_face(
    belief: Belief, patch: ContactPatch, offset_mm: tuple[float, float], delta: float
) -> FloatArray:
    """Hull of the latest patch alone, on the points of the face itself."""
    face = face_lattice(patch.points_mm, belief.map.pitch_mm)
    hull = convex_hull(face.index[belief.log_odds(patch.probability) > threshold(delta)])
    corner = np.add(face.corner_mm, offset_mm)
    return np.asarray(corner + face.pitch_mm * hull, dtype=np.float64)

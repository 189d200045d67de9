"""Which cells of the belief map a face covers, and the face's values brought onto them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import BeliefMap, FloatArray, read_only
from backend.placement.hull import convex_hull, inside

SNAP = 1e-6
"""Part of a pitch below which grids are taken to coincide."""
LEAST_WEIGHT = 0.5
"""A cell is covered only if at least this share of its bilinear weight lies on the face."""


@dataclass(frozen=True, slots=True)
class CellGrid:
    """A square grid: cell (i, j) is centred at ``origin_mm + pitch_mm * (j, i)``."""

    origin_mm: tuple[float, float]
    pitch_mm: float
    shape: tuple[int, int]

    @classmethod
    def of(cls, belief: BeliefMap) -> CellGrid:
        """Return the grid of ``belief``."""
        rows, columns = belief.log_odds.shape
        return cls(belief.origin_mm, belief.pitch_mm, (rows, columns))

    def to_mm(self, cells: FloatArray) -> FloatArray:
        """Turn (k, 2) cell coordinates (column, row) into mm."""
        return np.asarray(self.origin_mm + self.pitch_mm * cells, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one probe says: ``log_odds`` (ny, nx), zero where not ``covered`` (ny, nx)."""

    offset_mm: tuple[float, float]
    covered: NDArray[np.bool_]
    log_odds: FloatArray

    def __post_init__(self) -> None:
        read_only(self.covered)
        read_only(self.log_odds)


@dataclass(frozen=True, slots=True)
class FaceLattice:
    """Face points as a full grid; its corner (0, 0) stands at ``corner_mm`` in ``F``.

    ``index`` (N, 2): column and row of each point; ``present`` (ny, nx); ``hull`` (k, 2): hull of
    the points in lattice coordinates.
    """

    corner_mm: tuple[float, float]
    pitch_mm: float
    index: NDArray[np.intp]
    present: NDArray[np.bool_]
    hull: FloatArray

    def __post_init__(self) -> None:
        for array in (self.index, self.present, self.hull):
            read_only(array)

    def grid(self, values: FloatArray) -> FloatArray:
        """Return ``values`` (N,) as (ny, nx), zero where there is no point."""
        grid = np.zeros(self.present.shape)
        grid[self.index[:, 1], self.index[:, 0]] = values
        return grid


def face_lattice(points_mm: FloatArray, pitch_mm: float) -> FaceLattice:
    """Arrange the lattice points (N, 2) of a face as a grid.

    ``pitch_mm`` is used where the points do not show one (a single point). Raises ValueError if
    the points are not those of a square lattice.
    """
    return _arranged(np.ascontiguousarray(points_mm, dtype=np.float64).tobytes(), pitch_mm)


@lru_cache(maxsize=16)
def _arranged(points: bytes, pitch_mm: float) -> FaceLattice:
    """Arrange once: every probe of a run has the same face."""
    points_mm = np.frombuffer(points, dtype=np.float64).reshape(-1, 2)
    corner = points_mm.min(axis=0)
    steps = np.diff(np.sort(points_mm, axis=0), axis=0)
    steps = steps[steps > SNAP]
    pitch = float(steps.min()) if len(steps) else pitch_mm
    place = (points_mm - corner) / pitch
    index = np.rint(place).astype(np.intp)
    if np.abs(place - index).max() > 1e3 * SNAP:
        raise ValueError("the points of the face do not lie on a square lattice")
    columns, rows = index.max(axis=0) + 1
    present = np.zeros((rows, columns), dtype=np.bool_)
    present[index[:, 1], index[:, 0]] = True
    corner_mm = (float(corner[0]), float(corner[1]))
    return FaceLattice(corner_mm, pitch, index, present, convex_hull(index))


def cover(
    grid: CellGrid, points_mm: FloatArray, values: FloatArray, offset_mm: tuple[float, float]
) -> Evidence:
    """Bring ``values`` (N,) at ``points_mm`` (N, 2) in ``F`` onto the cells that the face covers.

    Each covered cell is set exactly once: to the value of its lattice point where the grids
    coincide, else bilinearly. A cell is covered if it lies within the hull of the lattice, so that
    no support is ever claimed outside the face. Cells outside the map are left out.
    """
    face = face_lattice(points_mm, grid.pitch_mm)
    rows, v = _within(grid, face, offset_mm, axis=1)
    columns, u = _within(grid, face, offset_mm, axis=0)
    covered = np.zeros(grid.shape, dtype=np.bool_)
    log_odds = np.zeros(grid.shape)
    if len(rows) and len(columns):
        weight, total = _bilinear(face, values, u, v)
        cells = np.stack(np.meshgrid(u, v), axis=-1)
        on_face = (weight >= LEAST_WEIGHT - SNAP) & _in_hull(face, cells)
        window = np.ix_(rows, columns)
        covered[window] = on_face
        log_odds[window] = np.where(on_face, total / np.where(on_face, weight, 1.0), 0.0)
    return Evidence(offset_mm, covered, log_odds)


def _within(
    grid: CellGrid, face: FaceLattice, offset_mm: tuple[float, float], *, axis: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return the map's rows or columns within the face's box, and their lattice coordinate."""
    count = grid.shape[1 - axis]
    last = face.present.shape[1 - axis] - 1
    centre_mm = grid.origin_mm[axis] + grid.pitch_mm * np.arange(count)
    place = (centre_mm - offset_mm[axis] - face.corner_mm[axis]) / face.pitch_mm
    whole = np.rint(place)
    place = np.where(np.abs(place - whole) < SNAP, whole, place)
    kept = np.flatnonzero((place >= 0) & (place <= last))
    return kept, np.asarray(place[kept], dtype=np.float64)


def _bilinear(
    face: FaceLattice, values: FloatArray, u: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the weight of present lattice points, and the weighted sum of their values."""
    rows, columns = face.present.shape
    across, down = _hat(u, columns).T, _hat(v, rows)
    return down @ face.present.astype(np.float64) @ across, down @ face.grid(values) @ across


def _hat(place: FloatArray, count: int) -> FloatArray:
    """(n, count) weights of linear interpolation at ``place`` (n,) between whole numbers."""
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(count)))


def _in_hull(face: FaceLattice, cells: FloatArray) -> NDArray[np.bool_]:
    if len(face.hull) < 3:
        # A face of one point or one line: only cells exactly on its points are covered.
        return np.asarray((cells == np.rint(cells)).all(axis=-1), dtype=np.bool_)
    return inside(face.hull, cells)

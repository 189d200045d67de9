"""Belief map: contact probabilities of several probes, fused in log odds (method 8).

``cover_cells`` resamples the values of a face to the cells of the map.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import BeliefSettings
from touchdown.backend.core import BeliefMap, ContactPatch, FloatArray, InputError, read_only
from touchdown.backend.learning import PatchCalibration
from touchdown.backend.placement.equilibrium import convex_hull, inside_hull

SNAP = 1e-6  # grids coincide below this fraction of the pitch
# A cell is covered only if at least this share of its bilinear weight lies on the face.
LEAST_WEIGHT = 0.5


@dataclass(frozen=True, slots=True)
class CellGrid:
    """Square grid: cell (i, j) is centred at ``origin_mm + pitch_mm * (j, i)``."""

    origin_mm: tuple[float, float]
    pitch_mm: float
    shape: tuple[int, int]

    @classmethod
    def of(cls, belief: BeliefMap) -> CellGrid:
        """Return the grid of ``belief``."""
        rows, columns = belief.log_odds.shape
        return cls(belief.origin_mm, belief.pitch_mm, (rows, columns))

    def to_mm(self, cells: FloatArray) -> FloatArray:
        """Convert (k, 2) cell coordinates (column, row) to mm."""
        return np.asarray(self.origin_mm + self.pitch_mm * cells, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class CellEvidence:
    """Evidence of one probe: ``log_odds`` (ny, nx), zero where not ``covered`` (ny, nx)."""

    offset_mm: tuple[float, float]
    covered: NDArray[np.bool_]
    log_odds: FloatArray

    def __post_init__(self) -> None:
        read_only(self.covered)
        read_only(self.log_odds)


@dataclass(frozen=True, slots=True)
class FaceLattice:
    """Face points as a full grid; its corner (0, 0) is at ``corner_mm`` in ``F``.

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
        """Return ``values`` (N,) as (ny, nx), zero without a point."""
        grid = np.zeros(self.present.shape)
        grid[self.index[:, 1], self.index[:, 0]] = values
        return grid


def face_lattice(points_mm: FloatArray, pitch_mm: float) -> FaceLattice:
    """Arrange the lattice points (N, 2) of a face as a grid.

    ``pitch_mm`` is used for a single point. Raises ``ValueError`` if the points do not form a
    square lattice.
    """
    return _arranged(np.ascontiguousarray(points_mm, dtype=np.float64).tobytes(), pitch_mm)


@lru_cache(maxsize=16)
def _arranged(points: bytes, pitch_mm: float) -> FaceLattice:
    """Arrange the points, cached: every probe of a run has the same face."""
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


def cover_cells(
    grid: CellGrid, points_mm: FloatArray, values: FloatArray, offset_mm: tuple[float, float]
) -> CellEvidence:
    """Resample ``values`` (N,) at ``points_mm`` (N, 2) in ``F`` to the cells that the face covers.

    Each covered cell is set once: to the value of its lattice point if the grids coincide, else by
    bilinear interpolation. A cell is covered if it lies within the hull of the lattice, so no
    support is claimed outside the face. Cells outside the map are ignored.
    """
    face = face_lattice(points_mm, grid.pitch_mm)
    rows, v = _within(grid, face, offset_mm, axis=1)
    columns, u = _within(grid, face, offset_mm, axis=0)
    covered = np.zeros(grid.shape, dtype=np.bool_)
    log_odds = np.zeros(grid.shape)
    if len(rows) and len(columns):
        weight, total = _bilinear(face, values, u, v)
        cells = np.stack(np.meshgrid(u, v), axis=-1)
        if len(face.hull) < 3:
            # A face of one point or line: only cells exactly on its points are covered.
            in_hull = (cells == np.rint(cells)).all(axis=-1)
        else:
            in_hull = inside_hull(face.hull, cells)
        on_face = (weight >= LEAST_WEIGHT - SNAP) & in_hull
        window = np.ix_(rows, columns)
        covered[window] = on_face
        log_odds[window] = np.where(on_face, total / np.where(on_face, weight, 1.0), 0.0)
    return CellEvidence(offset_mm, covered, log_odds)


def _within(
    grid: CellGrid, face: FaceLattice, offset_mm: tuple[float, float], *, axis: int
) -> tuple[NDArray[np.intp], FloatArray]:
    """Return rows or columns of the map within the face's box, and their lattice coordinates."""
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
    """Return the weight of the present lattice points, and the weighted sum of their values."""
    rows, columns = face.present.shape
    across, down = _hat(u, columns).T, _hat(v, rows)
    return down @ face.present.astype(np.float64) @ across, down @ face.grid(values) @ across


def _hat(place: FloatArray, count: int) -> FloatArray:
    """Return the weights (n, count) of linear interpolation at ``place`` (n,)."""
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(count)))


@dataclass(frozen=True, slots=True)
class Belief:
    """Belief map of one trial, with the evidence it was built from.

    Attributes
    ----------
    settings : Settings
        Settings of the fusion, ``StackSettings().belief``.
    map : BeliefMap
        Support estimated from all probes.
    evidence, visits : tuple
        Probes that count; offset of every probe, mm, including replaced ones.
    base_rate : float
        Share of contact points in the training data.
    calibration : PatchCalibration or None
        Calibration of the network; without one, probabilities are fused as the paper does.

    Examples
    --------
    >>> from touchdown import Belief, ContactPatch, StackSettings
    >>> patch = ContactPatch(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.9, 0.1]))
    >>> belief = Belief.unknown(StackSettings().belief, (0.0, 0.0)).updated(patch, (0.0, 0.0))
    >>> belief.map.probability[32, 32:34].round(2).tolist()
    [0.9, 0.1]

    """

    settings: BeliefSettings
    map: BeliefMap
    evidence: tuple[CellEvidence, ...] = ()
    visits: tuple[tuple[float, float], ...] = ()
    base_rate: float = 0.5
    calibration: PatchCalibration | None = None

    @classmethod
    def unknown(
        cls,
        settings: BeliefSettings,
        origin_mm: tuple[float, float],
        base_rate: float | None = None,
        calibration: PatchCalibration | None = None,
    ) -> Belief:
        """Return the belief before any probe: probability 0.5 everywhere.

        ``origin_mm`` is the offset of the first probe; cells coincide with its face lattice. Raises
        ``InputError`` if the prior correction is on and the model has no base rate.
        """
        if settings.prior_correction and not (base_rate is not None and 0 < base_rate < 1):
            raise InputError(
                "The prior correction needs the base rate of the model's training data.",
                "belief.prior_correction",
                "Use a model whose card names its base rate, or switch the correction off.",
            )
        reach = math.ceil(settings.half_extent_mm / settings.pitch_mm)
        side = 2 * reach + 1
        x_mm, y_mm = (at - reach * settings.pitch_mm for at in origin_mm)
        grid = CellGrid((x_mm, y_mm), settings.pitch_mm, (side, side))
        rate = 0.5 if base_rate is None else base_rate
        blank = _fused(grid, (), settings.log_odds_limit)
        return cls(settings, blank, base_rate=rate, calibration=calibration)

    def updated(self, patch: ContactPatch, offset_mm: tuple[float, float]) -> Belief:
        """Return the belief after a probe at ``offset_mm`` (commanded ``F``, frame of the map).

        A probe within ``min_shift_mm`` of former ones replaces them. A patch with values that are
        not finite counts as a visit and changes nothing.
        """
        visits = (*self.visits, offset_mm)
        if not is_finite(patch) or not all(map(math.isfinite, offset_mm)):
            return replace(self, visits=visits)
        grid = CellGrid.of(self.map)
        values = self.log_odds(patch.probability)
        least_mm = self.settings.min_shift_mm
        kept = tuple(e for e in self.evidence if math.dist(e.offset_mm, offset_mm) >= least_mm)
        evidence = (*kept, cover_cells(grid, patch.points_mm, values, offset_mm))
        fused = _fused(grid, evidence, self.settings.log_odds_limit, self.prior_log_odds)
        return replace(self, map=fused, evidence=evidence, visits=visits)

    @property
    def prior_log_odds(self) -> float:
        """Log odds of a covered cell before the evidence of any probe."""
        return 0.0 if self.calibration is None else self.calibration.prior_log_odds

    def log_odds(self, probability: FloatArray) -> FloatArray:
        """Convert ``probability`` (N,) to evidence: by the calibration, else by the settings."""
        if self.calibration is not None:
            return self.calibration.evidence(probability)
        clip = self.settings.clip
        p = np.clip(probability, clip, 1.0 - clip)
        evidence = np.log(p / (1.0 - p)) / self.settings.temperature
        if self.settings.prior_correction:
            evidence = evidence - math.log(self.base_rate / (1.0 - self.base_rate))
        return np.asarray(evidence, dtype=np.float64)


def is_finite(patch: ContactPatch) -> bool:
    """Return True if the patch has points and all probabilities are finite."""
    arrays = patch.points_mm, patch.probability
    return len(patch.points_mm) > 0 and all(bool(np.isfinite(each).all()) for each in arrays)


def _fused(
    grid: CellGrid, evidence: tuple[CellEvidence, ...], limit: float, prior_log_odds: float = 0.0
) -> BeliefMap:
    """Add all evidence, then limit the sum, so that the order of the probes does not matter.

    The prior counts once in every covered cell; other cells stay unknown.
    """
    log_odds = np.zeros(grid.shape)
    covered = np.zeros(grid.shape, dtype=np.bool_)
    for item in evidence:
        log_odds += item.log_odds
        covered |= item.covered
    log_odds[covered] += prior_log_odds
    return BeliefMap(
        log_odds=np.clip(log_odds, -limit, limit),
        covered=covered,
        origin_mm=grid.origin_mm,
        pitch_mm=grid.pitch_mm,
        probes=len(evidence),
    )

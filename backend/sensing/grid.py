"""Puts dots into rows and columns by geometry alone, and names what does not fit.

The lattice is grown outwards from one dot, each step predicted from the last local pitch; dots
between the lattice places are left over. Order never depends on the order of detection.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.sensing.detector import HEIGHT_PX, WIDTH_PX, Blobs

Cell = tuple[int, int]
_REACH = 0.38
_PITCH_RANGE_PX = (22.0, 44.0)
_USUAL_PITCH_PX = 32.0
_MOST_SEEDS = 12
_FEWEST_PER_LINE = 3
_MOST_MISSING = 12
_STEPS: tuple[Cell, ...] = ((0, 1), (0, -1), (1, 0), (-1, 0))


@dataclass(frozen=True, slots=True)
class GridReport:
    """The grid found in one frame: ``rows`` x ``cols`` and the cells without a whole dot."""

    rows: int
    cols: int
    missing: tuple[Cell, ...]
    pitch_px: float

    @property
    def usable(self) -> bool:
        """Whether every marker of a 7 x 9 grid has its certain place (some may be hidden)."""
        fits = (self.rows, self.cols) == (GRID_ROWS, GRID_COLS)
        return fits and len(self.missing) <= _MOST_MISSING

    @property
    def complete(self) -> bool:
        """Whether all 63 dots of a 7 x 9 grid are there."""
        return self.usable and not self.missing

    @property
    def message(self) -> str:
        """What was found, for the operator."""
        if self.complete:
            return "7x9 grid, all 63 dots found"
        if self.rows >= GRID_ROWS + 1 and self.cols >= GRID_COLS:
            return (
                f"8x10 small-dot gel recognised ({self.rows} rows x {self.cols} columns seen): "
                "the 252 model inputs need the 7x9 large-dot gel"
            )
        if (self.rows, self.cols) != (GRID_ROWS, GRID_COLS):
            return f"found {self.rows} rows x {self.cols} columns of dots, expected 7 x 9"
        cells = ", ".join(f"({row}, {col})" for row, col in self.missing)
        return f"7x9 grid, {len(self.missing)} dots missing at (row, column) {cells}"


NO_GRID = GridReport(0, 0, (), 0.0)


@dataclass(frozen=True, slots=True)
class OrderedDots:
    """``index``: (63,) into the blobs, row-major, -1 where no whole dot is; see ``report``."""

    report: GridReport
    index: NDArray[np.intp]


def order_grid(blobs: Blobs) -> OrderedDots:
    """Order the dots of one frame; ``index`` is all -1 unless ``report.usable``."""
    nowhere = np.full(MARKERS, -1, dtype=np.intp)
    count = len(blobs.whole)
    if count < 2 * _FEWEST_PER_LINE:
        return OrderedDots(NO_GRID, nowhere)
    best, pitch_px = _best_lattice(blobs)
    report, first = _report(best, blobs.whole, pitch_px)
    if not report.usable:
        return OrderedDots(report, nowhere)
    for (row, col), blob in best.items():
        if blobs.whole[blob]:
            nowhere[(row - first[0]) * GRID_COLS + col - first[1]] = blob
    return OrderedDots(report, nowhere)


def _best_lattice(blobs: Blobs) -> tuple[dict[Cell, int], float]:
    """Return the largest lattice that grows from any seed, and its pitch in px."""
    gap = np.linalg.norm(blobs.centre_px[:, None] - blobs.centre_px[None], axis=-1)
    np.fill_diagonal(gap, np.inf)
    nearest_px = float(np.clip(np.median(gap.min(axis=1)), *_PITCH_RANGE_PX))
    best: dict[Cell, int] = {}
    best_pitch_px = nearest_px
    # With many decoys the nearest dot is not a neighbour: then try the pitch that gels have.
    for pitch_px in (nearest_px, _USUAL_PITCH_PX):
        tried: set[int] = set()
        for seed in map(int, _seeds(blobs)):
            if seed in tried:
                continue  # it would grow the same lattice again
            grown = _grow(blobs.centre_px, seed, pitch_px)
            tried |= set(grown.values())
            trimmed = _trim(grown)
            if len(trimmed) > len(best):
                best, best_pitch_px = trimmed, pitch_px
        if len(best) >= MARKERS or abs(nearest_px - _USUAL_PITCH_PX) < 0.15 * _USUAL_PITCH_PX:
            break
    return best, best_pitch_px


def _seeds(blobs: Blobs) -> NDArray[np.intp]:
    """Return whole blobs from the middle of the image outwards."""
    middle = np.array([WIDTH_PX / 2, HEIGHT_PX / 2])
    away = np.linalg.norm(blobs.centre_px - middle, axis=1) + 1e6 * ~blobs.whole
    return np.argsort(away, kind="stable")[:_MOST_SEEDS]


def _grow(dots: FloatArray, seed: int, pitch_px: float) -> dict[Cell, int]:
    """Grow the lattice from ``seed``; returns dot index by (row, column) relative to it."""
    cells: dict[Cell, int] = {(0, 0): seed}
    basis = {(0, 0): pitch_px * np.array([[1.0, 0.0], [0.0, 1.0]])}
    used = {seed}
    queue: deque[Cell] = deque([(0, 0)])
    while queue:
        cell = queue.popleft()
        for step in _STEPS:
            following = (cell[0] + step[0], cell[1] + step[1])
            if following in cells:
                continue
            axis, sign = (0, step[1]) if step[1] else (1, step[0])
            here = dots[cells[cell]]
            away = np.linalg.norm(dots - here - sign * basis[cell][axis], axis=1)
            nearest = int(away.argmin())
            if away[nearest] > _REACH * pitch_px or nearest in used:
                continue
            used.add(nearest)
            cells[following] = nearest
            local = basis[cell].copy()
            local[axis] = 0.5 * local[axis] + 0.5 * sign * (dots[nearest] - here)
            basis[following] = local
            queue.append(following)
    return cells


def _trim(cells: dict[Cell, int]) -> dict[Cell, int]:
    """Drop border lines of fewer than three dots: stray blobs just outside the grid."""
    while cells:
        for axis in (0, 1):
            lines = [cell[axis] for cell in cells]
            for line in (min(lines), max(lines)):
                if lines.count(line) < _FEWEST_PER_LINE:
                    cells = {c: i for c, i in cells.items() if c[axis] != line}
                    break
            else:
                continue
            break
        else:
            return cells
    return cells


def _report(
    cells: dict[Cell, int], whole: NDArray[np.bool_], pitch_px: float
) -> tuple[GridReport, Cell]:
    """Return the report and the first (row, column) of the lattice."""
    if not cells:
        return NO_GRID, (0, 0)
    rows, cols = [row for row, _ in cells], [col for _, col in cells]
    top, left = min(rows), min(cols)
    height, width = max(rows) - top + 1, max(cols) - left + 1
    missing = tuple(
        (row, col)
        for row in range(height)
        for col in range(width)
        if (blob := cells.get((top + row, left + col))) is None or not whole[blob]
    )
    return GridReport(height, width, missing, pitch_px), (top, left)

"""Detection of the dark dots in a tactile image, and of the grid that they form.

The image is first flattened: the brightest colour channel is divided by its level around the dots,
which removes coloured light, flicker and the shading of a contact. Blobs are connected dark regions
at half resolution. A centre is the fixed point of a Gaussian-weighted centroid at full resolution,
weighted by the contrast of the dot itself; it does not depend on the start of the search. Shading
pulls it off the dot; a dot that is shaded is centred by its outline, compared with the one at rest.

The lattice of rows and columns grows outwards from one dot, each step predicted from the last local
pitch; dots between the lattice points are ignored. The result does not depend on the order of
detection.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from touchdown.backend.core import GRID_COLS, GRID_ROWS, MARKERS, FloatArray, ImageArray

WIDTH_PX, HEIGHT_PX = 320, 240
_HALF_WINDOW_PX = 10
_SPAN = np.arange(-_HALF_WINDOW_PX, _HALF_WINDOW_PX + 1, dtype=np.float32)
_CLOSING = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))  # at a quarter of the size: 28 px
_BLUR = cv2.getGaussianKernel(9, 8.0 / 4, cv2.CV_32F)
_DARKEST = np.uint8(16)  # darker levels count as this one, so that noise in the dark is no dot
# Darkness of a blob: this share of that of the dots, within limits.
_BLOB_SHARE, _BLOB_RANGE = 0.45, (0.1, 0.25)
_DOT_RANK = 0.05  # the darkest pixels belong to dots
# Levels between core (0) and surroundings (1) of a dot where its weight ends, and where it is full.
_RAMP = (0.75, 0.3)
_MIN_CONTRAST = 0.06
_CORE_SHARE, _RING_SHARE = 0.3, 0.45  # ranks of the levels that stand for core and surroundings
_MIN_DARKNESS = np.float32(1e-9)  # keeps the centroid of an empty window at its centre
_WEIGHT_SIGMA_PX = 5.0
_BELL = np.float32(-0.5 / _WEIGHT_SIGMA_PX**2)
_U, _V = (axis.ravel() for axis in np.meshgrid(_SPAN, _SPAN))
_SUMS = np.stack([np.ones_like(_U), _U, _V, _U * _U, _U * _V, _V * _V, _U], axis=1)
_SUMS *= np.exp(_BELL * (_U * _U + _V * _V))[:, None]
# (441, 7) weights: moments of the bell about the centre of a window, and the plain sum.
_SUMS[:, 6] = 1.0
_CORE = np.flatnonzero(_U * _U + _V * _V <= 4.5**2)
_RING = np.flatnonzero(np.abs(np.hypot(_U, _V) - _HALF_WINDOW_PX) < 0.5)
_RING_U, _RING_V = (np.asarray(axis[_RING[::3]], np.intp) + _HALF_WINDOW_PX for axis in (_U, _V))
_RING_SLOPE = np.linalg.pinv(np.stack([_U, _V, _U**0], axis=1)[_RING[::3]])[:2].T * _HALF_WINDOW_PX
_MIN_PULL = 0.2  # bounds the stride in an evenly dark window, which has no centre
_TRIES = 3
# Longest stride; after a shorter one than the second the window stays.
_MAX_STRIDE_PX, _CONVERGED_PX = 3.0, 1.5
_TURN = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
_RADII_PX = np.arange(3.0, 14.1, 0.5, dtype=np.float32)
_RAYS_PX = np.stack([np.cos(_TURN), np.sin(_TURN)])[:, :, None] * _RADII_PX  # (2, 32, 23)
_USUAL_RADIUS_PX, _RADIUS_SPREAD_PX, _RADIUS_RANGE_PX = 8.0, 6.0, (4.0, 13.0)
# Change of an outline: size, motion in u and v, and the two axes of a stretch, which is damped.
_CHANGE = np.stack([_TURN**0, *(f(k * _TURN) for k in (1, 2) for f in (np.cos, np.sin))], axis=1)
_CHANGE_SQUARED = (_CHANGE[:, :, None] * _CHANGE[:, None]).reshape(len(_TURN), -1)
_DAMPING = np.diag([1e-6, 1e-6, 1e-6, 0.3, 0.3])
_OUTLINE_TRIES, _FIT_TRIES, _OUTLIERS, _LEAST_OUTLIER_PX = 3, 3, 3.0, 0.2
_LAST_PIXEL = np.array([WIDTH_PX - 1.0, HEIGHT_PX - 1.0])
_OPENING = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Blobs:
    """Dark regions of a frame: ``centre_px`` (n, 2); ``whole`` (n,): does not touch the border."""

    centre_px: FloatArray
    whole: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Centres:
    """Centres ``position_px`` (n, 2), and how the dots look.

    ``looks`` (n, 3): area under the bell and in all, px², and contrast to the surroundings (0..1).
    """

    position_px: FloatArray
    looks: FloatArray


class Detector:
    """Detects dots in one image at a time; not thread-safe, since buffers are reused."""

    def __init__(self) -> None:
        pad = _HALF_WINDOW_PX
        # Background beyond the border.
        padded = np.ones((HEIGHT_PX + 2 * pad, WIDTH_PX + 2 * pad), np.float32)
        self._windows = sliding_window_view(padded, (2 * pad + 1, 2 * pad + 1))
        self._flat = padded[pad:-pad, pad:-pad]
        flat = self._flat
        self._border = (flat[:2], flat[-2:], flat[:, :2], flat[:, -2:])
        # Allocating large arrays for each frame (page faults) costs more than the arithmetic.
        full, half, quarter = ((HEIGHT_PX // by, WIDTH_PX // by) for by in (1, 2, 4))
        self._channels = [np.empty(full, np.uint8) for _ in range(3)]
        self._brightest, self._per_mean = np.empty(full, np.uint8), np.empty(full, np.float32)
        self._shrunk = [np.empty(size, np.uint8) for size in (half, quarter)]
        self._depth, self._soft = 0.0, np.empty((0, 0), np.float32)
        self._half_flat, self._dark = np.empty(half, np.float32), np.empty(half, np.bool_)
        self._mask, self._labels = np.empty(half, np.uint8), np.empty(half, np.uint16)

    def look(self, image: ImageArray) -> None:
        """Set ``image`` (240, 320, 3) uint8, BGR."""
        blue, green, red = cv2.split(image, self._channels)
        cv2.max(cv2.max(blue, green, self._brightest), red, self._brightest)
        small = self._brightest
        for target in self._shrunk:
            _shrink(small, target)
            small = target
        mean = _background(np.maximum(small, _DARKEST))
        cv2.resize(np.reciprocal(mean), (WIDTH_PX, HEIGHT_PX), self._per_mean)
        np.multiply(self._brightest, self._per_mean, out=self._flat)
        self._soft = self._soft[:0]
        levels = self._flat[::8, ::8].ravel()
        at = int(_DOT_RANK * len(levels))
        darkness = 1.0 - float(np.partition(levels, at)[at])
        self._depth = min(max(_BLOB_SHARE * darkness, _BLOB_RANGE[0]), _BLOB_RANGE[1])

    @property
    def border_clear(self) -> bool:
        """True if no dot is cut by the border of the image."""
        return all(float(line.min()) >= 1.0 - self._depth for line in self._border)

    def blobs(self) -> Blobs:
        """Return the dark regions with the size and roundness of a dot."""
        _shrink(self._flat, self._half_flat)
        dark = np.less(self._half_flat, 1.0 - self._depth, out=self._dark).view(np.uint8)
        mask = cv2.dilate(cv2.erode(dark, _OPENING, self._mask), _OPENING, dark)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(
            mask, self._labels, connectivity=8, ltype=cv2.CV_16U
        )
        x, y, width, height, area = stats[1:].T
        longer = np.maximum(width, height)
        whole = (x > 0) & (y > 0) & (x + width < WIDTH_PX // 2) & (y + height < HEIGHT_PX // 2)
        # A dot cut by the border is not round.
        keep = (area > 0.5 * width * height) & (longer <= 2.5 * np.minimum(width, height)) | ~whole
        keep &= (area >= 7) & (area <= 160) & (longer < 19)
        centre = 2.0 * centroids[1:] + 0.5
        return Blobs(centre[keep], whole[keep])

    def refine(self, start_px: FloatArray) -> Centres:
        """Return the dot centres near ``start_px`` (n, 2), which may be wrong by a few px."""
        position = start_px
        for _ in range(_TRIES):
            middle = np.minimum(np.maximum(np.rint(position), 0.0), _LAST_PIXEL)
            weight, contrast = self._darkness(middle)
            sums = (weight.reshape(-1, len(_SUMS)) @ _SUMS).astype(np.float64).T
            stride = _stride(sums)
            step = _apply_stride(stride, sums[1:3] / sums[0])
            step = np.minimum(np.maximum(step, -_MAX_STRIDE_PX), _MAX_STRIDE_PX)
            position = middle + step.T
            if np.abs(step).max(initial=0.0) < _CONVERGED_PX:
                break
        mass, shift = _moments(weight, step)
        looks = np.stack([mass, sums[6], np.maximum(contrast, 0.0)], axis=1)
        return Centres(position + _apply_stride(stride, shift).T, looks)

    def slopes(self, centre_px: FloatArray) -> FloatArray:
        """Return the slope (n, 2) of the level around dots at ``centre_px``, over half a window."""
        middle = np.minimum(np.maximum(np.rint(centre_px), 0.0), _LAST_PIXEL)
        column, row = middle.astype(np.intp).T
        around = self._windows[row[:, None], column[:, None], _RING_V, _RING_U]
        return np.asarray(around @ _RING_SLOPE, dtype=np.float64)

    def outlines(
        self, centre_px: FloatArray, near_px: FloatArray | float = _USUAL_RADIUS_PX
    ) -> tuple[FloatArray, FloatArray]:
        """Return the radius (n, 32) of the steepest rise on 32 rays from ``centre_px`` (n, 2), near
        the radius ``near_px``, and the rise.
        """
        if not len(self._soft):
            self._soft = np.asarray(cv2.GaussianBlur(self._flat, (5, 5), 0.8), np.float32)
        u, v = np.moveaxis((centre_px[:, :, None, None] + _RAYS_PX).astype(np.float32), 1, 0)
        shape, rows = u.shape, (-1, len(_RADII_PX))
        level = cv2.remap(
            self._soft, u.reshape(rows), v.reshape(rows), cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT, borderValue=1.0,
        ).reshape(shape)  # fmt: skip
        off = (_RADII_PX[1:-1] - np.asarray(near_px)[..., None]) / _RADIUS_SPREAD_PX
        rise = (level[..., 2:] - level[..., :-2]) * np.exp(-0.5 * off * off)
        best = np.clip(rise.argmax(axis=-1), 1, rise.shape[-1] - 2)[..., None]
        low, top, high = (np.take_along_axis(rise, best + k, axis=-1)[..., 0] for k in (-1, 0, 1))
        bend = np.minimum(low - 2.0 * top + high, -1e-6)
        part = np.clip(0.5 * (low - high) / bend, -1.0, 1.0)
        return _RADII_PX[1:-1][best[..., 0]] + 0.5 * part, np.maximum(top, 1e-6)

    def refine_by_outline(self, start_px: FloatArray, rest_px: FloatArray) -> FloatArray:
        """Return the centres (n, 2) of dots near ``start_px`` whose outlines ``rest_px`` (n, 32)
        moved, grew and stretched; parts of an outline that do not fit have little weight.
        """
        position, near = start_px, rest_px
        for _ in range(_OUTLINE_TRIES):
            radius, rise = self.outlines(position, near)
            change = _fit_change(radius - rest_px, np.sqrt(rise))
            position = position + np.clip(change[:, 1:3], -2.0, 2.0)
            shape = change.copy()
            shape[:, 1:3] = 0.0
            near = np.clip(rest_px + shape @ _CHANGE.T, *_RADIUS_RANGE_PX)
        return position

    def _darkness(self, middle_px: FloatArray) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return (n, 21, 21) weights around whole pixels ``middle_px`` (n, 2), and contrast (n,).

        The weight is 1 in the core of the dot and 0 in its surroundings, by its own contrast.
        """
        column, row = middle_px.astype(np.intp).T
        weight: NDArray[np.float32] = self._windows[row, column]
        rows = weight.reshape(-1, len(_U))
        core, level = _rank(rows[:, _CORE], _CORE_SHARE), _rank(rows[:, _RING], _RING_SHARE)
        contrast = level - core
        range_ = np.maximum(contrast, np.float32(_MIN_CONTRAST))
        steep = np.float32(1.0 / (_RAMP[0] - _RAMP[1])) / range_
        np.subtract((core + np.float32(_RAMP[0]) * range_)[:, None], rows, out=rows)
        rows *= steep[:, None]
        np.clip(rows, _MIN_DARKNESS, np.float32(1.0), out=rows)
        return weight, contrast


def _fit_change(moved_px: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the change (n, 5) that fits ``moved_px`` (n, 32) best, without outliers."""
    own = weight
    for _ in range(_FIT_TRIES):
        size = weight.sum(axis=1)[:, None, None]
        square = (weight @ _CHANGE_SQUARED).reshape(-1, 5, 5) + size * _DAMPING
        change = np.linalg.solve(square, ((weight * moved_px) @ _CHANGE)[..., None])[..., 0]
        left = moved_px - change @ _CHANGE.T
        scale = _OUTLIERS * np.median(np.abs(left), axis=1)[:, None] + _LEAST_OUTLIER_PX
        weight = own / (1.0 + (left / scale) ** 2)
    return np.asarray(change, dtype=np.float64)


def _rank(levels: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    """Return the level (n,) of rank ``share`` in each row of ``levels`` (n, m)."""
    at = int(share * levels.shape[1])
    return np.partition(levels, at, axis=1)[:, at]


def _background(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return ``picture`` (60, 80) without its dots.

    Closing removes dark spots smaller than its kernel, and keeps larger dark areas.
    """
    closed = cv2.morphologyEx(picture, cv2.MORPH_CLOSE, _CLOSING, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(cv2.sepFilter2D(closed, cv2.CV_32F, _BLUR, _BLUR), dtype=np.float32)


def _shrink(source: NDArray[np.generic], target: NDArray[np.generic]) -> None:
    """Halve ``source`` into ``target`` by area means."""
    cv2.resize(
        cast(Any, source), target.shape[::-1], cast(Any, target), interpolation=cv2.INTER_AREA
    )


def _stride(sums: FloatArray) -> FloatArray:
    """Return (3, n): a, b, c of the matrix [[a, c], [c, b]] that maps shift to Newton stride.

    The shift s of the centroid from the centre p of the bell is zero at the fixed point; ds/dp is
    V / sigma² - 1 with the covariance V under the bell.
    """
    spread = sums[3:6] * (_WEIGHT_SIGMA_PX**-2 / sums[0])
    pull = np.maximum(1.0 - spread[2::-2], _MIN_PULL)
    product = pull[0] * pull[1]
    scale = 1.0 / np.maximum(product - spread[1] * spread[1], 0.5 * product)
    return np.stack([pull[0] * scale, pull[1] * scale, spread[1] * scale])


def _apply_stride(stride: FloatArray, shift: FloatArray) -> FloatArray:
    """Return the strides (2, n) of shifts (2, n)."""
    return np.asarray(stride[:2] * shift + stride[2] * shift[::-1], dtype=np.float64)


def _moments(weight: NDArray[np.float32], centre_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mass (n,) under a bell at ``centre_px`` (2, n) and the centroid (2, n) from there."""
    offset = _SPAN - centre_px.astype(np.float32)[:, :, None]
    basis = np.empty((*offset.shape[:2], 2, len(_SPAN)), np.float32)
    bell, ramp = basis[:, :, 0], basis[:, :, 1]
    np.exp(offset * offset * _BELL, out=bell)
    np.multiply(bell, offset, out=ramp)
    across, down = basis
    moments = (down @ (weight @ across.swapaxes(1, 2))).reshape(-1, 4).astype(np.float64).T
    return moments[0], moments[1:3] / moments[0]


Cell = tuple[int, int]
_REACH = 0.38
_PITCH_RANGE_PX = (22.0, 44.0)
_USUAL_PITCH_PX = 32.0
_MAX_SEEDS = 12
_MIN_PER_LINE = 3
_MAX_MISSING = 12
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
        """True if each marker of a 7 x 9 grid is identified (some may be hidden)."""
        fits = (self.rows, self.cols) == (GRID_ROWS, GRID_COLS)
        return fits and len(self.missing) <= _MAX_MISSING

    @property
    def complete(self) -> bool:
        """True if all 63 dots of a 7 x 9 grid are found."""
        return self.usable and not self.missing

    @property
    def message(self) -> str:
        """Description of the grid for the operator."""
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
    """``index``: (63,) blob of each marker, row-major, -1 without a whole dot."""

    report: GridReport
    index: NDArray[np.intp]


def order_grid(blobs: Blobs) -> OrderedDots:
    """Order the dots of one frame; ``index`` is all -1 unless ``report.usable``."""
    nowhere = np.full(MARKERS, -1, dtype=np.intp)
    count = len(blobs.whole)
    if count < 2 * _MIN_PER_LINE:
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
    # Whole blobs first, from the centre of the image outwards.
    away = np.linalg.norm(blobs.centre_px - [WIDTH_PX / 2, HEIGHT_PX / 2], axis=1)
    seeds = np.argsort(away + 1e6 * ~blobs.whole, kind="stable")[:_MAX_SEEDS].tolist()
    # With many false dots the nearest is not a neighbour: try the usual pitch too.
    for pitch_px in (nearest_px, _USUAL_PITCH_PX):
        tried: set[int] = set()
        for seed in seeds:
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
    """Remove border lines with fewer than three dots: false dots outside the grid."""
    while cells:
        for axis in (0, 1):
            lines = [cell[axis] for cell in cells]
            for line in (min(lines), max(lines)):
                if lines.count(line) < _MIN_PER_LINE:
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

"""Renders tactile images: 320x240 BGR from the displacement of the 63 markers.

Source: bench reference 7. I = B + P + m (core - B - P) + n with the background B, the fixed grain
P, the temporal noise n and the dot mask m, the largest of 63 logistic discs. Discs follow the
local displacement gradient as ellipses. B + P is computed once; a frame draws 63 small patches and
adds a random window of a noise bank, because a fresh normal for each of 230,400 values would cost
more than everything else.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.core.flow import (
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    FloatArray,
    ImageArray,
)
from backend.simulation.gel_look import GelLook

WIDTH_PX, HEIGHT_PX = 320, 240
SMEAR_RADIUS_PX = 13.0
_REACH_PX = 15
"""Half width of the patch drawn round a dot: the mask has faded to 0.1 % there."""
_FAR_PX2 = 1600.0
"""Squared distances are cut here, where a dot has long faded, so that exp never overflows."""
_CONTRAST_SPREAD = 0.05
"""Spread of the dots' darkness (real cores range from 16 to 67 levels)."""
_FLECKS = 9
"""Light flecks on every dot; they move with it, as those of the real paint do."""
_FLECK_SIGMA_PX = 1.1
_FRINGE = ((0, -4), (-4, 0), (0, 4))
"""Where the shadow of a dot falls in B, G, R: the lights come from three sides (u, v in px)."""
_FRINGE_DEPTH = 0.5
_BANK_FACTOR = 2

Float32 = NDArray[np.float32]


class FingerOptics:
    """One finger's camera. Same seed, same calls: the same bytes."""

    def __init__(self, look: GelLook, seed: int) -> None:
        self.look = look
        fixed = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 1])))
        self._draws = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 2])))
        self._slopes = _slopes(look.rest_px)
        self._back = _background(look) + _grain(look, fixed)
        self._to_core = look.core.astype(np.float32)[:, None, None] - self._back
        contrast = 1.0 - np.abs(_CONTRAST_SPREAD * fixed.standard_normal(MARKERS))
        self._contrast = contrast.astype(np.float32)[:, None, None]
        angle = fixed.uniform(0.0, 2.0 * np.pi, (MARKERS, _FLECKS))
        reach = 0.8 * look.radius_px * np.sqrt(fixed.uniform(size=(MARKERS, _FLECKS)))
        self._fleck_u = (reach * np.cos(angle))[..., None].astype(np.float32)
        self._fleck_v = (reach * np.sin(angle))[..., None].astype(np.float32)
        height = fixed.uniform(0.05, 0.45, (MARKERS, _FLECKS, 1)).astype(np.float32)
        self._fleck_height = height
        area = 2.0 * np.pi * _FLECK_SIGMA_PX**2 / (np.pi * look.radius_px**2)
        self._fleck_mean = np.asarray(area * height.sum(axis=1, keepdims=True), dtype=np.float32)
        shape = (3, _BANK_FACTOR * HEIGHT_PX, _BANK_FACTOR * WIDTH_PX)
        self._bank = fixed.standard_normal(shape, dtype=np.float32) * np.float32(look.noise)
        self._patches = np.empty((MARKERS, 2 * _REACH_PX, 2 * _REACH_PX), dtype=np.float32)
        self._mask = np.zeros((HEIGHT_PX, WIDTH_PX), dtype=np.float32)
        self._frame = np.empty((3, HEIGHT_PX, WIDTH_PX), dtype=np.float32)

    def render(self, displacement_px: FloatArray, hidden: NDArray[np.bool_]) -> ImageArray:
        """Return the image for ``displacement_px`` (63, 2); smears cover ``hidden`` dots (63,)."""
        centre_px = self.look.rest_px + displacement_px
        self._draw_dots(centre_px, displacement_px)
        self._shade()
        for marker in np.flatnonzero(hidden):
            self._smear(centre_px[marker])
        self._add_noise()
        # Rounds and saturates in one pass; levels are never far below zero, so their sign is safe.
        flat = cv2.convertScaleAbs(self._frame.reshape(3 * HEIGHT_PX, WIDTH_PX))
        planes = np.asarray(flat, dtype=np.uint8).reshape(3, HEIGHT_PX, WIDTH_PX)
        return np.asarray(cv2.merge([planes[0], planes[1], planes[2]]), dtype=np.uint8)

    def _draw_dots(self, centre_px: FloatArray, displacement_px: FloatArray) -> None:
        self._mask.fill(0.0)
        corner = np.floor(centre_px).astype(np.intp) - _REACH_PX + 1
        size = 2 * _REACH_PX
        steps = np.arange(size, dtype=np.float32)
        first = (corner - centre_px).astype(np.float32)
        dx, dy = first[:, :1] + steps, first[:, 1:] + steps
        a, b, c = _quadratic_form(self._slopes, displacement_px)
        mask = self._patches
        np.multiply((2.0 * b * dy)[:, :, None], dx[:, None, :], out=mask)
        mask += (a * dx * dx)[:, None, :]
        mask += (c * dy * dy)[:, :, None]
        np.clip(mask, 0.0, _FAR_PX2, out=mask)
        np.sqrt(mask, out=mask)
        mask *= np.float32(1.0 / self.look.edge_px)
        mask -= np.float32(self.look.radius_px / self.look.edge_px)
        np.exp(mask, out=mask)
        mask += np.float32(1.0)
        np.divide(self._contrast, mask, out=mask)
        mask *= self._paint(dx, dy)
        for (u, v), patch in zip(corner.tolist(), mask, strict=True):
            u0, u1 = max(u, 0), min(u + size, WIDTH_PX)
            v0, v1 = max(v, 0), min(v + size, HEIGHT_PX)
            if u0 < u1 and v0 < v1:
                there = self._mask[v0:v1, u0:u1]
                np.maximum(there, patch[v0 - v : v1 - v, u0 - u : u1 - u], out=there)

    def _paint(self, dx: Float32, dy: Float32) -> Float32:
        """Return (63, n, n) darkness of the paint, 1 on average over a dot."""
        narrow = np.float32(-0.5 / _FLECK_SIGMA_PX**2)
        u = np.exp(narrow * np.square(dx[:, None, :] - self._fleck_u))
        v = np.exp(narrow * np.square(dy[:, None, :] - self._fleck_v)) * self._fleck_height
        flecks = v.swapaxes(1, 2) @ u
        return np.asarray(np.float32(1.0) + self._fleck_mean - flecks, dtype=np.float32)

    def _shade(self) -> None:
        """Lay the dots and their coloured shadows over the resting image."""
        mask, depth = self._mask, np.float32(_FRINGE_DEPTH)
        for channel, (du, dv) in enumerate(_FRINGE):
            into, source = _overlap(du, dv)
            shade = mask.copy()
            np.maximum(shade[into], depth * mask[source], out=shade[into])
            np.multiply(self._to_core[channel], shade, out=self._frame[channel])
        self._frame += self._back

    def _smear(self, centre_px: FloatArray) -> None:
        reach = int(SMEAR_RADIUS_PX + 6)
        u, v = (int(value) for value in np.floor(centre_px))
        u0, u1 = max(u - reach, 0), min(u + reach + 1, WIDTH_PX)
        v0, v1 = max(v - reach, 0), min(v + reach + 1, HEIGHT_PX)
        if u0 >= u1 or v0 >= v1:
            return
        du = np.arange(u0, u1) - centre_px[0]
        dv = np.arange(v0, v1) - centre_px[1]
        distance = np.hypot(du[None, :], dv[:, None])
        cover = (1.0 / (1.0 + np.exp((distance - SMEAR_RADIUS_PX) / 1.5))).astype(np.float32)
        there = self._frame[:, v0:v1, u0:u1]
        there += cover * (self.look.smear.astype(np.float32)[:, None, None] - there)

    def _add_noise(self) -> None:
        """Add a random window of the bank per channel."""
        rows = self._draws.integers(0, (_BANK_FACTOR - 1) * HEIGHT_PX, 3)
        columns = self._draws.integers(0, (_BANK_FACTOR - 1) * WIDTH_PX, 3)
        for channel in range(3):
            row, column = int(rows[channel]), int(columns[channel])
            self._frame[channel] += self._bank[
                channel, row : row + HEIGHT_PX, column : column + WIDTH_PX
            ]


def _overlap(du: int, dv: int) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Return where an image shifted by (du, dv) lands, and where that part comes from."""
    rows = slice(max(dv, 0), HEIGHT_PX + min(dv, 0)), slice(max(-dv, 0), HEIGHT_PX + min(-dv, 0))
    columns = slice(max(du, 0), WIDTH_PX + min(du, 0)), slice(max(-du, 0), WIDTH_PX + min(-du, 0))
    return (rows[0], columns[0]), (rows[1], columns[1])


def _background(look: GelLook) -> Float32:
    """Return (3, 240, 320): cubic interpolation of the colour table, smoothed over 20 px."""
    table = look.background.astype(np.float32)
    large = cv2.resize(table, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC)
    smooth = cv2.GaussianBlur(large, (0, 0), 20.0, borderType=cv2.BORDER_REPLICATE)
    return np.ascontiguousarray(np.asarray(smooth, dtype=np.float32).transpose(2, 0, 1))


def _grain(look: GelLook, rng: np.random.Generator) -> Float32:
    """Return (3, 240, 320): Gaussian pattern of correlation 1 px and the look's deviation."""
    white = rng.standard_normal((HEIGHT_PX, WIDTH_PX, 3), dtype=np.float32)
    smooth = np.asarray(cv2.GaussianBlur(white, (0, 0), 1.0), dtype=np.float32)
    smooth *= np.float32(look.grain / float(smooth.std()))
    return np.ascontiguousarray(smooth.transpose(2, 0, 1))


def _slopes(rest_px: FloatArray) -> FloatArray:
    """Return (2, 63, 63): maps a field on the grid to its slopes along u and v, per px."""
    rest = rest_px.reshape(GRID_ROWS, GRID_COLS, 2)
    units = np.eye(MARKERS).reshape(GRID_ROWS, GRID_COLS, MARKERS)
    along_u = np.asarray(np.gradient(units, float(np.mean(np.diff(rest[..., 0], axis=1))), axis=1))
    along_v = np.asarray(np.gradient(units, float(np.mean(np.diff(rest[..., 1], axis=0))), axis=0))
    return np.stack([along_u.reshape(MARKERS, MARKERS), along_v.reshape(MARKERS, MARKERS)])


def _quadratic_form(
    slopes: FloatArray, displacement_px: FloatArray
) -> tuple[Float32, Float32, Float32]:
    """Return a, b, c (63, 1) of |A p|² = a x² + 2 b x y + c y² with A the inverse of I + ∂d/∂p."""
    along_u, along_v = slopes @ displacement_px
    stretch_u, stretch_v = 1.0 + along_u[:, 0], 1.0 + along_v[:, 1]
    cross_u, cross_v = along_u[:, 1], along_v[:, 0]
    # A fold of the gel (determinant near zero) is beyond the model: keep the dot finite.
    square = np.maximum(stretch_u * stretch_v - cross_u * cross_v, 0.3) ** 2
    a = (stretch_v**2 + cross_u**2) / square
    b = -(stretch_v * cross_v + stretch_u * cross_u) / square
    c = (stretch_u**2 + cross_v**2) / square
    form = np.stack([a, b, c]).astype(np.float32)[..., None]
    return form[0], form[1], form[2]

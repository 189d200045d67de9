"""Draws the dots of a gel: how much paint covers each pixel of a tactile image.

Source: bench reference 7. The mask is the largest of 63 logistic discs; discs follow the local
displacement gradient as ellipses. Light flecks move with their dot.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.simulation.gel_look import GelLook

WIDTH_PX, HEIGHT_PX = 320, 240
_REACH_PX = 15
"""Half width of the patch drawn round a dot: the mask has faded to 0.1 % there."""
_SIZE_PX = 2 * _REACH_PX
_FAR_PX2 = 1600.0
"""Squared distances are cut here, where a dot has long faded, so that exp never overflows."""
_CONTRAST_SPREAD = 0.05
"""Spread of the dots' darkness (real cores range from 16 to 67 levels)."""
_FLECKS = 9
"""Light flecks on every dot; they move with it, as those of the real paint do."""
_FLECK_SIGMA_PX = 1.1

Float32 = NDArray[np.float32]


class Dots:
    """The 63 dots of one gel; ``rng`` gives each its darkness and its flecks.

    Dots that have moved by ``still_px`` or less since they were drawn are not drawn again.

    ``mask``: (240, 320) of the last ``draw``, 0 = no paint. Buffers are kept: fresh large arrays
    in every frame cost more than the arithmetic on them.
    """

    def __init__(self, look: GelLook, rng: np.random.Generator, still_px: float = 0.0) -> None:
        self._look, self._still_px = look, still_px
        self._drawn_px = np.full((MARKERS, 2), np.inf)
        self._slopes = _slopes(look.rest_px)
        contrast = 1.0 - np.abs(_CONTRAST_SPREAD * rng.standard_normal(MARKERS))
        self._contrast = contrast.astype(np.float32)[:, None, None]
        angle = rng.uniform(0.0, 2.0 * np.pi, (MARKERS, _FLECKS))
        reach = 0.8 * look.radius_px * np.sqrt(rng.uniform(size=(MARKERS, _FLECKS)))
        self._fleck_u = (reach * np.cos(angle))[..., None].astype(np.float32)
        self._fleck_v = (reach * np.sin(angle))[..., None].astype(np.float32)
        self._fleck_height = rng.uniform(0.05, 0.45, (MARKERS, _FLECKS, 1)).astype(np.float32)
        area = 2.0 * np.pi * _FLECK_SIGMA_PX**2 / (np.pi * look.radius_px**2)
        mean = area * self._fleck_height.sum(axis=1, keepdims=True)
        self._paint_level = np.float32(1.0) + np.asarray(mean, dtype=np.float32)
        self._patches = np.empty((MARKERS, _SIZE_PX, _SIZE_PX), dtype=np.float32)
        self._flecks = np.empty_like(self._patches)
        # The margin takes what lies outside the image.
        shape = (HEIGHT_PX + 2 * _SIZE_PX, WIDTH_PX + 2 * _SIZE_PX)
        self._canvas = np.zeros(shape, dtype=np.float32)
        self.mask = self._canvas[_SIZE_PX:-_SIZE_PX, _SIZE_PX:-_SIZE_PX]

    def draw(self, displacement_px: FloatArray) -> bool:
        """Draw the dots at rest + ``displacement_px`` (63, 2) into ``mask``; whether it changed.

        In the air, most of the time, nothing moves: what is drawn is what has to be drawn.
        """
        if np.abs(displacement_px - self._drawn_px).max() <= self._still_px:
            return False
        self._drawn_px = displacement_px.copy()
        centre_px = self._look.rest_px + displacement_px
        corner = np.floor(centre_px).astype(np.intp) - _REACH_PX + 1
        steps = np.arange(_SIZE_PX, dtype=np.float32)
        first = (corner - centre_px).astype(np.float32)
        dx, dy = first[:, :1] + steps, first[:, 1:] + steps
        self._draw_discs(dx, dy, displacement_px)
        self._patches *= self._paint(dx, dy)
        self._canvas.fill(0.0)
        # A dot out of sight is drawn on the margin.
        place = np.clip(corner + _SIZE_PX, 0, _LAST_CORNER).tolist()
        for (u, v), patch in zip(place, self._patches, strict=True):
            there = self._canvas[v : v + _SIZE_PX, u : u + _SIZE_PX]
            cv2.max(there, patch, there)
        return True

    def _draw_discs(self, dx: Float32, dy: Float32, displacement_px: FloatArray) -> None:
        """Fill the patches with discs; ``dx``, ``dy`` (63, n): px from the centres."""
        look, mask = self._look, self._patches
        a, b, c = _quadratic_form(self._slopes, displacement_px)
        np.multiply((2.0 * b * dy)[:, :, None], dx[:, None, :], out=mask)
        mask += (a * dx * dx)[:, None, :]
        mask += (c * dy * dy)[:, :, None]
        np.clip(mask, 0.0, _FAR_PX2, out=mask)
        np.sqrt(mask, out=mask)
        mask *= np.float32(1.0 / look.edge_px)
        mask -= np.float32(look.radius_px / look.edge_px)
        np.exp(mask, out=mask)
        mask += np.float32(1.0)
        np.divide(self._contrast, mask, out=mask)

    def _paint(self, dx: Float32, dy: Float32) -> Float32:
        """Return (63, n, n) darkness of the paint, 1 on average over a dot."""
        narrow = np.float32(-0.5 / _FLECK_SIGMA_PX**2)
        u = np.exp(narrow * np.square(dx[:, None, :] - self._fleck_u))
        v = np.exp(narrow * np.square(dy[:, None, :] - self._fleck_v)) * self._fleck_height
        np.matmul(v.swapaxes(1, 2), u, out=self._flecks)
        np.subtract(self._paint_level, self._flecks, out=self._flecks)
        return self._flecks


_LAST_CORNER = (WIDTH_PX + _SIZE_PX, HEIGHT_PX + _SIZE_PX)


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

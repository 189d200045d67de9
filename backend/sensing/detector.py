"""Finds dark dots in a tactile image: whole-frame blobs, and sub-pixel centres of known dots.

The image is first made flat: the brightest colour channel divided by its local mean, so that the
coloured lamps and flicker drop out. Blobs are connected dark regions at half resolution. A centre
is the fixed point of a Gaussian-weighted centroid at full resolution; it has no threshold edge that
noise could move, and does not depend on where the search started.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from backend.core.flow import FloatArray, ImageArray

WIDTH_PX, HEIGHT_PX = 320, 240
_HALF_WINDOW_PX = 10
_SPAN = np.arange(-_HALF_WINDOW_PX, _HALF_WINDOW_PX + 1, dtype=np.float32)
_BLUR_SIGMA_PX = 12.0
_DARKEST_MEAN = 16.0
_LIGHT_SHARE = 0.9
_BLOB_DEPTH = 0.25
_RAMP = (0.15, 0.55)
_WEIGHT_SIGMA_PX = 5.0
_AREA_OF_DOUBLE_GAIN_PX2 = 220.0
_STEPS = 2
_REACH_PX = 3.0
_LAST_PIXEL = np.array([WIDTH_PX - 1, HEIGHT_PX - 1])
_OPENING = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Blobs:
    """Dark regions of one frame: ``centre_px`` (n, 2); ``whole`` (n,): does not touch the border.

    ``area_px``: (n,) area at the detection threshold.
    """

    centre_px: FloatArray
    area_px: FloatArray
    whole: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Centres:
    """Sub-pixel centres (n, 2) px and ``mass`` (n,): darkness under the window, in px²."""

    position_px: FloatArray
    mass: FloatArray


class Detector:
    """Looks at one image at a time; keeps its buffers, so use one per camera and thread.

    ``depth``: (240, 320) float32 of the present image, 0 = background, towards 1 = black.
    """

    def __init__(self) -> None:
        pad = _HALF_WINDOW_PX
        padded = np.zeros((HEIGHT_PX + 2 * pad, WIDTH_PX + 2 * pad), np.float32)
        self._windows = sliding_window_view(padded, (2 * pad + 1, 2 * pad + 1))
        self.depth = padded[pad:-pad, pad:-pad]
        # Fresh large arrays in every frame cost more (page faults) than the arithmetic on them.
        full, half, quarter = ((HEIGHT_PX // scale, WIDTH_PX // scale) for scale in (1, 2, 4))
        self._brightest = np.empty(full, np.uint8)
        self._channels = [np.empty(full, np.uint8) for _ in range(3)]
        self._bright, self._mean = np.empty(full, np.float32), np.empty(full, np.float32)
        self._half, self._quarter = np.empty(half, np.uint8), np.empty(quarter, np.uint8)
        self._half_depth = np.empty(half, np.float32)

    def look(self, image: ImageArray) -> None:
        """Take up ``image`` (240, 320, 3) uint8, BGR."""
        blue, green, red = cv2.split(image, self._channels)
        cv2.max(cv2.max(blue, green, self._brightest), red, self._brightest)
        _shrink(self._brightest, self._half)
        _shrink(self._half, self._quarter)
        mean = _background(self._quarter.astype(np.float32))
        cv2.resize(np.maximum(mean, _DARKEST_MEAN), (WIDTH_PX, HEIGHT_PX), self._mean)
        np.copyto(self._bright, self._brightest)
        np.divide(self._bright, self._mean, out=self.depth)
        np.subtract(np.float32(1.0), self.depth, out=self.depth)

    def blobs(self) -> Blobs:
        """Return every dark region of a plausible dot's size and roundness."""
        half = cv2.resize(self.depth, (WIDTH_PX // 2, HEIGHT_PX // 2), interpolation=cv2.INTER_AREA)
        mask = cv2.morphologyEx((half > _BLOB_DEPTH).view(np.uint8), cv2.MORPH_OPEN, _OPENING)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(
            mask, connectivity=8, ltype=cv2.CV_16U
        )
        x, y, width, height, area = stats[1:].T
        centre = 2.0 * centroids[1:] + 0.5
        round_enough = (area > 0.5 * width * height) & (
            np.maximum(width, height) <= 2.5 * np.minimum(width, height)
        )
        fits = (area >= 7) & (area <= 160) & (width < 19) & (height < 19)
        whole = (x > 0) & (y > 0) & (x + width < WIDTH_PX // 2) & (y + height < HEIGHT_PX // 2)
        # A dot cut by the border has lost its round shape.
        keep = fits & (round_enough | ~whole)
        return Blobs(centre[keep], 4.0 * area[keep], whole[keep])

    def refine(self, start_px: FloatArray, area_px: FloatArray) -> Centres:
        """Return the dot centres nearest to ``start_px`` (n, 2), which may err by a few px.

        ``area_px`` (n,) sets the stride only: the bell holds back the more, the larger the dot.
        """
        gain = (1.0 + area_px / _AREA_OF_DOUBLE_GAIN_PX2)[:, None]
        position = np.array(start_px, dtype=np.float64)
        mass = np.zeros(len(position))
        middle = np.full_like(position, -1e9)
        weight = np.zeros((len(position), len(_SPAN), len(_SPAN)), dtype=np.float32)
        for _ in range(_STEPS):
            if np.abs(position - middle).max(initial=0.0) > _REACH_PX:
                middle = np.clip(np.rint(position), 0, _LAST_PIXEL)
                column, row = middle.astype(np.intp).T
                weight = self._windows[row, column]
                np.clip(weight, _RAMP[0], _RAMP[1], out=weight)
                weight -= np.float32(_RAMP[0])
            mass, shift = _moments(weight, position - middle)
            position = position + gain * shift
        return Centres(position, mass)


def _background(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the local mean of ``picture`` without its dark dots, which would tilt it."""
    sigma = _BLUR_SIGMA_PX / 4
    mean = cv2.GaussianBlur(picture, (0, 0), sigma)
    light = (picture > _LIGHT_SHARE * mean).astype(np.float32)
    light += np.float32(1e-3)
    total = cv2.GaussianBlur(light * picture, (0, 0), sigma)
    return np.asarray(total / cv2.GaussianBlur(light, (0, 0), sigma), dtype=np.float32)


def _shrink(source: NDArray[np.generic], target: NDArray[np.generic]) -> None:
    """Halve ``source`` into ``target`` by area means."""
    cv2.resize(
        cast(Any, source), target.shape[::-1], cast(Any, target), interpolation=cv2.INTER_AREA
    )


def _moments(weight: NDArray[np.float32], centre_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mass (n,) under a bell at ``centre_px`` (n, 2) and the centroid from there."""
    offset = _SPAN - centre_px.astype(np.float32)[:, :, None]
    bell = np.exp(offset * offset * np.float32(-0.5 / _WEIGHT_SIGMA_PX**2))
    ramp = bell * offset
    across = np.stack([bell[:, 0], ramp[:, 0]], axis=-1)
    down = np.stack([bell[:, 1], ramp[:, 1]], axis=1)
    moments = (down @ (weight @ across)).astype(np.float64)
    mass = moments[:, 0, 0]
    shift = np.stack([moments[:, 0, 1], moments[:, 1, 0]], axis=-1)
    return mass, shift / np.maximum(mass, 1e-6)[:, None]

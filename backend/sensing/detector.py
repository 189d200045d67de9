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
_BLUR_SIGMA_PX = 14.4
_BLUR = cv2.getGaussianKernel(13, _BLUR_SIGMA_PX / 8, cv2.CV_32F)
_DARKEST = np.uint8(16)
"""The mean takes darker levels for this one: in the dark, noise must not look like dots."""
_LIGHT_SHARE = 0.8
"""What is no brighter than this share of its surroundings has no say in the mean."""
_BLOB_DEPTH = 0.25
_RAMP = (0.15, 0.55)
"""Darkness below the first is background; above the second a dot is as dark as it gets."""
_LEAST_DARKNESS = np.float32(1e-9)
"""Keeps the centroid of a window without any darkness in its middle."""
_WEIGHT_SIGMA_PX = 5.0
_BELL = np.float32(-0.5 / _WEIGHT_SIGMA_PX**2)
_U, _V = (axis.ravel() for axis in np.meshgrid(_SPAN, _SPAN))
_SUMS = np.stack([np.ones_like(_U), _U, _V, _U * _U, _U * _V, _V * _V, _U], axis=1)
_SUMS *= np.exp(_BELL * (_U * _U + _V * _V))[:, None]
_SUMS[:, 6] = 1.0
"""(441, 7): weights of the bell's moments about the middle of a window, and of the plain sum."""
_LEAST_PULL = 0.2
"""Even darkness has no centre, and no stride would be long enough: this bounds it."""
_TRIES = 3
_LONGEST_PX, _SHORT_PX = 3.0, 1.5
"""A stride goes no further than the first; after one below the second the window stays."""
_LAST_PIXEL = np.array([WIDTH_PX - 1.0, HEIGHT_PX - 1.0])
_OPENING = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, slots=True)
class Blobs:
    """Dark regions of a frame: ``centre_px`` (n, 2); ``whole`` (n,): does not touch the border."""

    centre_px: FloatArray
    whole: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Centres:
    """Centres ``position_px`` (n, 2); ``looks`` (n, 2): darkness under the bell and in all, px²."""

    position_px: FloatArray
    looks: FloatArray


class Detector:
    """Looks at one image at a time; keeps its buffers, so use one per camera and thread."""

    def __init__(self) -> None:
        pad = _HALF_WINDOW_PX
        # Beyond the border all is background.
        padded = np.ones((HEIGHT_PX + 2 * pad, WIDTH_PX + 2 * pad), np.float32)
        self._windows = sliding_window_view(padded, (2 * pad + 1, 2 * pad + 1))
        self._flat = padded[pad:-pad, pad:-pad]
        flat = self._flat
        self._border = (flat[:2], flat[-2:], flat[:, :2], flat[:, -2:])
        # Fresh large arrays in every frame cost more (page faults) than the arithmetic on them.
        full, half, *smaller = ((HEIGHT_PX // by, WIDTH_PX // by) for by in (1, 2, 4, 8))
        self._channels = [np.empty(full, np.uint8) for _ in range(3)]
        self._brightest, self._per_mean = np.empty(full, np.uint8), np.empty(full, np.float32)
        self._shrunk = [np.empty(size, np.uint8) for size in (half, *smaller)]
        self._half_flat, self._dark = np.empty(half, np.float32), np.empty(half, np.bool_)
        self._mask, self._labels = np.empty(half, np.uint8), np.empty(half, np.uint16)

    def look(self, image: ImageArray) -> None:
        """Take up ``image`` (240, 320, 3) uint8, BGR."""
        blue, green, red = cv2.split(image, self._channels)
        cv2.max(cv2.max(blue, green, self._brightest), red, self._brightest)
        small = self._brightest
        for target in self._shrunk:
            _shrink(small, target)
            small = target
        mean = _background(np.maximum(small, _DARKEST).astype(np.float32))
        cv2.resize(np.reciprocal(mean), (WIDTH_PX, HEIGHT_PX), self._per_mean)
        np.multiply(self._brightest, self._per_mean, out=self._flat)

    @property
    def border_clear(self) -> bool:
        """Whether no dot is cut by the border of the image."""
        return all(float(line.min()) >= 1.0 - _BLOB_DEPTH for line in self._border)

    def blobs(self) -> Blobs:
        """Return every dark region of a plausible dot's size and roundness."""
        _shrink(self._flat, self._half_flat)
        dark = np.less(self._half_flat, 1.0 - _BLOB_DEPTH, out=self._dark).view(np.uint8)
        mask = cv2.dilate(cv2.erode(dark, _OPENING, self._mask), _OPENING, dark)
        _, _, stats, centroids = cv2.connectedComponentsWithStats(
            mask, self._labels, connectivity=8, ltype=cv2.CV_16U
        )
        x, y, width, height, area = stats[1:].T
        longer = np.maximum(width, height)
        whole = (x > 0) & (y > 0) & (x + width < WIDTH_PX // 2) & (y + height < HEIGHT_PX // 2)
        # A dot cut by the border has lost its round shape.
        keep = (area > 0.5 * width * height) & (longer <= 2.5 * np.minimum(width, height)) | ~whole
        keep &= (area >= 7) & (area <= 160) & (longer < 19)
        centre = 2.0 * centroids[1:] + 0.5
        return Blobs(centre[keep], whole[keep])

    def refine(self, start_px: FloatArray) -> Centres:
        """Return the dot centres nearest to ``start_px`` (n, 2), which may err by a few px."""
        position = start_px
        for _ in range(_TRIES):
            middle = np.minimum(np.maximum(np.rint(position), 0.0), _LAST_PIXEL)
            weight = self._darkness(middle)
            sums = (weight.reshape(-1, len(_SUMS)) @ _SUMS).astype(np.float64).T
            stride = _stride(sums)
            step = _times(stride, sums[1:3] / sums[0])
            step = np.minimum(np.maximum(step, -_LONGEST_PX), _LONGEST_PX)
            position = middle + step.T
            if np.abs(step).max(initial=0.0) < _SHORT_PX:
                break
        mass, shift = _moments(weight, step)
        looks = np.stack([mass, sums[6]], axis=1)
        return Centres(position + _times(stride, shift).T, looks)

    def _darkness(self, middle_px: FloatArray) -> NDArray[np.float32]:
        """Return (n, 21, 21): how dark the paint is round whole pixels ``middle_px`` (n, 2)."""
        column, row = middle_px.astype(np.intp).T
        weight: NDArray[np.float32] = np.float32(1.0 - _RAMP[0]) - self._windows[row, column]
        rows = weight.reshape(-1, len(_SPAN))
        if len(rows):
            cv2.threshold(rows, _RAMP[1] - _RAMP[0], 0.0, cv2.THRESH_TRUNC, rows)
        return np.maximum(weight, _LEAST_DARKNESS, out=weight)


def _background(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the local mean of ``picture`` without its dark dots, which would tilt it."""
    light = picture / _blurred(picture) - np.float32(_LIGHT_SHARE)
    np.maximum(light, np.float32(1e-3), out=light)
    np.minimum(light, np.float32(1.0 - _LIGHT_SHARE), out=light)
    return np.asarray(_blurred(light * picture) / _blurred(light), dtype=np.float32)


def _blurred(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.sepFilter2D(picture, cv2.CV_32F, _BLUR, _BLUR), dtype=np.float32)


def _shrink(source: NDArray[np.generic], target: NDArray[np.generic]) -> None:
    """Halve ``source`` into ``target`` by area means."""
    cv2.resize(
        cast(Any, source), target.shape[::-1], cast(Any, target), interpolation=cv2.INTER_AREA
    )


def _stride(sums: FloatArray) -> FloatArray:
    """Return (3, n): a, b, c of the symmetric matrix [[a, c], [c, b]] that turns shift into stride.

    The shift s of the centroid from where the bell stands is zero at the fixed point; ds/dp is
    V / sigma² - 1 with the covariance V under the bell. Newton's stride is its inverse.
    """
    spread = sums[3:6] * (_WEIGHT_SIGMA_PX**-2 / sums[0])
    pull = np.maximum(1.0 - spread[2::-2], _LEAST_PULL)
    product = pull[0] * pull[1]
    scale = 1.0 / np.maximum(product - spread[1] * spread[1], 0.5 * product)
    return np.stack([pull[0] * scale, pull[1] * scale, spread[1] * scale])


def _times(stride: FloatArray, shift: FloatArray) -> FloatArray:
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

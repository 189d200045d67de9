"""Where things on the board are in the picture of the scene camera: a homography and its fit.

The board is the plane of the touched face (z = 0 of the bench frame). Four bright dots at known
places on it are enough: a picture of the bench is the whole calibration.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from backend.core.faults import InputError
from backend.core.flow import FloatArray, ImageArray, read_only
from backend.objects.board import DOTS_MM

LEAST_AREA_PX = 20
BRIGHT = 230
"""Dots are magenta: blue and red above this, green below ``255 - BRIGHT``; nothing else is."""
WORST_PX = 2.0
_FIX = "Show all four dots to the camera, evenly lit, and calibrate again."


@dataclass(frozen=True, slots=True)
class Homography:
    """``matrix`` (3, 3): board mm to image px (right, down); ``residual_px``: rms of its fit."""

    matrix: FloatArray
    residual_px: float

    def __post_init__(self) -> None:
        read_only(self.matrix)

    def to_px(self, board_mm: ArrayLike) -> FloatArray:
        """Return (n, 2) px of board points (n, 2) in mm."""
        return _mapped(self.matrix, board_mm)

    def to_mm(self, image_px: ArrayLike) -> FloatArray:
        """Return (n, 2) mm on the board of image points (n, 2) in px."""
        inverse: FloatArray = np.asarray(np.linalg.inv(self.matrix), dtype=np.float64)
        return _mapped(inverse, image_px)

    def text(self) -> str:
        """Return the form in which episodes keep it."""
        return json.dumps({"matrix": self.matrix.tolist(), "residual_px": self.residual_px})

    @classmethod
    def parse(cls, text: str) -> Homography:
        """Read the form that ``text`` made; raises ``InputError``."""
        try:
            content = json.loads(text)
            matrix = np.array(content["matrix"], dtype=np.float64).reshape(3, 3)
            residual_px = float(content["residual_px"])
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"The homography is damaged: {error}.", "scene", _FIX) from error
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
            raise InputError("The homography maps to nowhere.", "scene", _FIX)
        return cls(matrix, residual_px)


def fit_homography(board_mm: FloatArray, image_px: FloatArray) -> Homography:
    """Fit (n, 2) board points to (n, 2) image points, n >= 4, by the normalised linear method.

    Source: Hartley and Zisserman, Multiple View Geometry, algorithm 4.2. Raises ``InputError`` for
    points on a line.
    """
    if len(board_mm) < 4:
        raise InputError(f"{len(board_mm)} points are no calibration.", "scene", _FIX)
    to, back = _normaliser(board_mm), _normaliser(image_px)
    source, target = _mapped(to, board_mm), _mapped(back, image_px)
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([-x, -y, -1, 0, 0, 0, u * x, u * y, u])
        rows.append([0, 0, 0, -x, -y, -1, v * x, v * y, v])
    _, strength, vectors = np.linalg.svd(np.array(rows))
    if not strength[7] > 1e-9 * strength[0]:
        raise InputError("The points lie on a line.", "scene", _FIX)
    matrix = np.linalg.inv(back) @ vectors[-1].reshape(3, 3) @ to
    matrix = matrix / matrix[2, 2]
    errors = _mapped(matrix, board_mm) - image_px
    return Homography(matrix, float(np.sqrt((errors**2).sum(axis=1).mean())))


def calibrate(image: ImageArray) -> Homography:
    """Find the four dots in a picture (h, w, 3) and fit; raises ``InputError``.

    The dots are told apart by their order around their middle; the lowest left one in the picture
    is the lower left one of the board.
    """
    bright = (image[..., 0] >= BRIGHT) & (image[..., 2] >= BRIGHT)
    bright &= image[..., 1] <= 255 - BRIGHT
    count, labels = cv2.connectedComponents(bright.astype(np.uint8))
    spots = [np.argwhere(labels == k)[:, ::-1] for k in range(1, count)]
    found = [spot.mean(axis=0) for spot in spots if len(spot) >= LEAST_AREA_PX]
    if len(found) != len(DOTS_MM):
        raise InputError(f"{len(found)} dots are seen instead of four.", "scene camera", _FIX)
    fitted = fit_homography(DOTS_MM, _in_order(np.array(found)))
    if not fitted.residual_px <= WORST_PX:
        raise InputError(
            f"The dots are {fitted.residual_px:.1f} px off their places.", "scene camera", _FIX
        )
    return fitted


def _in_order(places_px: FloatArray) -> FloatArray:
    """Return the four dots counter-clockwise as seen on the board, lower left first."""
    from_middle = places_px - places_px.mean(axis=0)
    turned = np.arctan2(-from_middle[:, 1], from_middle[:, 0])
    around = places_px[np.argsort(turned)]
    first = int(np.argmin(around[:, 0] - around[:, 1]))
    return np.roll(around, -first, axis=0)


def _normaliser(points: FloatArray) -> FloatArray:
    """Return the (3, 3) that moves points to mean 0 and mean distance sqrt 2."""
    middle = points.mean(axis=0)
    spread = float(np.hypot(*(points - middle).T).mean()) or 1.0
    scale = np.sqrt(2.0) / spread
    return np.array(
        [[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0.0, 0.0, 1.0]]
    )


def _mapped(matrix: FloatArray, points: ArrayLike) -> FloatArray:
    given = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = np.column_stack([given, np.ones(len(given))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])

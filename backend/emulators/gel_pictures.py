"""What an emulated camera sees: a rendered gel that is gently sheared, or a recorded clip."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from backend.core.faults import InputError
from backend.core.flow import MARKERS, Finger, ImageArray
from backend.simulation.dots import WIDTH_PX
from backend.simulation.gel_look import load_look, mirrored
from backend.simulation.optics import FingerOptics

Pictures = Callable[[float], ImageArray | None]
"""(now) -> the picture to send, None if there is no new one."""
STILL_NOISE = 1.0
"""Grey levels added to a still picture: no living camera repeats itself."""
OTHER = np.array([[1.0, 0.012, 3.0], [-0.01, 0.985, 4.0]])
"""Where another gel of the same kind has its dots: some 5 px off, as two real sensors."""
TILE_ROWS, TILE_COLUMNS = (8, 232), (12, 308)
"""Seven by nine pitches of either gel, of 320 x 240 px: side by side they go on as one grid."""
SMALLER = 0.88
"""Makes 8 x 10 dots of 7 x 9."""


def sheared_gel(
    finger: Finger, amplitude_px: float = 3.0, period_s: float = 4.0, seed: int = 0
) -> Pictures:
    """Return the pictures of a gel whose markers swing to and fro by ``amplitude_px``."""
    look = load_look() if finger == "left" else mirrored(load_look())
    optics = FingerOptics(look, seed)
    hidden = np.zeros(MARKERS, dtype=np.bool_)

    def seen(now_s: float) -> ImageArray:
        swing_px = amplitude_px * math.sin(2 * math.pi * now_s / period_s)
        return optics.render(np.tile([swing_px, 0.5 * swing_px], (MARKERS, 1)), hidden)

    return seen


def recorded(path: Path, seed: int = 0) -> Pictures:
    """Return the pictures of a video, one a call, from the start again at its end; or of a still.

    Raises ``InputError`` if OpenCV reads neither.
    """
    still = cv2.imread(str(path)) if path.is_file() else None
    if still is not None:
        rng = np.random.default_rng(seed)
        flat = still.astype(np.float64)

        def trembling(now_s: float) -> ImageArray:
            noisy = flat + STILL_NOISE * rng.standard_normal(flat.shape)
            return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)

        return trembling
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(
            "This is neither a picture nor a video.", str(path), "Name a file that OpenCV reads."
        )

    def playing(now_s: float) -> ImageArray:
        there, picture = capture.read()
        if not there:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0.0)
            there, picture = capture.read()
        return np.asarray(picture, dtype=np.uint8)

    return playing


def other_gel(picture: ImageArray) -> ImageArray:
    """Return what the camera saw if another gel of the same kind were fitted."""
    height, width = picture.shape[:2]
    sized = OTHER * np.array([1.0, 1.0, width / WIDTH_PX])
    moved = cv2.warpAffine(picture, sized, (width, height), borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, dtype=np.uint8)


def small_dots(picture: ImageArray) -> ImageArray:
    """Return what the camera saw if a gel of 8 x 10 small dots were fitted."""
    height, width = picture.shape[:2]
    scale = width / WIDTH_PX
    rows, columns = (
        slice(*(round(scale * px) for px in ends)) for ends in (TILE_ROWS, TILE_COLUMNS)
    )
    wider = np.tile(picture[rows, columns], (2, 2, 1))
    cut = wider[: round(height / SMALLER), : round(width / SMALLER)]
    smaller = cv2.resize(cut, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(smaller, dtype=np.uint8)

"""From what a camera sends to the picture that the tracker takes: 320 x 240, BGR."""

from __future__ import annotations

import cv2
import numpy as np

from backend.core.flow import ImageArray
from backend.wire.framing import WireError
from backend.wire.mjpeg import size_px

WIDTH_PX, HEIGHT_PX = 320, 240
MIRRORS = {"none": None, "x": 1, "y": 0, "both": -1}
_SHAPE_TOLERANCE = 0.02
MISSING, LAST_PX = 128, 2
"""The level that libjpeg gives blocks without data; so many pixels of the last one are looked at,
as a block has at least after reduced decoding by four."""
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR,
}


def decode(content: bytes, crop_fraction: float) -> ImageArray:
    """Return the picture of a JPEG, decoded no finer than is needed after cropping.

    Raises ``WireError`` if it is damaged so that the decoder notices, or if its data ended before
    the picture did.
    """
    width, height = size_px(content)
    kept = 1.0 - 2.0 * crop_fraction
    fits = (f for f in _REDUCED if width * kept >= f * WIDTH_PX and height * kept >= f * HEIGHT_PX)
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), _REDUCED[next(fits, 1)])
    if picture is None:
        raise WireError("content", "jpeg picture", len(content))
    image = np.asarray(picture, dtype=np.uint8)
    if _ends_early(image):
        raise WireError("length", "jpeg picture", len(content))
    return image


def _ends_early(picture: ImageArray) -> bool:
    """Whether the last pixels are what the decoder puts where data are missing.

    No lit gel ends in a patch of that very grey, without any noise and in all three colours.
    """
    return bool((picture[-1, -LAST_PX:] == MISSING).all())


def fit(picture: ImageArray, crop_fraction: float, mirror: str) -> ImageArray:
    """Return (240, 320, 3): ``crop_fraction`` cut off on each side, scaled, mirrored.

    Raises ``WireError`` if what is left is not of the shape 4:3.
    """
    height, width = picture.shape[:2]
    rows, columns = round(height * crop_fraction), round(width * crop_fraction)
    cut = picture[rows : height - rows, columns : width - columns]
    height, width = cut.shape[:2]
    if not height or abs(width / height * HEIGHT_PX / WIDTH_PX - 1.0) > _SHAPE_TOLERANCE:
        raise WireError("shape", f"picture of {width} x {height} px")
    if (height, width) != (HEIGHT_PX, WIDTH_PX):
        method = cv2.INTER_AREA if width > WIDTH_PX else cv2.INTER_CUBIC
        size = (WIDTH_PX, HEIGHT_PX)
        cut = np.asarray(cv2.resize(cut, size, interpolation=method), dtype=np.uint8)
    flip = MIRRORS[mirror]
    turned = cut if flip is None else cv2.flip(cut, flip)
    return np.array(turned, dtype=np.uint8)

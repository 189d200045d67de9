"""Tactile images as bytes and back.

JPEG quality 95 with full colour resolution moves markers by less than the tracker's own error;
halved colour resolution does not, because marker detectors use colour (data-and-labelling 1.5).
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np

from backend.core.flow import ImageArray

KeepFrames = Literal["jpeg95_444", "png", "none"]
ENCODING: dict[KeepFrames, str] = {"jpeg95_444": "jpeg", "png": "png"}
MAX_PIXELS = 4096 * 4096
_JPEG = [
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
]
_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 1]


def encode(image: ImageArray, keep: KeepFrames) -> bytes:
    """Compress a (h, w, 3) BGR image; raises ``ValueError`` if that fails."""
    suffix, options = (".png", _PNG) if keep == "png" else (".jpg", _JPEG)
    done, data = cv2.imencode(suffix, image, options)
    if not done:
        raise ValueError("the image could not be compressed")
    return data.tobytes()


def decode(data: bytes) -> ImageArray:
    """Decompress to (h, w, 3) BGR; raises ``ValueError`` for anything that is not an image."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise ValueError("a stored image is damaged") from error
    if image is None or image.shape[0] * image.shape[1] > MAX_PIXELS:
        raise ValueError("a stored image is damaged")
    return image.astype(np.uint8, copy=False)

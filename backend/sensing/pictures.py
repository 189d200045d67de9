"""Tactile pictures from files: one image, a folder of images, or a video, as tracker frames."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from backend.core.faults import InputError
from backend.core.flow import Finger, ImageArray, TactileFrame
from backend.sensing.detector import HEIGHT_PX, WIDTH_PX

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"})
DEFAULT_RATE_HZ = 25.0
_FIX = "Give an image (PNG, JPEG, BMP, TIFF), a video that OpenCV reads, or a folder of images."


def read_pictures(path: Path, finger: Finger = "left") -> Iterator[TactileFrame]:
    """Yield the pictures of ``path`` as frames of 320 x 240 px, in order of time or name.

    Larger pictures of the same shape are scaled down. Raises ``InputError`` naming the file.
    """
    if not path.exists():
        raise InputError("There is no such file or folder.", str(path), _FIX)
    rate_hz, pictures = _open(path)
    count = 0
    for picture in pictures:
        yield TactileFrame(finger, count, count / rate_hz, fit_picture(picture, path))
        count += 1
    if not count:
        raise InputError("No picture could be read.", str(path), _FIX)


def count_pictures(path: Path) -> int | None:
    """Return how many pictures ``path`` holds, None if that is not known beforehand."""
    if path.is_dir():
        return len(_images_in(path))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return 1
    capture = cv2.VideoCapture(str(path))
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return frames if frames > 0 else None


def fit_picture(picture: ImageArray, path: Path) -> ImageArray:
    """Return ``picture`` at 320 x 240; raises ``InputError`` if its shape is not 4:3."""
    height, width = picture.shape[:2]
    if (height, width) == (HEIGHT_PX, WIDTH_PX):
        return picture
    if min(height, width) < HEIGHT_PX // 2 or abs(width / height - WIDTH_PX / HEIGHT_PX) > 0.02:
        raise InputError(
            f"The picture has {width} x {height} px.",
            str(path),
            f"Crop it to 4:3; the tracker works at {WIDTH_PX} x {HEIGHT_PX} px.",
        )
    method = cv2.INTER_AREA if width > WIDTH_PX else cv2.INTER_CUBIC
    scaled = cv2.resize(picture, (WIDTH_PX, HEIGHT_PX), interpolation=method)
    return np.asarray(scaled, dtype=np.uint8)


def _open(path: Path) -> tuple[float, Iterator[ImageArray]]:
    if path.is_dir():
        return DEFAULT_RATE_HZ, (_read_image(file) for file in _images_in(path))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return DEFAULT_RATE_HZ, iter([_read_image(path)])
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError("This is neither a picture nor a video.", str(path), _FIX)
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    return (rate_hz if 1.0 <= rate_hz <= 1000.0 else DEFAULT_RATE_HZ), _video(capture)


def _video(capture: cv2.VideoCapture) -> Iterator[ImageArray]:
    try:
        while True:
            there, picture = capture.read()
            if not there:
                return
            yield np.asarray(picture, dtype=np.uint8)
    finally:
        capture.release()


def _images_in(folder: Path) -> list[Path]:
    files = [file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES]
    return sorted(files, key=lambda file: (len(file.name), file.name))


def _read_image(path: Path) -> ImageArray:
    # imdecode instead of imread: it stays silent on a broken file and takes any path on Windows.
    data = np.frombuffer(path.read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise InputError("The picture cannot be decoded.", str(path), _FIX)
    return np.asarray(picture, dtype=np.uint8)

"""Tactile picture files: frames for the tracker, and overlay videos of its result.

Input is one image, a folder of images, or a video. The overlay draws a ring by state and an arrow
from the rest position of each marker.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Self

import cv2
import numpy as np

from touchdown.backend import core
from touchdown.backend.sensing.detector import HEIGHT_PX, WIDTH_PX

IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff"})
DEFAULT_RATE_HZ = 25.0
_FIX = "Give an image (PNG, JPEG, BMP, TIFF), a video that OpenCV reads, or a folder of images."


def read_pictures(path: Path, finger: core.Finger = "left") -> Iterator[core.TactileFrame]:
    """Yield the pictures of ``path`` as frames of 320 x 240 px, in order of time or name.

    Pictures of other sizes are resized. Raises ``InputError`` naming the file.
    """
    if not path.exists():
        raise core.InputError("There is no such file or folder.", str(path), _FIX)
    rate_hz, pictures = _open_pictures(path)
    number = -1
    for number, picture in enumerate(pictures):
        yield core.TactileFrame(
            finger, number, number / rate_hz, resize_picture(picture, str(path))
        )
    if number < 0:
        raise core.InputError("No picture could be read.", str(path), _FIX)


def count_pictures(path: Path) -> int | None:
    """Return the number of pictures in ``path``, None if unknown before reading."""
    if path.is_dir():
        return len(_images_in(path))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return 1
    capture = cv2.VideoCapture(str(path))
    frames = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
    capture.release()
    return frames if frames > 0 else None


def resize_picture(picture: core.ImageArray, where: str) -> core.ImageArray:
    """Return ``picture`` at 320 x 240; raises ``InputError`` if its shape is not 4:3."""
    height, width = picture.shape[:2]
    if (height, width) == (HEIGHT_PX, WIDTH_PX):
        return picture
    if min(height, width) < HEIGHT_PX // 2 or abs(width / height - WIDTH_PX / HEIGHT_PX) > 0.02:
        fix = f"Crop it to 4:3; the tracker works at {WIDTH_PX} x {HEIGHT_PX} px."
        raise core.InputError(f"The picture has {width} x {height} px.", where, fix)
    method = cv2.INTER_AREA if width > WIDTH_PX else cv2.INTER_CUBIC
    scaled = cv2.resize(picture, (WIDTH_PX, HEIGHT_PX), interpolation=method)
    return np.asarray(scaled, dtype=np.uint8)


def _open_pictures(path: Path) -> tuple[float, Iterator[core.ImageArray]]:
    if path.is_dir():
        return DEFAULT_RATE_HZ, (_read_image(file) for file in _images_in(path))
    if path.suffix.lower() in IMAGE_SUFFIXES:
        return DEFAULT_RATE_HZ, iter([_read_image(path)])
    core.check_file(path, _FIX)
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise core.InputError("This is neither a picture nor a video.", str(path), _FIX)
    rate_hz = float(capture.get(cv2.CAP_PROP_FPS))
    return (rate_hz if 1.0 <= rate_hz <= 1000.0 else DEFAULT_RATE_HZ), _video_frames(capture)


def _video_frames(capture: cv2.VideoCapture) -> Iterator[core.ImageArray]:
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


def _read_image(path: Path) -> core.ImageArray:
    core.check_file(path, _FIX)
    # Unlike imread, imdecode is silent on a broken file and accepts any path on Windows.
    data = np.frombuffer(path.read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR) if len(data) else None
    if picture is None:
        raise core.InputError("The picture cannot be decoded.", str(path), _FIX)
    return np.asarray(picture, dtype=np.uint8)


SCALE = 3
_RADIUS_PX = 9.0
_COLOURS_BGR = {
    core.MarkerState.SEEN: (120, 230, 120),
    core.MarkerState.INFERRED: (60, 190, 250),
    core.MarkerState.LOST: (80, 80, 250),
}
_ARROW_BGR = (255, 255, 255)


def draw_markers(frame: core.TactileFrame, field: core.MarkerField) -> core.ImageArray:
    """Return the picture at three times its size with rings, arrows and a status line."""
    size = (WIDTH_PX * SCALE, HEIGHT_PX * SCALE)
    dimmed = cv2.convertScaleAbs(frame.image, alpha=0.7)
    picture = cv2.resize(dimmed, size, interpolation=cv2.INTER_CUBIC)
    centre = SCALE * (field.position_px + 0.5)
    tail = SCALE * (field.position_px - field.displacement_px + 0.5)
    for here, rest, state in zip(centre, tail, field.state, strict=True):
        at = (round(here[0]), round(here[1]))
        colour = _COLOURS_BGR[core.MarkerState(int(state))]
        cv2.circle(picture, at, round(SCALE * _RADIUS_PX), colour, 1, cv2.LINE_AA)
        if np.hypot(*(here - rest)) > SCALE * 0.5:
            start = (round(rest[0]), round(rest[1]))
            cv2.arrowedLine(picture, start, at, _ARROW_BGR, 2, cv2.LINE_AA, tipLength=0.25)
    seen = int((field.state == core.MarkerState.SEEN).sum())
    text = f"frame {frame.sequence}  seen {seen}/63  quality {field.quality:.2f}"
    cv2.putText(
        picture, text, (8, size[1] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _ARROW_BGR, 1, cv2.LINE_AA
    )
    return np.asarray(picture, dtype=np.uint8)


class OverlayVideo:
    """Writes drawn frames to an MP4 file; raises ``InputError`` if it cannot be written."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(
            str(path), code, rate_hz, (WIDTH_PX * SCALE, HEIGHT_PX * SCALE)
        )
        if not self._writer.isOpened():
            fix = "Give a file name that ends in .mp4 in a folder that exists and is writable."
            raise core.InputError("The overlay video cannot be written.", str(path), fix)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.release()

    def add(self, frame: core.TactileFrame, field: core.MarkerField) -> None:
        """Append one drawn frame."""
        self._writer.write(draw_markers(frame, field))

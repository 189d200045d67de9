"""Draws tracked markers over their picture: a ring by state, an arrow from the rest place."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from backend.core.faults import InputError
from backend.core.flow import ImageArray, MarkerField, MarkerState, TactileFrame
from backend.sensing.detector import HEIGHT_PX, WIDTH_PX

SCALE = 3
_RADIUS_PX = 9.0
_COLOURS_BGR = {
    MarkerState.SEEN: (120, 230, 120),
    MarkerState.INFERRED: (60, 190, 250),
    MarkerState.LOST: (80, 80, 250),
}
_ARROW_BGR = (255, 255, 255)


def draw_markers(frame: TactileFrame, field: MarkerField) -> ImageArray:
    """Return the picture at three times its size with rings, arrows and a line of figures."""
    size = (WIDTH_PX * SCALE, HEIGHT_PX * SCALE)
    dimmed = cv2.convertScaleAbs(frame.image, alpha=0.7)
    picture = cv2.resize(dimmed, size, interpolation=cv2.INTER_CUBIC)
    centre = SCALE * (field.position_px + 0.5)
    tail = SCALE * (field.position_px - field.displacement_px + 0.5)
    for here, rest, state in zip(centre, tail, field.state, strict=True):
        at = (round(here[0]), round(here[1]))
        colour = _COLOURS_BGR[MarkerState(int(state))]
        cv2.circle(picture, at, round(SCALE * _RADIUS_PX), colour, 1, cv2.LINE_AA)
        if np.hypot(*(here - rest)) > SCALE * 0.5:
            start = (round(rest[0]), round(rest[1]))
            cv2.arrowedLine(picture, start, at, _ARROW_BGR, 2, cv2.LINE_AA, tipLength=0.25)
    seen = int((field.state == MarkerState.SEEN).sum())
    text = f"frame {frame.sequence}  seen {seen}/63  quality {field.quality:.2f}"
    cv2.putText(
        picture, text, (8, size[1] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _ARROW_BGR, 1, cv2.LINE_AA
    )
    return np.asarray(picture, dtype=np.uint8)


class OverlayVideo:
    """Writes drawn frames to an MP4 file; raises ``InputError`` where it cannot be written."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        code = cv2.VideoWriter.fourcc(*"mp4v")
        self._writer = cv2.VideoWriter(
            str(path), code, rate_hz, (WIDTH_PX * SCALE, HEIGHT_PX * SCALE)
        )
        if not self._writer.isOpened():
            raise InputError(
                "The overlay video cannot be written.",
                str(path),
                "Give a file name that ends in .mp4 in a folder that exists and is writable.",
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._writer.release()

    def add(self, frame: TactileFrame, field: MarkerField) -> None:
        """Append one drawn frame."""
        self._writer.write(draw_markers(frame, field))

"""Geometry of marker arrows: pure functions from displacements to line segments."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

MM_PER_PX = 18.6 / 320.0
"""The sensor sees 18.6 mm over 320 px (its maker's data)."""
GAIN = 3.0
"""Arrows are drawn this many times longer than the displacement, in all views."""
BIN_EDGES_PX = np.array([0.5, 1.5, 3.0, 5.0, 8.0])
"""Displacement at which the next of the six colours begins."""
BIN_COLOURS = ("#E76E5A", "#F1834B", "#F99A3D", "#FDB32F", "#FCCD25", "#F5EA26")
"""plasma 0.60 to 1.00: contrast at least 3.1 : 1 on the dark gel; length repeats the meaning."""
HEAD_SHARE, HEAD_MIN_PX, HEAD_MAX_PX = 0.35, 2.0, 7.0


def bins_of(displacement_px: FloatArray) -> NDArray[np.intp]:
    """(n,) colour bin 0..5 of (n, 2) displacements."""
    return np.asarray(np.digitize(np.hypot(*displacement_px.T), BIN_EDGES_PX))


def segments(rest_px: FloatArray, displacement_px: FloatArray) -> FloatArray:
    """(n, 3, 4) shaft and two head strokes (x1 y1 x2 y2) of n arrows from their rest positions."""
    vector = displacement_px * GAIN
    tip = rest_px + vector
    length = np.hypot(vector[:, 0], vector[:, 1])[:, None]
    direction = np.divide(vector, length, out=np.zeros_like(vector), where=length > 1e-9)
    head = np.clip(HEAD_SHARE * length, HEAD_MIN_PX, HEAD_MAX_PX) * (length > 1e-9)
    across = np.stack([-direction[:, 1], direction[:, 0]], axis=1)
    strokes = np.empty((len(rest_px), 3, 4))
    strokes[:, 0, :2], strokes[:, :, 2:] = rest_px, tip[:, None, :]
    strokes[:, 1, :2] = tip - head * direction + 0.5 * head * across
    strokes[:, 2, :2] = tip - head * direction - 0.5 * head * across
    return strokes

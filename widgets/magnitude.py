"""Size of the marker displacements as a picture: interpolated between the 7x9 markers."""

from __future__ import annotations

import cv2
import numpy as np
from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QColor, QFont, QFontMetrics, QPainter, QPixmap

from backend.core.flow import FloatArray, ImageArray, MarkerField, MarkerState
from widgets.arrows import MM_PER_PX
from widgets.colour_maps import MapName, colours, table

ROWS, COLUMNS = 7, 9
FULL_PX = 12.0
"""A displacement of this size (0.7 mm) has the last colour of the map."""
IMAGE_W, IMAGE_H = 320, 240
SCALE_PX = 64


def magnitude_px(field: MarkerField) -> FloatArray:
    """Return (7, 9) displacement sizes; a lost marker takes the mean of the others.

    So no false peak is drawn where nothing is known.
    """
    size = np.hypot(*field.displacement_px.T)
    unknown = ~np.isfinite(size) | (field.state == MarkerState.LOST)
    known = size[~unknown]
    filled = np.where(unknown, float(known.mean()) if len(known) else 0.0, size)
    return np.asarray(filled.reshape(ROWS, COLUMNS))


def magnitude_picture(field: MarkerField, map_name: MapName) -> ImageArray:
    """Return (240, 320, 3) BGR, bilinear between rest positions, level beyond the outer ones."""
    rest = (field.position_px - field.displacement_px).reshape(ROWS, COLUMNS, 2)
    across, down = np.nanmean(rest[:, :, 0], axis=0), np.nanmean(rest[:, :, 1], axis=1)
    u = np.interp(np.arange(IMAGE_W), across, np.arange(COLUMNS)).astype(np.float32)
    v = np.interp(np.arange(IMAGE_H), down, np.arange(ROWS)).astype(np.float32)
    grid = np.clip(magnitude_px(field) / FULL_PX, 0.0, 1.0).astype(np.float32)
    smooth = cv2.remap(grid, *np.meshgrid(u, v), cv2.INTER_LINEAR)
    picture = colours(np.asarray(smooth, dtype=np.float64), map_name)
    return np.ascontiguousarray(picture[:, :, ::-1])


def magnitude_scale(font: QFont, ratio: float, map_name: MapName = "cividis") -> QPixmap:
    """Return a bar of the colours with its ends in mm; ``ratio``: device pixels per pixel."""
    metrics = QFontMetrics(font)
    low, high = "0", f"{FULL_PX * MM_PER_PX:.1f} mm"
    left, tall = metrics.horizontalAdvance(low) + 12, max(metrics.height() + 6, 22)
    size = QSize(left + SCALE_PX + metrics.horizontalAdvance(high) + 12, tall)
    drawn = QPixmap(size * ratio)
    drawn.setDevicePixelRatio(ratio)
    drawn.fill(QColor(0, 0, 0, 150))
    painter = QPainter(drawn)
    try:
        shades = table(map_name)
        for at in range(SCALE_PX):
            shade = QColor(*shades[255 * at // (SCALE_PX - 1)].tolist())
            painter.fillRect(QRectF(left + at, tall / 2 - 4, 1.5, 8), shade)
        painter.setFont(font)
        painter.setPen(QColor("#FFFFFF"))
        middle = Qt.AlignmentFlag.AlignVCenter
        painter.drawText(QRectF(6, 0, left, tall), int(middle), low)
        painter.drawText(QRectF(left + SCALE_PX + 6, 0, size.width(), tall), int(middle), high)
    finally:
        painter.end()
    return drawn

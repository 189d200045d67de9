"""Size of the marker displacements as a picture: interpolated between the 7x9 markers."""

from __future__ import annotations

import cv2
import numpy as np

from backend.core.flow import FloatArray, ImageArray, MarkerField, MarkerState
from widgets.colour_maps import MapName, colours

ROWS, COLUMNS = 7, 9
FULL_PX = 12.0
"""A displacement of this size (0.7 mm) has the last colour of the map."""
IMAGE_W, IMAGE_H = 320, 240


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

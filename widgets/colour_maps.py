"""Colour maps as look-up tables (cividis by default: readable for every kind of colour vision)."""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

MapName = Literal["cividis", "viridis", "grey"]
MAPS: tuple[MapName, ...] = ("cividis", "viridis", "grey")


@cache
def table(name: MapName) -> NDArray[np.uint8]:
    """(256, 3) uint8 RGB of a map; read-only."""
    if name == "grey":
        lut = np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1)
    else:
        lut = np.ascontiguousarray(pg.colormap.get(name).getLookupTable(nPts=256)[:, :3])
        lut = lut.astype(np.uint8)
    lut.flags.writeable = False
    return lut


def colours(values: NDArray[np.float64], name: MapName) -> NDArray[np.uint8]:
    """Map values in 0..1 (any shape) to (..., 3) uint8; NaN becomes the colour of 0."""
    index = np.clip(np.nan_to_num(values, nan=0.0) * 255.0, 0, 255).astype(np.uint8)
    return np.asarray(table(name)[index])

"""How a gel rests in a few pictures, whatever it is: its grid, its dots, and how still they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from backend.core.flow import MARKERS, FloatArray, MarkerState, TactileFrame, read_only
from backend.sensing.grid import GridReport
from backend.sensing.markers import MarkerTracker


@dataclass(frozen=True, slots=True)
class Rest:
    """Of some pictures: ``grid`` in the best of them, ``position_px`` (63, 2) the median places.

    NaN for dots that were not seen in every picture with a usable grid; ``motion_px``: by how much
    the others moved from picture to picture, rms.
    """

    grid: GridReport
    position_px: FloatArray
    motion_px: float

    def __post_init__(self) -> None:
        read_only(self.position_px)


def look_at_rest(frames: Sequence[TactileFrame]) -> Rest:
    """Return how the gel of ``frames`` (one finger, oldest first, one or more) rests."""
    tracker = MarkerTracker(frames[0].finger)
    grids: list[GridReport] = []
    places = []
    for frame in frames:
        field = tracker.track(frame)
        grids.append(tracker.grid)
        if field.quality > 0.0:
            seen = field.state == MarkerState.SEEN
            places.append(np.where(seen[:, None], field.position_px, np.nan))
    best = max(grids, key=lambda grid: (grid.usable, grid.complete, grid.rows * grid.cols))
    if not places:
        return Rest(best, np.full((MARKERS, 2), np.nan), 0.0)
    stacked = np.stack(places)
    position_px = np.asarray(np.median(stacked, axis=0))
    whole = np.isfinite(position_px).all(axis=1)
    spread = stacked[:, whole] - stacked[:, whole].mean(axis=0)
    motion_px = float(np.sqrt((spread**2).sum(axis=2).mean())) if whole.any() else 0.0
    return Rest(best, position_px, motion_px)

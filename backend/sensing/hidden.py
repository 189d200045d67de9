"""Where the markers are that cannot be seen just now."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import MARKERS, FloatArray
from backend.core.inference import fill_field

LARGEST_CARRY_PX = 8.0


class HiddenMarkers:
    """Infers hidden markers from the seen ones and from what was last known of the hidden ones.

    A smooth fill alone would let a marker jump when it disappears, by as much as it deviates from
    its neighbours. That deviation is kept while the marker is hidden, and shrinks in proportion
    when the field around it does.
    """

    def __init__(self, rest_px: FloatArray) -> None:
        self._rest: FloatArray = np.array(rest_px)
        self._known = np.zeros((MARKERS, 2))
        self._seen = np.ones(MARKERS, dtype=bool)
        self._deviation = np.zeros((MARKERS, 2))
        self._size = np.zeros(MARKERS)

    def carry(self, step: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
        """Return ``step`` (63, 2) with the unseen filled smoothly."""
        if seen.all():
            return step
        filled: FloatArray = fill_field(step[None], seen[None])[0]
        return filled

    def fill(self, position_px: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
        """Return the places (63, 2): seen ones as given, hidden ones inferred."""
        displacement = position_px - self._rest
        if seen.all():
            self._known, self._seen = displacement, seen
            return position_px
        smooth = self.carry(displacement, seen)
        if (seen != self._seen).any():
            self._remember(seen)
        hidden = ~seen
        size = np.linalg.norm(smooth[hidden], axis=1)
        scale = np.minimum(1.0, size / np.maximum(self._size[hidden], 1e-3))
        smooth[hidden] += scale[:, None] * self._deviation[hidden]
        self._known, self._seen = smooth, seen
        return np.asarray(self._rest + smooth, dtype=np.float64)

    def forget(self, markers: NDArray[np.bool_]) -> None:
        """Drop what is remembered of ``markers`` (63,): they are filled smoothly."""
        self._deviation[markers] = 0.0

    def _remember(self, seen: NDArray[np.bool_]) -> None:
        smooth = self.carry(self._known, seen)
        deviation = self._known - smooth
        length = np.maximum(np.linalg.norm(deviation, axis=1), 1e-9)
        self._deviation = deviation * np.minimum(1.0, LARGEST_CARRY_PX / length)[:, None]
        self._size = np.linalg.norm(smooth, axis=1)

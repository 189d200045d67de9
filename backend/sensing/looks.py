"""How dark and how large each marker usually looks, to tell it from whatever covers it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import MARKERS, FloatArray

OWN_RANGE = np.array([[0.7, 0.5], [1.45, 1.45]])
"""Lowest and highest ratio of darkness in the middle and in all to the marker's own usual look."""
COMMON_RANGE = np.array([[0.5, 0.5], [1.9, 1.9]])
"""Ratio to the look of the other markers, where a marker has no own yet or was long hidden."""
MEMORY = 0.05


class UsualLooks:
    """Running mean of the darkness of every marker, in its middle and in all."""

    def __init__(self) -> None:
        self._usual = np.zeros((MARKERS, 2))
        self.newest: FloatArray = np.zeros((MARKERS, 2))
        """Of the last frame, of markers that looked like themselves."""

    def recognise_all(self, looks: FloatArray) -> bool:
        """Return whether all 63 look like themselves, and learn from that if they do."""
        own = self._usual
        if not ((looks >= own * OWN_RANGE[0]).all() and (looks <= own * OWN_RANGE[1]).all()):
            return False
        own += MEMORY * (looks - own)
        self.newest = looks
        return True

    def recognise(
        self, markers: NDArray[np.intp], looks: FloatArray, stale: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return (n,) whether ``markers`` look like themselves, and learn from those that do.

        ``looks``: (n, 2) of the dot given to each; ``stale``: (n,) not seen for so long that the
        own look may have changed.
        """
        if not len(markers):
            return np.zeros(0, dtype=bool)
        own = self._usual[markers]
        fresh = (own[:, 0] > 0) & ~stale
        expected = own
        if not fresh.all():
            typical = np.median(own[fresh] if fresh.any() else looks, axis=0)
            expected = np.where(fresh[:, None], own, np.maximum(typical, 1e-6))
        ratio = looks / expected
        lowest = np.where(fresh[:, None], OWN_RANGE[0], COMMON_RANGE[0])
        highest = np.where(fresh[:, None], OWN_RANGE[1], COMMON_RANGE[1])
        good = ((ratio >= lowest) & (ratio <= highest)).all(axis=1)
        blend = np.where(fresh, MEMORY, 1.0)[:, None]
        self._usual[markers[good]] = (own + blend * (looks - own))[good]
        self.newest = self.newest.copy()
        self.newest[markers[good]] = looks[good]
        return np.asarray(good)

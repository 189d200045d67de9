"""What an arm has measured of its place, and how often: its poses and the figures of its health."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from backend.core.flow import FloatArray
from backend.core.stream import SampleStream
from backend.devices.protocols import Health
from backend.devices.streamed.motion import ARM

RATE_WINDOW_S = 1.0
KEPT = 32_768


class MeasuredPlaces:
    """``poses``: position of ``G``, mm in the bench. One thread puts, any reads."""

    def __init__(self, now_s: Callable[[], float], poses: SampleStream | None = None) -> None:
        self._now_s = now_s
        self.poses = poses or SampleStream(ARM, 3, KEPT)
        self.begin()

    def begin(self) -> None:
        """Count anew: a connection begins."""
        self.received = 0
        self._arrivals: deque[float] = deque(maxlen=512)

    def put(self, now_s: float, place_mm: FloatArray) -> None:
        """Take where ``G`` (3,) was measured at ``now_s``."""
        self.poses.put(np.array([now_s]), place_mm[None])
        self.received += 1
        self._arrivals.append(now_s)

    def latest_mm(self, max_age_s: float) -> tuple[float, float, float]:
        """Return the newest place; raises ``StaleSampleError`` if it is older."""
        _, (x_mm, y_mm, z_mm) = self.poses.latest(self._now_s(), max_age_s)
        return float(x_mm), float(y_mm), float(z_mm)

    def health(self, lost: int) -> Health:
        """Return rate over the last second, age of the newest, and counts with ``lost``."""
        now_s, arrivals = self._now_s(), self._arrivals.copy()
        rate_hz = sum(t_s > now_s - RATE_WINDOW_S for t_s in arrivals) / RATE_WINDOW_S
        age_s = now_s - arrivals[-1] if arrivals else math.inf
        return Health(rate_hz, age_s, self.received, lost)

"""Min/max buckets of a fast signal, filled as samples arrive: what a trace draws."""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray


class TraceBuckets:
    """Keeps, per bucket of time, the least and greatest sample of every channel.

    A ring over the newest ``span_s`` of signal time. Buckets without a sample are NaN: a gap is
    shown as a gap, never as zero. Time that jumps back (a new trial) empties the ring.
    """

    def __init__(self, channels: int, span_s: float = 10.0, buckets: int = 500) -> None:
        self.span_s, self.buckets, self.channels = span_s, buckets, channels
        self._width_s = span_s / buckets
        self._low = np.full((buckets, channels), np.nan)
        self._high = np.full((buckets, channels), np.nan)
        self._newest = -1
        self.last: FloatArray = np.full(channels, np.nan)

    @property
    def empty(self) -> bool:
        """Whether no finite sample has arrived."""
        return self._newest < 0

    def clear(self) -> None:
        """Forget everything."""
        self._low[:] = np.nan
        self._high[:] = np.nan
        self._newest = -1
        self.last = np.full(self.channels, np.nan)

    def add(self, t_s: FloatArray, values: FloatArray) -> None:
        """Take samples: ``t_s`` (n,) ascending, ``values`` (n, channels)."""
        if len(t_s) == 0:
            return
        index = np.floor(t_s / self._width_s + 1e-9).astype(np.int64)
        if index[0] < self._newest - 1:
            self.clear()
        oldest = index[-1] - self.buckets
        if index[0] <= oldest:
            keep = index > oldest
            index, values = index[keep], values[keep]
        self._advance(int(index[-1]))
        starts = np.concatenate(([0], np.flatnonzero(index[1:] != index[:-1]) + 1))
        slots = index[starts] % self.buckets
        low = np.fmin.reduceat(values, starts, axis=0)
        high = np.fmax.reduceat(values, starts, axis=0)
        self._low[slots] = np.fmin(self._low[slots], low)
        self._high[slots] = np.fmax(self._high[slots], high)
        self.last = values[-1].copy()

    def _advance(self, newest: int) -> None:
        """Empty the buckets between the former newest one and the new one."""
        if self._newest >= 0:
            count = min(newest - self._newest, self.buckets)
            fresh = (self._newest + 1 + np.arange(count)) % self.buckets
            self._low[fresh] = np.nan
            self._high[fresh] = np.nan
        self._newest = max(newest, self._newest)

    def ordered(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return (age in s <= 0, low, high), oldest first; (n,), (n, channels), (n, channels)."""
        order = (self._newest + 1 + np.arange(self.buckets)) % self.buckets
        age_s = (np.arange(self.buckets) - self.buckets + 1) * self._width_s
        return np.asarray(age_s, dtype=np.float64), self._low[order], self._high[order]

    def largest(self) -> float:
        """Largest magnitude kept (0 if empty)."""
        both = np.stack([self._low, self._high])
        finite = np.abs(both[np.isfinite(both)])
        return float(finite.max()) if len(finite) else 0.0

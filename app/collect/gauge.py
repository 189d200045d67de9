"""The recorder in figures: free disk, what a minute takes, and how long the room lasts."""

from __future__ import annotations

import shutil
from collections import deque
from pathlib import Path

WINDOW_S = 120.0
"""The rate is that of the last two minutes."""
LOW_BYTES = 2_000_000_000


class RecorderGauge:
    """Counts what was written; all times are those of one clock."""

    def __init__(self) -> None:
        self._written: deque[tuple[float, int]] = deque()

    def note(self, now_s: float, count_bytes: int) -> None:
        """Take an episode of ``count_bytes`` that is on the disk."""
        self._written.append((now_s, count_bytes))

    def bytes_a_minute(self, now_s: float) -> float:
        """Return the rate over the last two minutes; 0 before two episodes are there."""
        while self._written and now_s - self._written[0][0] > WINDOW_S:
            self._written.popleft()
        if len(self._written) < 2:
            return 0.0
        span_s = now_s - self._written[0][0]
        # The first one was written before the span began.
        later = sum(size for _, size in self._written) - self._written[0][1]
        return 60.0 * later / span_s if span_s > 0 else 0.0

    def words(self, folder: Path, now_s: float) -> str:
        """Return the gauge in words; a folder that cannot be looked at says so."""
        try:
            free = shutil.disk_usage(folder).free
        except OSError as error:
            return f"The disk does not answer: {error.strerror}"
        rate = self.bytes_a_minute(now_s)
        text = f"{free / 1e9:.1f} GB free, {rate / 1e6:.1f} MB/min"
        if rate > 0:
            text += f", room for {time_words(60.0 * free / rate)}"
        return f"Nearly full: {text}" if free < LOW_BYTES else text


class Pace:
    """How long the rest of a campaign takes, from the last probes."""

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=21)

    def restart(self, now_s: float) -> None:
        """Begin to count: a run begins."""
        self._at_s.clear()
        self._at_s.append(now_s)

    def note(self, now_s: float) -> None:
        """One more probe is there."""
        self._at_s.append(now_s)

    def words(self, left: int) -> str:
        """Return the time for ``left`` probes in words, "" while unknown."""
        if len(self._at_s) < 2 or left <= 0:
            return ""
        each_s = (self._at_s[-1] - self._at_s[0]) / (len(self._at_s) - 1)
        return f"{left} left, about {time_words(left * each_s)} at {each_s:.1f} s each"


def time_words(seconds: float) -> str:
    """Write a length of time with two figures at most: "40 s", "12 min", "3 h 20 min", "8 days"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 90:
        return f"{minutes} min"
    if minutes < 48 * 60:
        return f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{min(minutes // 1440, 999)} days"

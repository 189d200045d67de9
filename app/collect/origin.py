"""Origin of the bottom, measured and entered."""

from __future__ import annotations

import shutil
from collections import deque
from dataclasses import dataclass
from pathlib import Path

from touchdown.app.shell import duration_text
from touchdown.widgets.base import signed, tr

WINDOW_S = 120.0  # time window of the recording rate
LOW_BYTES = 2_000_000_000


class RecorderGauge:
    """Measures the recording rate. All times are of the same clock."""

    def __init__(self) -> None:
        self._written: deque[tuple[float, int]] = deque()

    def note(self, now_s: float, count_bytes: int) -> None:
        """Add an episode of ``count_bytes`` that was written."""
        self._written.append((now_s, count_bytes))

    def bytes_a_minute(self, now_s: float) -> float:
        """Return the rate over the last two minutes; 0 before two episodes were written."""
        while self._written and now_s - self._written[0][0] > WINDOW_S:
            self._written.popleft()
        if len(self._written) < 2:
            return 0.0
        span_s = now_s - self._written[0][0]
        # The first episode was written before the time span.
        later = sum(size for _, size in self._written) - self._written[0][1]
        return 60.0 * later / span_s if span_s > 0 else 0.0

    def words(self, folder: Path, now_s: float) -> str:
        """Return free space and rate as text, or that the folder is not readable."""
        try:
            free = shutil.disk_usage(folder).free
        except OSError as error:
            return tr("The disk does not answer: {}", error.strerror)
        rate = self.bytes_a_minute(now_s)
        text = tr("{:.1f} GB free", free / 1e9)
        if rate > 0:  # as short as its line in a narrow window
            lasts = duration_text(60.0 * free / rate)
            text = tr("{:.1f} GB free, {} at {:.1f} MB/min", free / 1e9, lasts, rate / 1e6)
        return tr("Nearly full: {}", text) if free < LOW_BYTES else text


class CampaignPace:
    """Estimates the remaining time of a campaign from the last probes."""

    def __init__(self) -> None:
        self._at_s: deque[float] = deque(maxlen=21)

    def restart(self, now_s: float) -> None:
        """Start counting for a new run."""
        self._at_s.clear()
        self._at_s.append(now_s)

    def note(self, now_s: float) -> None:
        """Count one more probe."""
        self._at_s.append(now_s)

    def words(self, left: int) -> str:
        """Return the time for ``left`` probes as text, "" while unknown."""
        if len(self._at_s) < 2 or left <= 0:
            return ""
        each_s = (self._at_s[-1] - self._at_s[0]) / (len(self._at_s) - 1)
        return tr("{} left, about {} at {:.1f} s each", left, duration_text(left * each_s), each_s)


@dataclass(frozen=True, slots=True)
class OriginCheckNote:
    """Measured centre of the bottom minus the origin, in mm.

    ``used``: the origin was corrected by it.
    """

    residual_mm: tuple[float, float]
    sigma_mm: float
    agrees: bool
    at: str
    used: bool = False


def residual_text(note: OriginCheckNote | None) -> str:
    """Return residual, uncertainty, judgement and date as text."""
    if note is None:
        return tr("Origin as entered; checking it is optional.")
    x, y = (signed(v) for v in note.residual_mm)
    spread = f"\N{PLUS-MINUS SIGN} {note.sigma_mm:.2f} mm"
    said = tr("agrees with the origin") if note.agrees else tr("does not agree with the origin")
    if note.used:
        said = tr("the origin was moved there")
    return f"{tr('Residual x {}, y {} {}: {}.', x, y, spread, said)} {note.at}"

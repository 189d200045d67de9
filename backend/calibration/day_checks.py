"""Daily checks of a bench: limits, history, and the releases that they withhold.

One JSON line per check in a file beside the calibrations; the last check of a day counts. The
limits for any bench hold always. From ``LEAST_CHECKS`` days on, the median and the spread (median
absolute deviation) of the days within limits tighten them. The number of markers is compared with
the first check of the same gel instead.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationError

from touchdown.backend.config import Settings
from touchdown.backend.core import MARKERS, CalibrationMeasured, Finger, append_line, disk_errors

LEAST_CHECKS, MOST_CHECKS = 5, 30  # days of a history
FEWEST_MARKERS = MARKERS - 6  # an episode may lack as many
WORN_MARKERS = 3  # markers that a gel may lose after its first check
SPREADS = 6.0  # standard deviations, 1.4826 median absolute deviations each, within limits
SIDES = {"left": "left finger", "right": "right finger", "wrist": "wrist sensor"}


@dataclass(frozen=True, slots=True)
class CheckedQuantity:
    """Quantity with its limits for any bench, ``low`` 0 if it has none, and what to do beyond.

    ``least``: smallest distance of a limit from the median of the history.
    """

    title: str
    unit: str
    low: float
    high: float
    least: float
    fix: str


# By the name of a value without its side, as in "left_noise_px".
QUANTITIES = {
    "stiffness_px_n": CheckedQuantity("Motion of the markers", "px/N", 0.6, 2.0, 0.3,
        "Check the grip force and look for tears in the gel; replace a worn gel."),
    "markers": CheckedQuantity("Number of markers", "", FEWEST_MARKERS, MARKERS, WORN_MARKERS,
        "Clean the gel and look at its picture; replace a gel with worn dots."),
    "noise_px": CheckedQuantity("Noise of the markers", "px", 0.0, 0.18, 0.03,
        "Check light, focus and cable of the camera, and that nothing touches the gel."),
    "offset_px": CheckedQuantity("Offset of the grasp", "px", 0.0, 4.0, 1.0,
        "Check how the piece sits between the jaws, and that gel and camera are fixed."),
    "noise_n": CheckedQuantity("Noise at rest", "N", 0.0, 0.2, 0.03,
        "Check its cable and earth, and what shakes the table."),
    "drift_n_min": CheckedQuantity("Drift at rest", "N/min", 0.0, 0.2, 0.1,
        "Let the sensor warm up and check again; check its mounting."),
}  # fmt: skip
NAMES = frozenset(f"{side}_{key}" for side in SIDES for key in QUANTITIES)


def quantity(name: str) -> CheckedQuantity:
    """Return the quantity of a value such as "left_noise_px", with its side in the title."""
    side, _, key = name.partition("_")
    return replace(QUANTITIES[key], title=f"{QUANTITIES[key].title}, {SIDES[side]}")


class DayCheck(Settings):
    """Values of one check by name, each with its limits. The date is UTC.

    ``gels``: serial number of the gel by finger, where it is known.
    """

    version: Literal[1] = 1
    bench: str
    date: Annotated[datetime, Field(strict=False)]
    values: dict[str, float]
    limits: dict[str, tuple[float, float]]
    gels: dict[str, str] = Field(default_factory=dict)

    @property
    def day(self) -> str:
        """Date on this computer's clock."""
        return f"{self.date.astimezone():%Y-%m-%d}"

    def share(self, name: str) -> float:
        """Return how far a value is from the best one; more than 1 is out of its limits.

        The best is the middle of the limits, 0 where they have no lower one, all for markers.
        """
        low, high = self.limits[name]
        best = 0.5 * (low + high) if low > 0.0 else 0.0
        best = high if name.endswith("_markers") else best
        return abs(self.values[name] - best) / (max(high - best, best - low) or 0.5)

    @property
    def findings(self) -> dict[str, str]:
        """Each value out of limits as a sentence, with what to do."""
        found = {}
        for name, (low, high) in self.limits.items():
            known, value = quantity(name), self.values[name]
            if not low <= value <= high:
                beyond = f"below {low:.3g}" if value < low else f"above {high:.3g}"
                what = f"{known.title}: {value:.3g}, {beyond} {known.unit}".rstrip()
                found[name] = f"{what}. {known.fix}"
        return found

    def rows(self) -> list[tuple[str, str, str]]:
        """Return name, value and limits of each quantity; first, marked, those out of limits."""
        rows, findings = [], self.findings
        for name in sorted(self.limits, key=lambda name: name not in findings):
            low, high = self.limits[name]
            known, value = quantity(name), f"{self.values[name]:.3g}"
            title = f"\N{MULTIPLICATION X} {known.title}" if name in findings else known.title
            rows.append((title, f"{value} {known.unit}".rstrip(), f"{low:.3g} to {high:.3g}"))
        return rows


class DayChecks:
    """Checks of one bench, by its hash ``bench`` ("": of any), in ``path`` (None: none).

    ``required``: unattended release needs a check of the same day. ``step``: how to check.
    ``gels``: serial numbers by finger, where known. All methods raise ``InputError`` for an error
    of the disk.
    """

    def __init__(
        self,
        path: Path | None,
        bench: str = "",
        step: str = "",
        *,
        required: bool = False,
        gels: Mapping[Finger, str] | None = None,
    ) -> None:
        self._path, self._bench, self._step, self._required = path, bench, step, required
        self._gels = {str(finger): gel for finger, gel in (gels or {}).items()}

    def judge(self, found: CalibrationMeasured, now: datetime | None = None) -> CalibrationMeasured:
        """Compare a check with its limits and store it; return it with the result."""
        date = (now or datetime.now(UTC)).replace(microsecond=0)
        values = dict(zip(found.names, found.values, strict=True))
        check = DayCheck(bench=self._bench, date=date, values=values, limits={}, gels=self._gels)
        before = [one for one in self._every()[0] if one.day != check.day]
        limits = {name: self._limits(name, before) for name in values}
        check = check.model_copy(update={"limits": limits})
        if self._path is not None:
            fix = "Make room, or name a folder that can be written, and check again."
            with disk_errors("The daily check cannot be stored", self._path, fix):
                append_line(self._path, check.model_dump_json().encode())
        shares = tuple(map(check.share, found.names))
        obstacle = " ".join(check.findings.values())
        return replace(found, residual=max(shares), residuals=shares, obstacle=obstacle)

    def _limits(self, name: str, before: list[DayCheck]) -> tuple[float, float]:
        known, (side, _, key) = quantity(name), name.partition("_")
        low, high, gel = known.low, known.high, self._gels.get(side)
        if key == "markers" and gel:
            # By serial number: also on the other finger, and before a change of the bench.
            among = [
                (one, f"{at}_{key}") for one in before for at in one.gels if one.gels[at] == gel
            ]
        else:
            among = [(one, name) for one in before if self._bench in ("", one.bench)]
        past = [one.values[at] for one, at in among if at in one.values and at not in one.findings]
        if key == "markers":
            return max(low, past[0] - known.least) if past else low, high
        if len(past := past[-MOST_CHECKS:]) >= LEAST_CHECKS:
            middle = float(np.median(past))
            spread = 1.4826 * float(np.median(np.abs(np.subtract(past, middle))))
            reach = max(SPREADS * spread, known.least)
            low, high = max(low, middle - reach), min(high, middle + reach)
        return low, high

    def obstacle(self, now: datetime | None = None) -> str:
        """Return why unattended release is withheld, "" if it is not."""
        checks, damaged = self.read()
        today = f"{(now or datetime.now(UTC)).astimezone():%Y-%m-%d}"
        if damaged:
            why = "The record of the last daily check is damaged"
        elif checks and checks[-1].findings:
            titles = "; ".join(quantity(name).title.lower() for name in checks[-1].findings)
            why = f"The daily check of {checks[-1].day} is out of limits ({titles})"
        elif self._required and (not checks or checks[-1].day != today):
            why = "There is no daily check of today"
        else:
            return ""
        return f"{why}: each release is asked. {self._step[:1].upper()}{self._step[1:]}."

    def read(self) -> tuple[list[DayCheck], bool]:
        """Return the last check of each day, and True if the last line is damaged."""
        every, damaged = self._every()
        return [one for one in every if self._bench in ("", one.bench)], damaged

    def _every(self) -> tuple[list[DayCheck], bool]:
        """Return the last check of each day and bench, and True if the last line is damaged."""
        days, damaged = dict[tuple[str, str], DayCheck](), False
        if self._path is None or not self._path.exists():
            return [], False
        with disk_errors("The daily checks cannot be read", self._path, "Check its permissions."):
            lines = self._path.read_bytes().splitlines()
        for line in lines:
            try:
                check = DayCheck.model_validate_json(line)
            except ValidationError:
                damaged = True
                continue
            damaged = not (check.limits.keys() == check.values.keys() <= NAMES)
            if not damaged:
                days.pop((check.bench, check.day), None)
                days[check.bench, check.day] = check
        return list(days.values()), damaged

"""Rates with their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from backend.learning.metrics import Z_95, wilson


@dataclass(frozen=True, slots=True)
class Estimate:
    """A value in 0..1 with its 95 % interval, from ``n`` independent trials; None without any."""

    value: float | None
    low: float | None
    high: float | None
    n: int

    def as_json(self) -> dict[str, float | int | None]:
        """Return the fields by name."""
        return asdict(self)


def rate(successes: int, trials: int) -> Estimate:
    """Return a share with its Wilson interval."""
    if not trials:
        return Estimate(None, None, None, 0)
    low, high = wilson(successes, trials)
    return Estimate(successes / trials, low, high, trials)


def mean(values: Sequence[float]) -> Estimate:
    """Return a mean with its normal interval; ``values`` are independent of each other."""
    n = len(values)
    if not n:
        return Estimate(None, None, None, 0)
    data = np.asarray(values, dtype=np.float64)
    centre = float(data.mean())
    half = Z_95 * float(data.std(ddof=1)) / n**0.5 if n > 1 else 1.0
    return Estimate(centre, max(0.0, centre - half), min(1.0, centre + half), n)


@dataclass(frozen=True, slots=True)
class Binary:
    """Counts of a yes-or-no answer: said stable and is (``both``), is but was not said
    (``missed``), was said but is not (``unsafe``), ``neither``.
    """

    both: int
    missed: int
    unsafe: int
    neither: int

    @classmethod
    def of(cls, said: Sequence[bool], true: Sequence[bool]) -> Binary:
        """Count; ``said`` and ``true`` of equal length."""
        pairs = list(zip(said, true, strict=True))
        return cls(
            sum(s and t for s, t in pairs),
            sum(t and not s for s, t in pairs),
            sum(s and not t for s, t in pairs),
            sum(not s and not t for s, t in pairs),
        )

    @property
    def n(self) -> int:
        """Number of cases."""
        return self.both + self.missed + self.unsafe + self.neither

    def __add__(self, other: Binary) -> Binary:
        return Binary(
            self.both + other.both,
            self.missed + other.missed,
            self.unsafe + other.unsafe,
            self.neither + other.neither,
        )

    def as_json(self) -> dict[str, object]:
        """Return accuracy, balanced accuracy, base rate, and the rate of each kind of error."""
        found = rate(self.both, self.both + self.missed)
        unsafe = rate(self.unsafe, self.unsafe + self.neither)
        stable = self.both + self.missed
        balanced = None
        if found.value is not None and unsafe.value is not None:
            balanced = 0.5 * (found.value + 1.0 - unsafe.value)
        return {
            "accuracy": rate(self.both + self.neither, self.n).as_json(),
            "balanced": balanced,
            "base_rate": max(stable, self.n - stable) / self.n if self.n else None,
            "stable_share": stable / self.n if self.n else None,
            "found": found.as_json(),
            "unsafe": unsafe.as_json(),
        }

"""Statistics of the experiments: rates, means, verdicts, paired changes, 95 % intervals.

Rates have Wilson intervals, and exact bounds without events. Means have normal intervals over
independent groups.
``reliability_curve`` sorts probabilities into bins of equal mass; its ``ece`` is the expected
calibration error. ``iou_change`` compares the same seeds group by group.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, astuple, dataclass
from fractions import Fraction
from math import comb
from operator import add
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray
from touchdown.backend.learning import Z_95, calibration_error, rate_interval

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class IntervalEstimate:
    """A value in 0..1 with its 95 % interval from ``n`` independent trials; None without trials."""

    value: float | None
    low: float | None
    high: float | None
    n: int

    def as_json(self) -> dict[str, float | int | None]:
        """Return the fields by name."""
        return asdict(self)


def estimate_rate(successes: int, trials: int) -> IntervalEstimate:
    """Return a rate of independent trials with its interval, see ``rate_interval``."""
    if not trials:
        return IntervalEstimate(None, None, None, 0)
    low, high = rate_interval(successes, trials)
    return IntervalEstimate(successes / trials, low, high, trials)


def estimate_mean(values: Sequence[float]) -> IntervalEstimate:
    """Return the mean of independent ``values`` with its normal interval."""
    n = len(values)
    if not n:
        return IntervalEstimate(None, None, None, 0)
    data = np.asarray(values, dtype=np.float64)
    centre = float(data.mean())
    half = Z_95 * float(data.std(ddof=1)) / n**0.5 if n > 1 else 1.0
    return IntervalEstimate(centre, max(0.0, centre - half), min(1.0, centre + half), n)


@dataclass(frozen=True, slots=True)
class VerdictCounts:
    """Confusion counts of stability verdicts: ``both``, ``missed``, ``unsafe`` (said only),
    ``neither``.
    """

    both: int
    missed: int
    unsafe: int
    neither: int

    @classmethod
    def of(cls, predicted: Sequence[bool], true: Sequence[bool]) -> VerdictCounts:
        """Count ``predicted`` against ``true``, of equal length."""
        n = Counter((bool(s), bool(t)) for s, t in zip(predicted, true, strict=True))
        return cls(n[True, True], n[False, True], n[True, False], n[False, False])

    def __add__(self, other: VerdictCounts) -> VerdictCounts:
        return VerdictCounts(*map(add, astuple(self), astuple(other)))

    def as_json(self) -> dict[str, Any]:
        """Return accuracy, balanced accuracy, base rate, and the rates of both errors."""
        found = estimate_rate(self.both, self.both + self.missed)
        unsafe = estimate_rate(self.unsafe, self.unsafe + self.neither)
        n, stable = sum(astuple(self)), self.both + self.missed
        balanced = None
        if found.value is not None and unsafe.value is not None:
            balanced = 0.5 * (found.value + 1.0 - unsafe.value)
        return {
            "accuracy": estimate_rate(self.both + self.neither, n).as_json(),
            "balanced": balanced,
            "base_rate": max(stable, n - stable) / n if n else None,
            "stable_share": stable / n if n else None,
            "found": found.as_json(),
            "unsafe": unsafe.as_json(),
        }


def verdict_changes(
    paired: Sequence[tuple[bool, bool, bool]], mountings: Sequence[str] | None = None
) -> dict[str, dict[str, float]]:
    """Return the change of plain and balanced accuracy between two verdicts on the same groups.

    ``paired``: both verdicts and the truth of every group. ``mountings``: the one of each group; by
    default each group has its own. The intervals are normal ones over mountings, from the linear
    influence of every group (Taylor linearisation of a ratio; Cochran, Sampling Techniques, 1977).
    """
    before, after, truth = np.array(paired, dtype=bool).T
    gain = (after == truth).astype(float) - (before == truth).astype(float)
    names = range(len(gain)) if mountings is None else mountings
    _, index = np.unique(np.array(names), return_inverse=True)
    strata = {"accuracy": [np.ones(len(gain), bool)], "balanced": [truth, ~truth]}
    changes = {}
    for name, parts in strata.items():
        if min(int(part.sum()) for part in parts) < 2:
            continue
        share = [float(gain[part].mean()) for part in parts]
        influence = np.zeros(len(gain))
        for part, centre in zip(parts, share, strict=True):
            influence[part] = (gain[part] - centre) / (part.sum() * len(parts))
        by_mounting = np.bincount(index, influence)
        count = len(by_mounting)
        error = float(np.sum(by_mounting**2)) * count / max(count - 1, 1)
        change, half = sum(share) / len(parts), Z_95 * error**0.5
        changes[name] = {
            "change": change,
            "low": change - half,
            "high": change + half,
            "n": len(gain),
            "mountings": count,
        }
    return changes


SEQUENTIAL_ERROR = 0.05


def evidence(more: int, less: int) -> float:
    """Return the evidence that one of two strategies has an event more often than the other.

    Only pairs of trials on the same seed that differ count (McNemar, Psychometrika 12, 1947). If
    the strategy has the event no more often, each such pair is, given the former ones, in its
    favour with a probability of at most one half. A bettor who stakes the share b of the capital
    on it multiplies the capital by 1 + b or 1 - b; the mean over uniform b from 0 to 1 is this
    value. It is a supermartingale that starts at 1, so that it ever reaches 1 / a with a
    probability of at most a (Ville's inequality): a comparison may stop at any time. Betting:
    Waudby-Smith and Ramdas, Journal of the Royal Statistical Society B 86, 2024; method of
    mixtures: Robbins, Annals of Mathematical Statistics 41, 1970. For unpaired trials the
    reference is STEP (arXiv 2503.10966).

    Parameters
    ----------
    more, less : int
        Numbers of pairs in which only this strategy, or only the other one, has the event.

    Returns
    -------
    float
        The e-value, sum of C(n + 1, i) for i up to ``more`` over (n + 1) C(n, more), n = more +
        less: computed in whole numbers.

    Examples
    --------
    >>> evidence(0, 0), round(evidence(7, 0), 1), round(evidence(8, 0), 1)
    (1.0, 31.9, 56.8)

    """
    n = more + less
    heads = sum(comb(n + 1, i) for i in range(more + 1))
    return float(Fraction(heads, (n + 1) * comb(n, more)))


def sequential_decision(
    more: int, less: int, comparisons: int = 1
) -> Literal["more", "less"] | None:
    """Return the direction that paired trials decide at any stopping time, None while open.

    Each direction has half of the error of 5 %, divided by the number of ``comparisons``.
    """
    enough = 2.0 * comparisons / SEQUENTIAL_ERROR
    if evidence(more, less) >= enough:
        return "more"
    return "less" if evidence(less, more) >= enough else None


BINS = 15


def reliability_curve(
    probability: FloatArray, truth: NDArray[np.bool_] | FloatArray, bins: int = BINS
) -> Json:
    """Sort ``probability`` (n,) into ``bins`` of equal mass and compare with ``truth`` (n,).

    A share in ``truth`` represents cases that were counted together. Returns per bin the mean
    probability ``promised``, the observed share ``came`` and the ``count``; and ``ece``.
    """
    order = np.argsort(probability, kind="stable")
    parts = [part for part in np.array_split(order, bins) if len(part)]
    found = [(float(probability[p].mean()), float(truth[p].mean()), len(p)) for p in parts]
    return {
        "promised": [round(promised, 4) for promised, _, _ in found],
        "came": [round(came, 4) for _, came, _ in found],
        "count": [count for _, _, count in found],
        "ece": round(calibration_error(found), 4),
    }


PressResult = Mapping[str, Any]  # result of one job of presses


def iou_change(pairs: Sequence[tuple[PressResult, PressResult]], before: str, after: str) -> Json:
    """Return the mean change of IoU with its 95 % interval, over groups common to both.

    ``before`` is the model in the first part of each pair, ``after`` in the second. Jobs with
    left-out groups are not compared, because their groups no longer match.
    """
    change = [
        new - old
        for then, now in pairs
        if then["left_out"] == now["left_out"] == 0
        for old, new in zip(_iou(then, before), _iou(now, after), strict=True)
    ]
    if len(change) < 2:
        return {"value": None, "low": None, "high": None, "n": len(change)}
    centre, half = float(np.mean(change)), Z_95 * float(np.std(change, ddof=1)) / len(change) ** 0.5
    return {"value": centre, "low": centre - half, "high": centre + half, "n": len(change)}


def _iou(part: PressResult, model: str) -> Sequence[float]:
    found: Sequence[float] = part["models"][model]["patch"]["iou"]
    return found


def format_change(change: Json | None) -> str:
    """Format a change in points with half its interval; "" without one."""
    if not change or change["value"] is None:
        return ""
    half = 50.0 * (change["high"] - change["low"])
    return f"{100 * change['value']:+.1f} ± {half:.1f}"

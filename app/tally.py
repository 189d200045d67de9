"""Success rates with their uncertainty."""

from __future__ import annotations

import math
from collections.abc import Sequence

from app.run_story import TrialStory
from backend.core.flow import Outcome
from widgets.score_panel import Score

Z_95 = 1.959964
"""Two-sided 95 % quantile of the normal distribution."""


def wilson(successes: int, trials: int, z: float = Z_95) -> tuple[float, float] | None:
    """Return the Wilson score interval (0..1), None without a trial (Wilson 1927)."""
    if trials <= 0:
        return None
    rate = successes / trials
    centre = rate + z * z / (2 * trials)
    half = z * math.sqrt(rate * (1 - rate) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    low, high = (centre - half) / scale, (centre + half) / scale
    return max(0.0, low), min(1.0, high)


def score_of(trials: Sequence[TrialStory], planned: int, last: str) -> Score:
    """Return the score of a run: aborted trials count as failures, as long as no device failed.

    Trials that a named device fault ended before the release are told after ``last`` instead.
    """
    done = [trial for trial in trials if trial.finished is not None]
    outcomes = tuple(t.finished.outcome for t in done if t.finished is not None)
    excuses = sorted({trial.excuse for trial in done} - {""})
    excused = sum(bool(trial.excuse) for trial in done)
    if excused:
        which = "1 trial that a device fault" if excused == 1 else f"{excused} that device faults"
        said = f"Not counted: {which} ended before the release ({', '.join(excuses)})."
        last = f"{last} {said}".strip()
    placed = sum(outcome is Outcome.PLACED for outcome in outcomes)
    interval = wilson(placed, len(outcomes) - excused)
    ended = [t.finished for t in done if t.finished is not None]
    void = tuple(
        f"Trial {one.trial}: {one.reason}" for one in ended if one.outcome is Outcome.ABORTED
    )
    return Score(outcomes, planned, interval, last, excused, void)

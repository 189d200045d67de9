"""Guard of a certificate: test that signals look like those that it was calibrated on.

The p-value of a trial is the rank of its score among those of the same piece, in the calibration
and in earlier trials: uniform or larger if all are exchangeable. A test martingale bets on small
ones (Vovk, Gammerman and Shafer, Algorithmic Learning in a Random World, 2nd edition, chapter 8).
By Ville's inequality it ever reaches ``ALARM`` with a probability of at most 1 / ``ALARM``. The
bets are power functions, the *simple mixture*, which starts again before every trial.
"""

from __future__ import annotations

import hashlib
import math
from bisect import bisect_left, insort
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from touchdown.backend.config import read_json_model
from touchdown.backend.core import DISK_TIMEOUT_S, InputError, blocking_section, write_atomically

ALARM = 20.0  # at most 5 % false alarms, over any number of trials
UNSEEN_SHARE = 0.01  # of the field energy, counts as much as inputs one standard deviation off
LARGEST_SCORE = 1e9  # also of signals that are not finite
MAX_BYTES, FIX = 5_000_000, "Move it away, or restore it from a copy."
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(64)
POWERS, SHARES = 0.5 * (_POINTS + 1.0), 0.5 * _WEIGHTS  # quadrature over the powers in (0, 1)
SIGNALS_ALIKE = "Signals look as in calibration"
SIGNALS_DIFFER = "Signals differ from calibration: each release is asked"


def signal_score(distances: tuple[float, float]) -> float:
    """Return the score of a trial from ``FusedForward.distances``."""
    score = distances[0] + distances[1] / UNSEEN_SHARE
    return min(score, LARGEST_SCORE) if math.isfinite(score) else LARGEST_SCORE


class PowerMartingale:
    """Mixture of power martingales over the power, and over the trial k before which it starts.

    The weight of a start is 1 / (k (k + 1)).
    """

    def __init__(self) -> None:
        self.trials: int = 0
        self._wealth = np.zeros(len(POWERS))

    @property
    def value(self) -> float:
        """Wealth after all trials, 1 at the start."""
        return float(self._wealth.sum()) + 1.0 / (self.trials + 1.0)

    def update(self, p_value: float) -> None:
        """Bet on the next p-value, in (0, 1]."""
        self.trials += 1
        begins = SHARES / (self.trials * (self.trials + 1.0))
        self._wealth = (self._wealth + begins) * POWERS * p_value ** (POWERS - 1.0)


class ScoreRanks:
    """p-values of scores; a piece without a calibration is compared with all pieces."""

    def __init__(self, calibration: Mapping[str, tuple[float, ...]]) -> None:
        self._known = {piece: sorted(scores) for piece, scores in calibration.items()}
        self._every = sorted(score for scores in calibration.values() for score in scores)

    def p_value(self, piece: str, score: float) -> float:
        """Return the p-value of the next score: ties count as larger, so it is conservative."""
        known = self._known.setdefault(piece, self._every.copy())
        above = len(known) - bisect_left(known, score)
        insort(known, score)
        return (1.0 + above) / len(known)


class _File(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class GuardCalibration(_File):
    """Scores of calibration trials on one bench, by piece."""

    bench: str
    bench_sha256: str
    code: str
    date: str
    scores: dict[str, tuple[float, ...]]


class GuardFile(_File):
    """Calibrations of one network, in a file beside its weights."""

    format: Literal["touchdown-guard/1"] = "touchdown-guard/1"
    weights_sha256: str
    benches: tuple[GuardCalibration, ...] = ()


class GuardState(_File):
    """State of a guard since the last of its ``resets`` (date, reason, discarded trials)."""

    format: Literal["touchdown-guard-state/1"] = "touchdown-guard-state/1"
    calibration_sha256: str
    observed: tuple[tuple[str, float], ...] = ()  # piece and score of each trial
    withdrawn: str = ""  # time of the alarm, "" without
    resets: tuple[tuple[str, str, int], ...] = ()


class Guard:
    """Guard of one network on one bench; ``path``: file of its state, None to keep it in memory.

    Another calibration restarts it, but an alarm stays until the reset. Raises
    ``InputError`` for a damaged file.
    """

    def __init__(self, calibration: GuardCalibration, path: Path | None = None) -> None:
        own = hashlib.sha256(calibration.model_dump_json().encode()).hexdigest()
        self._calibration, self._path = calibration, path
        self.state: GuardState = GuardState(calibration_sha256=own)
        if path is not None and path.is_file():
            self.state = read_json_model(GuardState, path, MAX_BYTES, FIX)
            if self.state.calibration_sha256 != own:
                self._change(calibration_sha256=own, observed=())
        self._replay()

    @property
    def withdrawn(self) -> bool:
        """True from the alarm to the reset."""
        return bool(self.state.withdrawn)

    def describe(self) -> str:
        """Return the state in words, with the date of the alarm or the number of trials."""
        if self.withdrawn:
            return f"{SIGNALS_DIFFER} (since {self.state.withdrawn[:10]})."
        count = len(self.state.observed)
        return f"{SIGNALS_ALIKE} ({count} trial{'s' * (count != 1)} compared)."

    def observe(self, piece: str, score: float) -> None:
        """Take the score of one trial."""
        self.martingale.update(self._ranks.p_value(piece, score))
        self._change(observed=(*self.state.observed, (piece, score)))
        if self.martingale.value >= ALARM and not self.withdrawn:
            self._change(withdrawn=_now())

    def reset(self, reason: str) -> None:
        """Restart and store the reason; raises ``InputError`` without one or if it fails."""
        if not reason.strip():
            raise InputError("A reset needs a reason.", "guard", "Name what was calibrated.")
        before = self.state
        done = (_now(), reason.strip(), len(before.observed))
        self._change(observed=(), withdrawn="", resets=(*before.resets, done))
        if problem := self.save():
            self.state = before
            raise InputError(problem, str(self._path), "Make room there; nothing was reset.")
        self._replay()

    def save(self) -> str:
        """Write the state; return "", or why it is not kept."""
        try:
            with blocking_section("waits for the disk", DISK_TIMEOUT_S):
                if self._path is not None:
                    write_atomically(self._path, self.state.model_dump_json().encode())
        except OSError as error:
            return f"The state of the guard cannot be written: {error.strerror or error}."
        return ""

    def _change(self, **values: object) -> None:
        self.state = self.state.model_copy(update=values)

    def _replay(self) -> None:
        self.martingale: PowerMartingale = PowerMartingale()
        self._ranks = ScoreRanks(self._calibration.scores)
        for piece, score in self.state.observed:
            self.martingale.update(self._ranks.p_value(piece, score))


def guard_path(weights: Path) -> Path:
    """Return the file of the calibrations of a network."""
    return weights.with_suffix(".guard.json")


def open_guard(weights: Path, weights_sha256: str, bench_sha256: str, states: Path) -> Guard | None:
    """Return the guard of a network on a bench, None if it was not calibrated there.

    ``states``: folder of the states. Raises ``InputError`` for a damaged file.
    """
    path = guard_path(weights)
    found = GuardFile(weights_sha256=weights_sha256)
    if path.is_file():
        found = read_json_model(GuardFile, path, MAX_BYTES, FIX)
    if found.weights_sha256 != weights_sha256:
        what = "The calibration of the guard is that of another network."
        raise InputError(what, str(path), "Calibrate it again.")
    for calibration in found.benches:
        if calibration.bench_sha256 == bench_sha256:
            name = f"{calibration.bench}-{bench_sha256[:12]}-{weights_sha256[:12]}.json"
            return Guard(calibration, states / name)
    return None


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="seconds")

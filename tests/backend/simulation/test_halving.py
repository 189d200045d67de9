"""Step halving: each probe gets the result of a search on its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from touchdown.backend.core.values import FloatArray
from touchdown.backend.simulation.contact import TRIALS_PER_CALL, halve_steps

MOST = 12


@dataclass(frozen=True)
class Place:
    """A position on a line, and its distance from the nearer of two minima."""

    x: FloatArray
    size: FloatArray

    @classmethod
    def at(cls, x: FloatArray) -> Place:
        return cls(x, np.minimum(np.abs(x), np.abs(x - 7.0) + 0.5))

    def take(self, rows: np.ndarray) -> Place:
        return Place(self.x[rows], self.size[rows])

    def put(self, rows: np.ndarray, by: Place) -> None:
        self.x[rows], self.size[rows] = by.x, by.size


def alone(x: float, step: float) -> float:
    """Return the result of one probe on its own."""
    before = Place.at(np.array([x])).size[0]
    for k in range(MOST):
        tried = x + step * 0.5**k
        if Place.at(np.array([tried])).size[0] < before:
            break
    return tried


@pytest.mark.parametrize("count", [1, 5, TRIALS_PER_CALL + 1])
def test_every_probe_goes_where_it_would_go_alone(count: int) -> None:
    rng = np.random.default_rng(count)
    x = rng.uniform(-3.0, 10.0, count)
    # Some steps overshoot once, some need many halvings, and every third one leads uphill.
    step = np.where(np.arange(count) % 3 == 2, np.sign(x), -x) * rng.uniform(0.5, 300.0, count)
    start, after, asked = Place.at(x), Place.at(x + step), []

    def at(rows: np.ndarray, share: FloatArray) -> Place:
        asked.append(len(rows))
        return Place.at(x[rows] + share * step[rows])

    worse = np.flatnonzero(~(after.size < start.size))
    halve_steps(after, start.size, worse, MOST, at)
    assert after.x.tolist() == [alone(a, s) for a, s in zip(x, step, strict=True)]
    assert max(asked, default=0) <= max(TRIALS_PER_CALL, len(worse))
    assert len(asked) < MOST or count > TRIALS_PER_CALL


def test_nothing_is_tried_where_all_fell() -> None:
    start, after = Place.at(np.array([4.0])), Place.at(np.array([1.0]))
    halve_steps(
        after, start.size, np.array([], dtype=np.intp), MOST, lambda *_: pytest.fail("tried")
    )
    assert after.x.tolist() == [1.0]

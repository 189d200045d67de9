"""Step halving of a batch: each probe for itself takes the first share of its step that helps.

A probe whose step cannot lower its residual would be tried a dozen times while all others wait.
So the others are not tried again, and of the few that are left several halvings are tried at once:
which one is taken does not depend on how many are tried together.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

AT_ONCE = 48
"""So many trials are worth one call: below that its fixed cost outweighs what it computes."""


class Tried(Protocol):
    """Trial solutions of B probes, each with its own ``size`` (B,) of what is missing."""

    @property
    def size(self) -> FloatArray:
        """(B,) residual."""

    def take(self, rows: NDArray[np.intp], /) -> Self:
        """Return the trials ``rows``."""

    def put(self, rows: NDArray[np.intp], by: Self, /) -> None:
        """Overwrite the trials ``rows``."""


Some = TypeVar("Some", bound=Tried)


def fall(
    now: Some,
    before: FloatArray,
    rows: NDArray[np.intp],
    most: int,
    at: Callable[[NDArray[np.intp], FloatArray], Some],
) -> None:
    """Replace in ``now`` what full steps gave for ``rows``, none of which lowered its residual.

    ``before`` (B,): residuals to fall below. ``at``: tries shares (k,) of the steps of the probes
    (k,). Steps are tried ``most`` times, the full one included; where even the last is no better
    that one stays.
    """
    done = 1
    while len(rows) and done < most:
        count = min(most - done, max(1, AT_ONCE // len(rows)))
        each = np.repeat(rows, count)
        tried = at(each, np.tile(0.5 ** np.arange(done, done + count), len(rows)))
        better = (tried.size < before[each]).reshape(-1, count)
        fell = better.any(axis=1)
        first = np.where(fell, better.argmax(axis=1), count - 1)
        now.put(rows, tried.take(first + count * np.arange(len(rows))))
        rows = rows[~fell]
        done += count

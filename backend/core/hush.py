"""A short time in which nothing that can wait is done beside a decision."""

from __future__ import annotations

import time
from collections.abc import Callable


class Hush:
    """Asked for by whoever decides, heeded by whoever draws; it ends by itself.

    A decision is some hundred short library calls, each of which lets go of the interpreter. A
    window that draws meanwhile keeps it for up to a millisecond each time: 6 ms become 40.
    """

    def __init__(self, now_s: Callable[[], float] = time.perf_counter) -> None:
        self._now_s, self._until_s = now_s, float("-inf")

    @property
    def on(self) -> bool:
        """Whether a decision is due now."""
        return self._now_s() < self._until_s

    def begin(self, longest_s: float) -> None:
        """Ask for quiet from now on, for ``longest_s`` at most."""
        self._until_s = self._now_s() + longest_s

    def end(self) -> None:
        """End it: the decision is made."""
        self._until_s = float("-inf")

"""One run read beside the window: a journal of a day's trials holds up nobody."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from app.review.collection import Collection, collection_of
from app.review.timed import TimedTrial, trials_of
from app.run_story import RunStory
from backend.core.facts import Fact
from backend.runs.journal import journal_path, read_journal

LONG_S = 0.3
"""A reading that takes longer says how far it is."""
BLOCK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class ReadRun:
    """A run as its journal tells it; ``collection`` if it collected, else its ``trials``."""

    folder: Path
    story: RunStory
    collection: Collection | None
    trials: list[TimedTrial]


class Reading:
    """One look at one journal. ``read`` is called on another thread, all else on the window's."""

    def __init__(self, run: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self._run, self._now_s, self._begun_s = run, now_s, now_s()
        self._share = 0.0
        self._dropped = False

    def read(self) -> ReadRun | None:
        """Return the run, None if it was dropped; raises ``InputError`` or ``OSError``."""
        lines = _lines(journal_path(self._run))
        story, facts = RunStory(of_any=True), list[Fact]()
        for fact in read_journal(self._run):
            if self._dropped:
                return None
            story.take(fact)
            facts.append(fact)
            self._share = min(1.0, len(facts) / lines)
        collection = collection_of(facts)
        trials = [] if collection is not None else trials_of(facts)
        return ReadRun(self._run, story, collection, trials)

    def drop(self) -> None:
        """Nobody waits for it any more: it ends with the line that is being read."""
        self._dropped = True

    def progress(self) -> str:
        """Return how far it is and how long it still takes; "" while nobody would ask."""
        taken_s, share = self._now_s() - self._begun_s, self._share
        if taken_s < LONG_S:
            return ""
        left = f", {taken_s * (1.0 / share - 1.0):.0f} s left" if share > 0.0 else ""
        return f"{100.0 * share:.0f} % read{left}"


def _lines(journal: Path) -> int:
    """Return how many lines a journal has, one at least."""
    with journal.open("rb") as file:
        blocks = iter(lambda: file.read(BLOCK_BYTES), b"")
        return max(1, sum(block.count(b"\n") for block in blocks))

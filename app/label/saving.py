"""What is saved, what is being saved, and what could not be: the next step waits for it.

Whatever is asked for while a save is under way is done after it, in the order in which it was
asked: keys are never lost and never overtake each other. A dataset that another program holds is
waited for; what waits meanwhile is counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from app.label.commits import Commits
from backend.core.faults import FaultError, RefusedError, TouchdownError

LOCKED = "CATALOGUE-BUSY"
"""Code of the fault that another program writes to the dataset."""
Intent = Callable[[], None]
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Trouble:
    """A save that failed: ``what`` happened in words, and how to try again."""

    what: str
    again: Intent


class Saving:
    """Orders saves and intents. ``refused`` gets the reason where a change is not allowed."""

    def __init__(
        self, commits: Commits, refused: Callable[[str], None], changed: Callable[[], None]
    ) -> None:
        self._commits, self._refused, self._changed = commits, refused, changed
        self._intents: deque[Intent] = deque()
        self._draining = self._held = self._locked = False
        self.trouble: Trouble | None = None
        commits.told = self._drain

    @property
    def busy(self) -> bool:
        """Whether a save is under way, or the present episode is not there yet."""
        return self._held or self._commits.busy

    @property
    def waiting(self) -> int:
        """How many actions wait until another program lets go of the dataset."""
        return 1 + len(self._intents) if self._locked else 0

    def hold(self, held: bool) -> None:
        """Let intents wait while the next episode is still being read."""
        self._held = held

    def go_on(self) -> None:
        """Do what waited, if nothing is in the way any more."""
        self._drain()

    def after(self, intent: Intent) -> None:
        """Do ``intent`` now, or after the saves that are under way."""
        self._intents.append(intent)
        self._drain()
        if self._locked:
            self._changed()

    def save(self, work: Callable[[], Result], done: Callable[[Result], None]) -> None:
        """Have ``work`` done on the thread of the saves; ``done`` follows if it succeeded."""

        def succeeded(result: Result) -> None:
            self.trouble, self._locked = None, False
            done(result)
            self._changed()

        def failed(error: Exception) -> None:
            self._locked = isinstance(error, FaultError) and error.fault.code == LOCKED
            if self._locked:
                # The next try waits for the lock as long as this one did: no wait of our own.
                self._commits.submit(work, succeeded, failed)
                self._changed()
                return
            self._intents.clear()
            if isinstance(error, RefusedError):
                self._refused(error.detail)
            else:
                self.trouble = Trouble(_words(error), lambda: self.save(work, done))
            self._changed()

        self._commits.submit(work, succeeded, failed)
        self._changed()

    def try_again(self) -> None:
        """Save once more what could not be saved."""
        trouble, self.trouble = self.trouble, None
        if trouble is not None:
            trouble.again()

    def discard(self) -> None:
        """Give up what could not be saved."""
        self.trouble = None
        self._changed()

    def _drain(self) -> None:
        if self._draining:
            return
        self._draining = True
        try:
            while self._intents and not self.busy:
                self._intents.popleft()()
        finally:
            self._draining = False


def _words(error: Exception) -> str:
    if isinstance(error, FaultError):
        return f"{error.fault.what} {error.fault.next_step}"
    return str(error) if isinstance(error, TouchdownError) else f"{type(error).__name__}: {error}"

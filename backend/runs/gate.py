"""Where a run waits for the operator: approve each action, or one step at a time."""

from __future__ import annotations

import threading

from backend.core.facts import Decision
from backend.core.flow import Outcome


class Decisions:
    """Holds the latest decision about the latest episode, whether it was asked for or not."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._decision: Decision | None = None

    @property
    def given(self) -> bool:
        """Whether a decision waits to be carried out."""
        return self._decision is not None

    def give(self, decision: Decision) -> None:
        """Decide; a later word replaces an earlier one that was not carried out yet."""
        with self._lock:
            self._decision = decision

    def take(self) -> Decision | None:
        """Return the decision, if there is one, and forget it."""
        with self._lock:
            decision, self._decision = self._decision, None
            return decision


class Gate:
    """Holds one answer. The plan asks and looks; the operator answers from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._asked = False
        self._answer: bool | None = None
        self._seen: tuple[Outcome, str] | None = None

    def ask(self) -> None:
        """Forget an old answer and wait for a new one."""
        with self._lock:
            self._asked, self._answer, self._seen = True, None, None

    def answer(self, yes: bool) -> None:
        """Answer the open question; without one this does nothing."""
        with self._lock:
            if self._asked:
                self._asked, self._answer = False, yes

    def see(self, outcome: Outcome, reason: str) -> None:
        """Say what became of a piece; without an open question this does nothing."""
        with self._lock:
            if self._asked:
                self._asked, self._seen = False, (outcome, reason)

    @property
    def seen(self) -> tuple[Outcome, str] | None:
        """What the operator saw, and the reason they gave; None before they said it."""
        return self._seen

    @property
    def answered(self) -> bool:
        """Whether the last question has an answer."""
        return self._answer is not None

    @property
    def yes(self) -> bool:
        """Whether the answer was yes."""
        return self._answer is True

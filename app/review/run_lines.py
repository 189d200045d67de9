"""One line about a recorded run for the list of runs, read without decoding its maps."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from backend.core.facts import RunFinished, RunStarted, TrialFinished
from backend.core.faults import InputError
from backend.core.flow import Outcome
from backend.runs.fact_codec import decode
from backend.runs.journal import journal_path
from widgets.score_panel import WORDS

_STARTS = tuple(
    f'{{"kind":"{kind.__name__}",'.encode() for kind in (RunStarted, TrialFinished, RunFinished)
)
"""How the journal begins the few lines that matter here; all others are passed over unread."""

ACTIVITIES = {"collect": "collecting", "probe": "single probe"}
"""Runs of the bench that have no trials, by what they were for."""


@dataclass(frozen=True, slots=True)
class RunLine:
    """What the list says of a run: its beginning, the outcomes so far, its end if it came."""

    head: RunStarted | None = None
    outcomes: tuple[Outcome, ...] = ()
    ended: RunFinished | None = None

    def text(self) -> str:
        """Return piece, bottom and outcomes in words."""
        if self.head is None:
            return "nothing recorded"
        said = _counted(self.outcomes) or activity_words(self.head)
        if self.ended is None:
            said.append("not finished")
        elif self.ended.ending != "finished":
            said.append(f"run {self.ended.ending}")
        return f"{self.head.piece} on {self.head.bottom}: {', '.join(said) or 'no trial'}"


def read_run_line(run: Path) -> RunLine:
    """Read what the list says of ``run``; raises ``InputError`` or ``OSError``.

    A torn last line ends the journal quietly, as it does in ``read_journal``.
    """
    head: RunStarted | None = None
    ended: RunFinished | None = None
    outcomes: list[Outcome] = []
    path = journal_path(run)
    with path.open("rb") as file:
        for number, raw in enumerate(file, start=1):
            if not raw.startswith(_STARTS) or not raw.endswith(b"\n"):
                continue
            where = f"{path}, line {number}"
            try:
                fact = decode(json.loads(raw), where)
            except ValueError as error:
                raise InputError("A line is not valid JSON.", where, "Open the run.") from error
            if isinstance(fact, RunStarted):
                head = fact
            elif isinstance(fact, TrialFinished):
                outcomes.append(fact.outcome)
            elif isinstance(fact, RunFinished):
                ended = fact
    return RunLine(head, tuple(outcomes), ended)


def activity_words(head: RunStarted) -> list[str]:
    """Return what a run without trials was for; nothing for one that stacks."""
    return [] if head.activity == "stack" else [ACTIVITIES.get(head.activity, head.activity)]


def _counted(outcomes: tuple[Outcome, ...]) -> list[str]:
    """Return the single outcome, or how often there was each."""
    if len(outcomes) == 1:
        return [WORDS[outcomes[0]]]
    return [f"{count} {WORDS[outcome]}" for outcome, count in Counter(outcomes).most_common()]

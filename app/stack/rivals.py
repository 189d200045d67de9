"""The stacking runs of this session by what they were asked, so that strategies can be compared."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from typing import get_args

from app.run_story import RunStory
from backend.core.facts import Fact, RunStarted, TrialFinished
from backend.runs.requests import StackRequest, Strategy

MOST = 4
"""So many questions are kept, with the last belief map of each trial."""
Asked = tuple[str, str, int, int]
"""Piece, bottoms joined by "+", seed, trials: all but the strategy."""


def asked(request: StackRequest) -> Asked:
    """Return what a request asks, whichever the strategy."""
    return request.piece, "+".join(request.bottoms), request.seed, request.trials


def strategy_of(name: str) -> Strategy | None:
    """Return the strategy of this name; None if there is none."""
    names: tuple[Strategy, ...] = get_args(Strategy)
    return next((known for known in names if known == name), None)


class Rivals:
    """Keeps one story per question and strategy: the newest."""

    def __init__(self) -> None:
        self._stories: OrderedDict[Asked, dict[Strategy, RunStory]] = OrderedDict()
        self._present: RunStory | None = None

    def take(self, fact: Fact) -> None:
        """Take the next fact."""
        if isinstance(fact, RunStarted):
            self._begin(fact)
        if self._present is not None:
            self._present.take(fact)
            if isinstance(fact, TrialFinished) and self._present.trial is not None:
                # The maps before the last are the story of another view, and 40 kB each.
                probes = self._present.trial.probes
                probes[:-1] = [replace(look, belief=None) for look in probes[:-1]]

    def story(self, question: Asked, strategy: Strategy) -> RunStory | None:
        """Return the newest run of a strategy, also one in progress; None if there was none."""
        return self._stories.get(question, {}).get(strategy)

    def _begin(self, head: RunStarted) -> None:
        self._present = None
        strategy = strategy_of(head.strategy)
        if head.activity != "stack" or strategy is None:
            return
        question = head.piece, head.bottom, head.seed, head.trials
        self._present = RunStory()
        self._stories.setdefault(question, {})[strategy] = self._present
        self._stories.move_to_end(question)
        while len(self._stories) > MOST:
            self._stories.popitem(last=False)

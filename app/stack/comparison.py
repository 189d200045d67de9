"""Comparison of strategies on one seed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import get_args

from PySide6.QtWidgets import QWidget

from touchdown.app.shell import (
    RunStory,
    TrialStory,
    belief_scene,
    face_outlines,
    is_run_active,
    run_score,
    start_obstacle,
    tower_text,
)
from touchdown.backend.bench import Session
from touchdown.backend.core import Event, Outcome, RunStarted, TrialFinished
from touchdown.backend.experiments import sequential_decision
from touchdown.backend.runs import StackRequest, StrategyChoice
from touchdown.widgets import views
from touchdown.widgets.base import Theme, count_noun, tr
from touchdown.widgets.forms import STRATEGIES

MAX_QUESTIONS = 4  # number of kept questions, with the last belief map of each trial
# Piece, bottoms joined by "+", seed, trials: everything but the strategy.
StackQuestion = tuple[str, str, int, int]


def stack_question(request: StackRequest) -> StackQuestion:
    """Return the question of a request, without its strategy."""
    return request.piece, "+".join(request.bottoms), request.seed, request.trials


def strategy_by_name(name: str) -> StrategyChoice | None:
    """Return the strategy with this name, None without one."""
    names: tuple[StrategyChoice, ...] = get_args(StrategyChoice)
    return next((known for known in names if known == name), None)


class StrategyRuns:
    """Keeps the newest run of each strategy by question."""

    def __init__(self) -> None:
        self._stories: OrderedDict[StackQuestion, dict[StrategyChoice, RunStory]] = OrderedDict()
        self._present: RunStory | None = None

    def take(self, event: Event) -> None:
        """Add the next event."""
        if isinstance(event, RunStarted):
            self._begin(event)
        if self._present is not None:
            self._present.take(event)
            if isinstance(event, TrialFinished) and self._present.trial is not None:
                # Keep only the last map: each takes 40 kB.
                probes = self._present.trial.probes
                probes[:-1] = [replace(look, belief=None) for look in probes[:-1]]

    def story(self, question: StackQuestion, strategy: StrategyChoice) -> RunStory | None:
        """Return the newest run of a strategy, None if there was none."""
        return self._stories.get(question, {}).get(strategy)

    def _begin(self, head: RunStarted) -> None:
        self._present = None
        strategy = strategy_by_name(head.strategy)
        if head.activity != "stack" or strategy is None:
            return
        question = head.piece, head.bottom, head.seed, head.trials
        self._present = RunStory()
        self._stories.setdefault(question, {})[strategy] = self._present
        self._stories.move_to_end(question)
        while len(self._stories) > MAX_QUESTIONS:
            self._stories.popitem(last=False)


BLIND: StrategyChoice = "pick-and-place"
NOT_RUN = views.BeliefScene(empty=("Not run yet", "Run it with the same seed."))
NO_MAP = views.BeliefScene(empty=("No belief", "This strategy releases without a probe."))


class ComparisonPresenter:
    """Compares strategies. ``request`` returns the request of the form; ``start`` starts a run."""

    def __init__(
        self,
        bench: Session,
        theme: Theme,
        request: Callable[[], StackRequest],
        start: Callable[[StackRequest], bool],
    ) -> None:
        self._bench, self._theme, self._request, self._start = bench, theme, request, start
        self._rivals = StrategyRuns()
        self._question: StackRequest | None = None
        self._pair: tuple[StrategyChoice, StrategyChoice] = ("paper", BLIND)
        self._waiting: list[StrategyChoice] = []
        self._drawn: tuple[object, ...] = ()
        self.sheet: views.ComparisonSheet | None = None

    def take(self, event: Event) -> None:
        """Follow all runs, also while the sheet is closed."""
        self._rivals.take(event)

    def open(self, window: QWidget) -> None:
        """Compare the strategies for the request of the form."""
        if self.sheet is None:
            self.sheet = views.ComparisonSheet(
                window, self._theme, self.run_missing, self._choose, self._compare_with
            )
        if not self._waiting:
            self._question = self._request()
            left_out = {"paper"} if self._bench.simulated else {"paper", BLIND}
            rivals = [(key, title) for key, title in STRATEGIES if key not in left_out]
            chosen = self._question.strategy
            self._pair = "paper", BLIND if chosen == "paper" else chosen
            if self._pair[1] not in dict(rivals):
                self._pair = "paper", strategy_by_name(rivals[0][0]) or "paper"
            self.sheet.offer(rivals, self._pair[1])
        self._drawn = ()
        self.sheet.open_large()
        self.draw()

    def run_missing(self) -> None:
        """Run each strategy that has no result yet, one after the other."""
        if self._question is not None and not self._waiting and not is_run_active(self._bench):
            missing = self._missing(self._question)
            self._waiting = missing or list(self._pair)
            self._next()

    def draw(self) -> None:
        """Start the next strategy and update the sheet."""
        if self._waiting and not is_run_active(self._bench):
            self._next()
        if self.sheet is None or not self.sheet.isVisible() or self._question is None:
            return
        question = stack_question(self._question)
        stories = [self._rivals.story(question, strategy) for strategy in self._pair]
        versions = tuple(None if story is None else story.version for story in stories)
        active = is_run_active(self._bench)
        trial, latched = self.sheet.trial.value(), self._bench.interlock.latched
        drawn = question, self._pair, versions, trial, active, latched
        if drawn == self._drawn:
            return
        self._drawn = drawn
        self._show(self.sheet, question, stories, active=active)

    # -- inside -----------------------------------------------------------------------------------

    def _next(self) -> None:
        """Start the next strategy; a run that did not finish ends the series."""
        assert self._question is not None
        question = stack_question(self._question)
        before = [s for s in self._pair if s not in self._waiting]
        last = self._rivals.story(question, before[-1]) if before else None
        if last is not None and last.ended is None:
            return
        if last is not None and not _answered(last):
            self._waiting = []
            return
        strategy = self._waiting.pop(0)
        if not self._start(replace(self._question, strategy=strategy)):
            self._waiting = []

    def _missing(self, request: StackRequest) -> list[StrategyChoice]:
        return [
            s for s in self._pair if not _answered(self._rivals.story(stack_question(request), s))
        ]

    def _show(
        self,
        sheet: views.ComparisonSheet,
        question: StackQuestion,
        stories: list[RunStory | None],
        *,
        active: bool,
    ) -> None:
        assert self._question is not None
        piece, bottom, seed, trials = question
        pair = tower_text(piece, *bottom.split("+"))
        sheet.head.setText(tr("{}, seed {}, {}", pair, seed, count_noun(trials, "trial")))
        sheet.trial.setRange(1, trials)
        at, titles = sheet.trial.value() - 1, dict(STRATEGIES)
        sheet.against.setEnabled(not active)
        for panel, strategy, story in zip(sheet.panels, self._pair, stories, strict=True):
            panel.show_look(self._look(tr(titles[strategy]), story, trials, at))
        missing = self._missing(self._question)
        sheet.show_pairs(paired_text([tr(titles[name]) for name in self._pair], stories))
        text = "" if active else "Run both" if len(missing) == 2 else "Run the other one"
        if not missing:
            text = "" if active else "Run both again"
        sheet.show_run(text, "" if active else start_obstacle(self._bench))

    def _look(
        self, title: str, story: RunStory | None, trials: int, at: int
    ) -> views.StrategyResult:
        if story is None:
            return views.StrategyResult(title, trials=trials, scene=NOT_RUN)
        score = run_score(story.trials, trials, "")
        placed = sum(outcome is Outcome.PLACED for outcome in story.outcomes)
        count, rate = tr("{} of {} placed", placed, score.counted), views.success_rate_text(score)
        if at >= len(story.trials):
            return views.StrategyResult(title, story.outcomes, trials, count, rate)
        trial = story.trials[at]
        words, good = _words(trial)
        return views.StrategyResult(
            title, story.outcomes, trials, count, rate, words, good, self._scene(story, trial)
        )

    def _scene(self, story: RunStory, trial: TrialStory) -> views.BeliefScene:
        felt = [k for k, look in enumerate(trial.probes) if look.belief is not None]
        if not felt:
            return NO_MAP
        return belief_scene(trial, felt[-1], *face_outlines(self._bench.catalogue, story.head))

    def _compare_with(self, name: str) -> None:
        """Show another strategy on the right, with its result of this session."""
        rival = strategy_by_name(name)
        if rival is not None and not self._waiting:
            self._pair = self._pair[0], rival
            self.draw()

    def _choose(self, _trial: int) -> None:
        self._drawn = ()
        self.draw()


def paired_text(titles: Sequence[str], stories: Sequence[RunStory | None]) -> str:
    """Return what the trials on equal seeds decide so far, "" before the first pair."""
    ends = [[t.finished for t in story.trials] for story in stories if story is not None]
    pairs = list(zip(*ends, strict=False)) if len(ends) == len(titles) == 2 else []
    placed = [tuple(end.outcome is Outcome.PLACED for end in pair if end) for pair in pairs]
    counted = [pair for pair in placed if len(pair) == 2]
    if not counted:
        return ""
    only = counted.count((True, False)), counted.count((False, True))
    counts = (word for title, count in zip(titles, only, strict=True) for word in (title, count))
    text = tr("Placed by {} alone: {}, by {} alone: {}, of {}.",
              *counts, count_noun(len(counted), "pair"))  # fmt: skip
    better = {"more": titles[0], "less": titles[1], None: ""}[sequential_decision(*only)]
    if better:
        return f"{text} {tr('{} places more often (error at most 5 %).', better)}"
    return f"{text} {tr('Undecided; more trials may follow.')}"


def _answered(story: RunStory | None) -> bool:
    return story is not None and story.ended is not None and story.ended.ending == "finished"


def _words(trial: TrialStory) -> tuple[str, bool | None]:
    """Return the result of a trial and if it is good (None while it continues)."""
    done = trial.finished
    if done is None:
        return f"{tr(trial.phase or 'begun')} \N{HORIZONTAL ELLIPSIS}", None
    probes = count_noun(done.probes, "probe")
    good = done.outcome is Outcome.PLACED
    word = tr(views.OUTCOME_WORDS[done.outcome]).capitalize()
    return f"{tr('{} after {}.', word, probes)} {done.reason}", good

"""Stack workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, fields, replace
from functools import partial

from touchdown.app.shell import (
    LivePresenter,
    LiveViews,
    Memory,
    WindowCommand,
    Workspace,
    WorkspaceContext,
)
from touchdown.app.stack.attended import OperatorPromptsPresenter
from touchdown.app.stack.comparison import ComparisonPresenter
from touchdown.app.stack.page import StackPage
from touchdown.app.stack.presenter import StackPresenter, stack_request
from touchdown.app.stack.side import SideViewPresenter
from touchdown.backend.bench import Session
from touchdown.backend.core import Event, Outcome
from touchdown.backend.runs import SceneChoice
from touchdown.widgets.forms import RunForm
from touchdown.widgets.views import NOTHING_YET


def remembered_run_form(memory: Mapping[str, object]) -> tuple[RunForm, list[str]]:
    """Return (form, names of what made no sense); those fields get their defaults."""
    default, known, dropped = RunForm(), {}, []
    for entry in fields(RunForm):
        value = memory.get(entry.name, getattr(default, entry.name))
        if type(value) is type(getattr(default, entry.name)):
            known[entry.name] = value
        else:
            dropped.append(entry.name)
    return RunForm(**known), dropped  # type: ignore[arg-type]


def careful_form(form: RunForm, on_bench: SceneChoice) -> RunForm:
    """Return the form for devices: asked before each move, and nothing let go untested.

    It begins with what is ``on_bench``, whatever was filled in for another one.
    """
    mode = "approve" if form.mode == "auto" else form.mode
    strategy = "paper" if form.strategy == "pick-and-place" else form.strategy
    *under, bottom = on_bench.bottoms
    stands = replace(form, piece=on_bench.piece, bottom=bottom, under="".join(under[:1]))
    return replace(stands, mode=mode, strategy=strategy)


SEEN = (
    ("stands", "It stands", "1", Outcome.PLACED),
    ("fell", "It fell", "2", Outcome.FELL),
    ("disturbed", "The bottom was disturbed", "3", Outcome.KNOCKED_OVER),
    ("void", "The trial is void, for the reason that is written", "4", Outcome.ABORTED),
)
"""What an operator may have seen after a release on devices: command, text, key, outcome."""


class StackWorkspace(Workspace):
    """Fingers, traces, belief, decision, score; one run at a time."""

    name, title, key = "stack", "Stack", "Ctrl+4"
    page: StackPage

    def __init__(self, desk: WorkspaceContext) -> None:
        self._desk = desk
        self.live: LivePresenter | None = None
        self.presenter: StackPresenter | None = None
        self.side: SideViewPresenter | None = None
        self.comparison: ComparisonPresenter | None = None
        self.attended: OperatorPromptsPresenter | None = None
        self._form = RunForm()
        self.commands = (
            WindowCommand("start", "Start stacking", "Ctrl+Return", self._start),
            WindowCommand("step", "Next step: carry out the move that waits", "N", self._approve),
            WindowCommand("approve", "Approve the move that waits", "A", self._approve),
            WindowCommand("pause", "Pause or resume", "P", self._pause),
            WindowCommand("compare", "Compare the strategies on the same seed", "Ctrl+D", self._compare),
            WindowCommand("confirm", "Yes: the scene is set, the hand is there, as proposed", "Y",
                    lambda: self._on_trial(OperatorPromptsPresenter.confirm)),
            *(
                WindowCommand(name, text, key, partial(self._see, outcome))
                for name, text, key, outcome in SEEN
            ),
            WindowCommand("photo", "Add a picture of this trial", "", self._photo),
            WindowCommand("fit", "Fit the force and moment ranges", "Ctrl+F",
                    lambda: self.page.fit()),
        )  # fmt: skip

    def build(self) -> Iterator[None]:
        """Make the page."""
        self.page = page = StackPage(self._desk.theme)
        page.start_requested.connect(self._start)
        page.pause_requested.connect(self._pause)
        page.cancel_requested.connect(self._cancel)
        page.approved.connect(self._approve)
        page.declined.connect(self._decline)
        page.probe_chosen.connect(self._choose)
        page.compare_requested.connect(self._compare)
        page.trial.answered.connect(self._answer)
        page.trial.judged.connect(self._judge)
        page.trial.photo_requested.connect(self._photo)
        yield
        self.columns = self.pieces = page.columns

    def attach(self, bench: Session) -> None:
        """Show this bench."""
        page, shown = self.page, bench.catalogue
        views = LiveViews(page.tactile, page.tactile_panels, page.force, page.moment)
        self.live = LivePresenter(bench, views)
        self.presenter = StackPresenter(bench, page, self._desk.cards)
        self.side = SideViewPresenter(bench, page.side, page.side_panel)
        self.attended = OperatorPromptsPresenter(bench, page, self._desk.cards)
        self.comparison = ComparisonPresenter(
            bench, self._desk.theme, lambda: stack_request(page.run.form()), self.presenter.begin
        )
        page.run.show_catalogue(
            [(name, shown.piece(name).title) for name in shown.tops],
            [(name, shown.piece(name).title) for name in shown.bottoms],
        )
        page.run.show_devices(not bench.simulated)
        page.run.show_form(self._form if bench.simulated else careful_form(self._form, bench.usual))
        page.decision.show_text(NOTHING_YET)
        self.presenter.show_model()
        page.run.chosen.connect(self.presenter.show_model)
        self.parts = (
            self.live.draw_left, self.live.draw_right, self.live.draw_wrench,
            self.live.draw_headers, self.presenter.draw, self.side.draw,
            self.comparison.draw,
        )  # fmt: skip

    def enter(self) -> None:
        """Another model may have been put in use meanwhile."""
        if self.presenter is not None:
            self.presenter.show_model()

    def take(self, fact: Event) -> None:
        """Follow the run, whichever page is in front."""
        if self.presenter is not None and self.side is not None:
            self.presenter.take(fact)
            self.side.take(fact)
        if self.comparison is not None:
            self.comparison.take(fact)
        if self.attended is not None:
            self.attended.take(fact)

    def close(self) -> None:
        """End the thread that keeps pictures."""
        if self.attended is not None:
            self.attended.close()

    def show_waiting(self, word: str, why: str) -> None:
        """Say why there is no bench yet."""
        self.page.show_waiting(word, why)

    def fit_to_theme(self) -> None:
        """Take sizes and icons of the theme."""
        self.page.fit_to_theme()
        self.page.run.draw_icons()

    def memory(self) -> Memory:
        """Return the form; without a bench it was never filled in: then what was remembered."""
        return asdict(self._form if self.presenter is None else self.page.run.form())

    def recall(self, memory: Memory) -> Sequence[str]:
        """Fill in the remembered form."""
        self._form, dropped = remembered_run_form(memory)
        self.page.run.show_form(self._form)
        return dropped

    # -- orders -----------------------------------------------------------------------------------

    def _start(self) -> None:
        if self.presenter is not None:
            # A crash must not turn a careful mode into the automatic one at the next start.
            self._desk.remember()
            self.presenter.start()

    def _pause(self) -> None:
        if self.presenter is not None:
            self.presenter.pause_or_resume()

    def _cancel(self) -> None:
        if self.presenter is not None:
            self.presenter.cancel()

    def _approve(self) -> None:
        if self.presenter is not None:
            self.presenter.approve()

    def _decline(self) -> None:
        if self.presenter is not None:
            self.presenter.decline()

    def _compare(self) -> None:
        if self.comparison is not None:
            self.comparison.open(self.page.window())

    def _on_trial(self, order: Callable[[OperatorPromptsPresenter], None]) -> None:
        if self.attended is not None:
            order(self.attended)

    def _answer(self, yes: bool) -> None:
        self._on_trial(lambda trial: trial.answer(yes))

    def _see(self, outcome: Outcome) -> None:
        self._on_trial(lambda trial: trial.see(outcome))

    def _judge(self, outcome: Outcome, reason: str) -> None:
        self._on_trial(lambda trial: trial.judge(outcome, reason))

    def _photo(self) -> None:
        self._on_trial(OperatorPromptsPresenter.ask_photo)

    def _choose(self, index: int) -> None:
        if self.presenter is not None:
            self.presenter.choose(index)

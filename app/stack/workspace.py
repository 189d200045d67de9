"""Stack workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

from touchdown.app import shell
from touchdown.app.stack.attended import OperatorPromptsPresenter
from touchdown.app.stack.comparison import ComparisonPresenter
from touchdown.app.stack.page import StackPage
from touchdown.app.stack.planned import PlannedRun, PlannedRunsSheet
from touchdown.app.stack.presenter import StackPresenter, stack_request
from touchdown.backend.bench import Session
from touchdown.backend.core import Event, Outcome
from touchdown.backend.geometry import PIECE_SOURCES, PieceLibrary, load_pieces
from touchdown.backend.runs import BOOKMARKS_NAME, Bookmark, SceneChoice
from touchdown.widgets.base import tr
from touchdown.widgets.forms import RunForm
from touchdown.widgets.views import NO_DECISION

if TYPE_CHECKING:
    from touchdown.app.stack.piece_import import PieceSheet


def careful_form(form: RunForm, on_bench: SceneChoice) -> RunForm:
    """Return the form for real devices: moves need approval, and no blind release.

    It starts with the pieces ``on_bench``.
    """
    mode = "approve" if form.mode == "auto" else form.mode
    strategy = "paper" if form.strategy == "pick-and-place" else form.strategy
    *under, bottom = on_bench.bottoms
    stands = replace(form, piece=on_bench.piece, bottom=bottom, under="".join(under[:1]))
    return replace(stands, mode=mode, strategy=strategy)


@dataclass(frozen=True, slots=True)
class StackMemory:
    """Stored settings beside the form."""

    planned: tuple[PlannedRun, ...] = ()


# Outcomes of a release on devices, as observed by the operator: command, text, key, outcome.
SEEN = (
    ("stands", "It stands", "1", Outcome.PLACED),
    ("fell", "It fell", "2", Outcome.FELL),
    ("disturbed", "The bottom was disturbed", "3", Outcome.KNOCKED_OVER),
    ("void", "The trial is void, for the reason that is written", "4", Outcome.ABORTED),
)


class StackWorkspace(shell.Workspace):
    """Fingers, traces, belief, decision and score of one run at a time."""

    name, title, key = "stack", "Stack", "Ctrl+4"
    page: StackPage

    def __init__(self, context: shell.WorkspaceContext) -> None:
        self._context = context
        self.presenter: StackPresenter | None = None
        self.side: shell.BenchViewPresenter | None = None
        self.comparison: ComparisonPresenter | None = None
        self.attended: OperatorPromptsPresenter | None = None
        self.pieces: PieceSheet | None = None
        self._catalogue: PieceLibrary | None = None
        self.planned: PlannedRunsSheet | None = None
        self._bench: Session | None = None
        self._form, self._kept = RunForm(), StackMemory()
        self.commands = (
            shell.WindowCommand("start", "Start stacking", "Ctrl+Return", self._start),
            shell.WindowCommand("step", "Next step: carry out the move that waits", "N",
                                lambda: self.page.decision.approve.clicked.emit()),
            shell.WindowCommand("approve", "Approve the pending move", "A",
                                lambda: self.page.decision.approve.clicked.emit()),
            shell.WindowCommand("decline", "Decline the step that waits: the trial ends", "D",
                                lambda: self.page.decision.decline.clicked.emit()),
            shell.WindowCommand("pause", "Pause or resume", "P",
                                lambda: self.page.run.pause.clicked.emit()),
            shell.WindowCommand("compare", "Compare the strategies on the same seed", "Ctrl+D",
                                self._compare),
            shell.WindowCommand("planned", "Runs in a row: list, order, start", "Ctrl+Shift+D",
                                self._plan),
            shell.WindowCommand("bookmark", "Bookmark this moment of the run", "B", self._bookmark),
            shell.WindowCommand("confirm", "Yes: the scene is set, the hand is there, as proposed",
                                "Y", lambda: self._on_trial(OperatorPromptsPresenter.confirm)),
            *(
                shell.WindowCommand(name, text, key, partial(self._see, outcome))
                for name, text, key, outcome in SEEN
            ),
            shell.WindowCommand("piece", "Add a piece from a CAD file", "", self._add_piece),
            shell.WindowCommand("photo", "Add a picture of this trial", "",
                                lambda: self.page.trial.photo.clicked.emit()),
            shell.WindowCommand("fit", "Fit the force and moment ranges", "Ctrl+F",
                    lambda: self.page.fit()),
        )  # fmt: skip

    def build(self) -> Iterator[None]:
        """Create the page."""
        self.page = page = StackPage(self._context.theme)
        page.run.start.clicked.connect(self._start)
        page.compare.clicked.connect(self._compare)
        page.run.row.clicked.connect(self._plan)
        page.bookmark.clicked.connect(self._bookmark)
        page.add_piece.clicked.connect(self._add_piece)
        self.note = shell.BookmarkDialog(page, "Bookmark")
        shell.FileDrop(page, PIECE_SOURCES, lambda path: self._piece_sheet().take(path))
        yield
        self.columns = self.lazy_pages = page.columns

    def attach(self, bench: Session) -> None:
        """Connect the page to a bench."""
        page, self._bench = self.page, bench
        self.live = shell.LivePresenter(bench, page)
        self.presenter = presenter = StackPresenter(bench, page, self._context.cards)
        self.side = shell.BenchViewPresenter(bench, page.side, page.side_panel)
        self.attended = OperatorPromptsPresenter(bench, page, self._context.cards)
        self.comparison = ComparisonPresenter(
            bench, self._context.theme, lambda: stack_request(page.run.form()), presenter.begin
        )
        self.planned = PlannedRunsSheet(
            bench, page, self._context.cards, presenter.begin, self._context.remember,
            lambda gave: self._context.offer(gave, "Review", lambda: self._context.go("review")),
        )  # fmt: skip
        for run in self._kept.planned:
            safe = run if bench.simulated else careful_form(run, bench.usual)
            self.planned.runs.append(replace(run, mode=safe.mode, strategy=safe.strategy))
        self._catalogue = bench.catalogue
        page.run.show_catalogue(*shell.piece_titles(bench.catalogue))
        page.run.show_devices(not bench.simulated)
        page.run.show_form(self._form if bench.simulated else careful_form(self._form, bench.usual))
        page.decision.show_text(NO_DECISION)
        presenter.show_model()
        bench.prompt.attended = True
        page.run.chosen.connect(presenter.show_model)
        page.run.pause.clicked.connect(lambda: shell.pause_or_resume(bench))
        page.run.cancel.clicked.connect(lambda: bench.engine.cancel())
        page.decision.approve.clicked.connect(lambda: presenter.answer(True))
        page.decision.decline.clicked.connect(lambda: presenter.answer(False))
        page.probe_chosen.connect(presenter.choose)
        page.trial.answered.connect(self.attended.answer)
        page.trial.judged.connect(self.attended.judge)
        page.trial.photo.clicked.connect(self.attended.ask_photo)
        self.parts = (*self.live.parts, presenter.draw, self.side.draw, self.comparison.draw)

    def enter(self) -> None:
        """Show the model in use, which may have changed."""
        if self.presenter is not None:
            self.presenter.show_model()

    def take(self, event: Event) -> None:
        """Handle one event of the bench."""
        parts = (self.presenter, self.side, self.comparison, self.planned, self.attended)
        for part in parts:
            if part is not None:
                part.take(event)

    def close(self) -> None:
        """End the threads that store pictures and measure pieces."""
        if self.pieces is not None:
            self.pieces.close_worker()
        if self.attended is not None:
            self.attended.close()

    def show_waiting(self, word: str, why: str) -> None:
        """Show why no bench is connected yet."""
        self.page.show_waiting(word, why)

    def memory(self) -> shell.Memory:
        """Return form and planned runs to store; without a bench the stored ones."""
        runs = self._kept.planned if self.planned is None else tuple(self.planned.runs)
        form = self._form if self.presenter is None else self.page.run.form()
        return asdict(form) | asdict(StackMemory(runs))

    def recall(self, memory: shell.Memory) -> Sequence[str]:
        """Restore the stored form; return the names of invalid fields."""
        self._form, dropped = shell.restore_form(RunForm(), memory)
        self._kept, wrong = shell.restore_form(StackMemory(), memory)
        self.page.run.show_form(self._form)
        return [*dropped, *wrong]

    # -- orders -----------------------------------------------------------------------------------

    def _start(self) -> None:
        if self.presenter is not None:
            # Store the mode, so that a crash does not restore the automatic one.
            self._context.remember()
            self.presenter.start()

    def _compare(self) -> None:
        if self.comparison is not None:
            self.comparison.open(self.page.window())

    def _plan(self) -> None:
        if self.planned is not None:
            self.planned.change(self.planned.runs, 0)
            self.planned.present()

    def _bookmark(self) -> None:
        """Ask for the note of a bookmark at the present time of the run."""
        bench = self._bench
        if bench is None or bench.run_folder is None or not shell.is_run_active(bench):
            self._context.say("No recorded run is active. Review sets bookmarks afterwards.")
            return
        mark = Bookmark(bench.status().trial, round(bench.clock_s(), 2))
        said = tr("Bookmark at {:.2f} s of trial {}.", mark.t_s, mark.trial)
        path = bench.run_folder / BOOKMARKS_NAME
        self.note.ask_note(path, mark, lambda _: self._context.say(said))

    def _piece_sheet(self) -> PieceSheet:
        if self.pieces is None:
            # Reading of meshes is imported on first use.
            from touchdown.app.stack.piece_import import PieceSheet

            self.pieces = PieceSheet(self.page.window(), self._context.theme, self._piece_added)
        return self.pieces

    def _add_piece(self) -> None:
        self._piece_sheet().present()

    def _piece_added(self, name: str) -> None:
        """Let the new piece be chosen; without a bench, the next one knows it."""
        if self._catalogue is not None:
            self._catalogue.add(load_pieces().piece(name))
            self.page.run.show_catalogue(*shell.piece_titles(self._catalogue))
        self._context.say(tr("Piece '{}' is added.", name))

    def _on_trial(self, order: Callable[[OperatorPromptsPresenter], None]) -> None:
        if self.attended is not None:
            order(self.attended)

    def _see(self, outcome: Outcome) -> None:
        self._on_trial(lambda trial: trial.see(outcome))

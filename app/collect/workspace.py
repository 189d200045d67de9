"""Collect workspace with its labelling half."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from touchdown.app import shell
from touchdown.app.collect.origin import OriginCheckNote
from touchdown.app.collect.page import CollectPage
from touchdown.app.collect.presenter import CollectPresenter
from touchdown.app.collect.probes import SIGNALS
from touchdown.app.collect.requests import recording_plan
from touchdown.app.label import HalvesPage, LabelWorkspace
from touchdown.backend.annotations import DESCRIPTION_FILE, Dataset
from touchdown.backend.bench import Session
from touchdown.backend.core import Event
from touchdown.backend.geometry import load_pieces
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import TargetForm

if TYPE_CHECKING:
    from touchdown.app.collect.recording_import import RecordingSheet


def join_half_commands(
    front: Callable[[], str],
    titles: Mapping[str, str],
    commands: Mapping[str, Sequence[shell.WindowCommand]],
) -> tuple[shell.WindowCommand, ...]:
    """Merge the commands of both halves; a key used by several halves becomes one row.

    ``front`` returns the name of the visible half; ``titles`` and ``commands`` are keyed by that
    name. Commands of a hidden half do nothing.
    """
    rows: dict[str, dict[str, shell.WindowCommand]] = {}
    for half, given in commands.items():
        for command in given:
            key = shell.portable_key(command.key) or f"{half}.{command.name}"
            rows.setdefault(key, {})[half] = command

    def run_in_front(halves: Mapping[str, shell.WindowCommand]) -> None:
        command = halves.get(front())
        if command is not None:
            command.run()

    return tuple(
        replace(
            next(iter(halves.values())),
            text="; ".join(f"{tr(titles[half])}: {tr(one.text)}" for half, one in halves.items()),
            run=partial(run_in_front, halves),
            repeats=all(one.repeats for one in halves.values()),
        )
        for halves in rows.values()
    )


COLLECT, LABEL = "collect", "label"
RECORDINGS = (".mcap", "")  # files of ROS 2, and folders
OTHER = {COLLECT: LABEL, LABEL: COLLECT}
TITLES = {COLLECT: "Collect", LABEL: "Label"}


@dataclass(frozen=True, slots=True)
class CollectMemory:
    """Stored settings of the collect half."""

    target: dict[str, object] = field(default_factory=dict)
    signal: Annotated[int, Field(ge=0, lt=len(SIGNALS))] = 0
    origin: OriginCheckNote | None = None
    half: Annotated[str, Field(pattern="^(collect|label)$")] = COLLECT


class CollectWorkspace(shell.Workspace):
    """Collecting needs a bench, labelling does not.

    Both use the dataset opened by the label half.
    """

    name, title, key = "collect", "Collect & Label", "Ctrl+2"
    page: HalvesPage

    def __init__(self, context: shell.WorkspaceContext) -> None:
        self._context = context
        self.label = LabelWorkspace(context)
        self._bench: Session | None = None
        # Read-only dataset, open while no person is named.
        self._looked_at: Dataset | None = None
        self._offered: Callable[[], None] = lambda: None  # the way to Label
        self.recordings: RecordingSheet | None = None
        self.label.opened = self._take_dataset
        self.label.refused = self._miss_dataset
        self.label.person_changed = self._show_person
        halves = {COLLECT: self._commands(), LABEL: self.label.commands}
        self.commands = (
            *join_half_commands(lambda: self.page.front, TITLES, halves),
            shell.WindowCommand("half", "The other half: collect, or label", "F2",
                                lambda: self.page.show_half(OTHER[self.page.front])),
            shell.WindowCommand("half-collect", "Collect half", "Ctrl+Shift+C",
                    lambda: self.page.show_half(COLLECT)),
            shell.WindowCommand("half-label", "Label half", "Ctrl+Shift+L",
                    lambda: self.page.show_half(LABEL)),
        )  # fmt: skip
        self.held_keys = self.label.held_keys

    def build(self) -> Iterator[None]:
        """Create both halves and the thread that reads for them."""
        self.page = self.lazy_pages = HalvesPage(self._context.theme)
        self.collect_page = CollectPage(self._context.theme)
        yield
        yield from self.collect_page.build()
        self.page.add(COLLECT, TITLES[COLLECT], self.collect_page)
        yield
        self.label.build_in(self.page)
        yield
        self.reader = shell.SaveWorker(self.page, "collect-reader")
        self._catalogue = load_pieces()
        self.presenter = CollectPresenter(
            self.collect_page, self._context.cards, self.reader, self._catalogue
        )
        self.presenter.ended = self._offer_next
        self._wire()
        self.collect_page.target.show_catalogue(*shell.piece_titles(self._catalogue))
        self.page.half_shown.connect(self._half_came)

    # -- life -------------------------------------------------------------------------------------

    def attach(self, bench: Session) -> None:
        """Connect to a bench."""
        self._bench, page = bench, self.collect_page
        self.live = shell.LivePresenter(bench, page)
        self.presenter.attach(bench)
        self.parts = (*self.live.parts, self.presenter.draw, self.presenter.draw_maps)

    def take(self, event: Event) -> None:
        """Handle one event of the bench."""
        self.presenter.take(event)

    def show_waiting(self, word: str, why: str) -> None:
        """Show why no bench is connected yet."""
        self.collect_page.show_silent(why)

    def enter(self) -> None:
        """Show the dataset and pieces added since; open it for writing if the person is known."""
        added = load_pieces().pieces.items() - self._catalogue.pieces.items()
        for _, piece in sorted(added):
            self._catalogue.add(piece)
        if added:
            self.collect_page.target.show_catalogue(*shell.piece_titles(self._catalogue))
        self._half_came(self.page.front)

    def leave(self) -> None:
        """Save the label in edit; a campaign continues in the background."""
        self.label.leave()

    def memory(self) -> shell.Memory:
        """Return the settings of both halves to store."""
        page = self.collect_page
        mine = CollectMemory(
            asdict(page.target.form()),
            page.signal.currentIndex(),
            self.presenter.origin.note,
            self.page.front,
        )
        return {**self.label.memory(), **asdict(mine)}

    def recall(self, memory: shell.Memory) -> Sequence[str]:
        """Restore stored settings; return the names of invalid fields."""
        mine, dropped = shell.restore_form(CollectMemory(), memory)
        form, invalid = shell.restore_form(TargetForm(), mine.target)
        self.collect_page.target.show_form(form)
        self.collect_page.signal.setCurrentIndex(mine.signal)
        self.presenter.origin.show_note(mine.origin)
        self.page.bring(mine.half)
        return [*self.label.recall(memory), *dropped, *invalid]

    def close(self) -> None:
        """Close the bench before the dataset that it records into."""
        if self._bench is not None:
            self._bench.close()
            self._bench.dataset = None
        self._stop_looking()
        if self.recordings is not None:
            self.recordings.close_worker()
        self.reader.close()
        self.label.close()

    # -- the dataset ------------------------------------------------------------------------------

    def _take_dataset(self, opened: shell.OpenedDataset) -> None:
        self.presenter.take_dataset(opened.dataset, read=self.page.front == COLLECT)
        self._stop_looking()

    def _miss_dataset(self, why: str) -> None:
        self.presenter.dataset_trouble = why

    def _look(self) -> None:
        """Show the dataset read-only while no person is named."""
        folder = self.label.folder
        self.presenter.choose_pair()
        if self.presenter.dataset is None and (folder / DESCRIPTION_FILE).is_file():
            self.reader.submit(
                lambda: Dataset.open(folder, create=False, write=False),
                self._looking,
                _ignore_unseen,
            )

    def _looking(self, dataset: Dataset) -> None:
        if self.presenter.dataset is None:
            self._looked_at = dataset
            self.presenter.take_dataset(dataset, read=self.page.front == COLLECT)
        else:
            self.reader.submit(dataset.close, _ignore_unseen, _ignore_unseen)

    def _stop_looking(self) -> None:
        dataset, self._looked_at = self._looked_at, None
        if dataset is not None:
            # On the same thread, after the reads in progress.
            self.reader.submit(dataset.close, _ignore_unseen, _ignore_unseen)

    def _show_person(self, name: str) -> None:
        self.presenter.person = name
        self.collect_page.target.person.setText(name)

    def _half_came(self, name: str) -> None:
        if name == LABEL:
            self._context.offer("", "", self._offered)
            self.label.enter()
            return
        self.label.leave()
        self.collect_page.setFocus()
        self.label.open()
        self._look()
        self.presenter.probes.restyle()

    def _take_person(self) -> None:
        name = self.collect_page.target.person.text()
        if name.strip() and name != self.presenter.person:
            self.label.be(name)

    def _offer_next(self, gave: str, left: int) -> None:
        """Offer to label the probes of a campaign, or show the button that continues it."""

        def show() -> None:
            self._context.go(self.name)
            self.page.show_half(COLLECT if left else LABEL)
            if left:
                self.collect_page.target.go_on.setFocus()

        step = tr("Continue: {:,} left", left) if left else "Label the episodes"
        if left or not self.page.isVisible() or self.page.front != LABEL:
            self._context.offer(gave, step, show)
            self._offered = self._offered if left else show

    def _recording_sheet(self) -> RecordingSheet:
        if self.recordings is None:
            # The formats of others are imported on first use.
            from touchdown.app.collect.recording_import import RecordingSheet

            window, theme = self.page.window(), self._context.theme
            self.recordings = RecordingSheet(window, theme, self._import_target)
            self.recordings.imported.connect(self._imported)
        return self.recordings

    def _import_target(self) -> tuple[Dataset | None, str, str, str]:
        form, presenter = self.collect_page.target.form(), self.presenter
        return presenter.dataset, presenter.person, form.piece, form.bottom

    def _imported(self, name: str, uuids: list[str]) -> None:
        for uuid in uuids:
            self.presenter.probes.read(uuid, lambda _: None)
        self._offer_next(tr("{} from {}.", count_noun(len(uuids), "new episode"), name), 0)

    # -- orders -----------------------------------------------------------------------------------

    def _wire(self) -> None:
        page, presenter = self.collect_page, self.presenter
        page.target.start.clicked.connect(presenter.start)
        page.target.go_on.clicked.connect(presenter.go_on)
        page.target.pause.clicked.connect(presenter.pause_or_resume)
        page.target.end.clicked.connect(presenter.end)
        page.target.person.editingFinished.connect(self._take_person)
        page.target.take.clicked.connect(presenter.take_origin)
        page.target.here.clicked.connect(presenter.set_origin_here)
        page.target.lift.clicked.connect(presenter.lift)
        page.target.pair_chosen.connect(presenter.choose_pair)
        page.target.pattern.activated.connect(self._choose_plan)
        page.decided.connect(presenter.decide)
        page.dot_chosen.connect(presenter.probes.choose_dot)
        page.row_chosen.connect(presenter.probes.choose)
        page.filter_changed.connect(presenter.probes.restyle)
        page.take_in.clicked.connect(lambda: self._recording_sheet().present())
        shell.FileDrop(page, RECORDINGS, lambda path: self._recording_sheet().take(path))

    def _choose_plan(self) -> None:
        """Fill in the numbers of the recording plan that is chosen, and say what it needs."""
        target = self.collect_page.target
        form = target.form()
        if plan := recording_plan(form.pattern):
            within_mm, per_grip = plan.within_mm or 0.0, plan.probes_per_grip
            target.show_form(replace(
                form, count=plan.count, probes_per_grip=per_grip, within_mm=within_mm, ask=False
            ))  # fmt: skip
            self._context.say(tr("This recording needs: {}.", plan.note))

    def _commands(self) -> tuple[shell.WindowCommand, ...]:
        return (
            self._act("start", "Start, or keep and next", "F5", lambda p: p.start()),
            self._act("go-on", "Continue the last campaign", "Shift+F5", lambda p: p.go_on()),
            self._act("pause", "Pause or resume", "P", lambda p: p.pause_or_resume()),
            self._act("keep", "Keep the probe", "Return", lambda p: p.decide("keep")),
            self._act("discard-probe", "Discard the probe", "Backspace",
                      lambda p: p.decide("discard")),
            self._act("flag-probe", "Flag the probe", "X", lambda p: p.decide("flag")),
            self._act("again", "Redo the probe", "R", lambda p: p.decide("redo")),
            self._act("leave-out", "Skip: leave its place out", "S", lambda p: p.decide("skip")),
            shell.WindowCommand("person", "Say who collects", "Ctrl+U",
                    lambda: self.collect_page.target.ask_person()),
            shell.WindowCommand("fit", "Fit the force and moment ranges", "Ctrl+F",
                    lambda: self.collect_page.fit()),
            shell.WindowCommand("import", "Import recordings of other laboratories", "",
                                lambda: self._recording_sheet().present()),
        )  # fmt: skip

    def _act(
        self, name: str, text: str, key: str, act: Callable[[CollectPresenter], None]
    ) -> shell.WindowCommand:
        return shell.WindowCommand(name, text, key, lambda: act(self.presenter))


def _ignore_unseen(_: object) -> None:
    """Ignore the error: opening the dataset for writing reports it."""

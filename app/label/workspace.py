"""Label workspace: page, presenter, commands and the dataset that it works on."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from PySide6.QtCore import QSize, Signal
from PySide6.QtWidgets import QButtonGroup, QStackedWidget, QWidget

from touchdown.app.label.bulk import BulkPresenter, SideTabKeys, SideTabsPresenter
from touchdown.app.label.decisions import LabelDecisions
from touchdown.app.label.page import LabelPage
from touchdown.app.label.presenter import HealthPresenter, LabelPresenter
from touchdown.app.label.session import AnnotationSession
from touchdown.app.label.side import HEALTH
from touchdown.app.label.text import FINDING, QUEUES
from touchdown.app.shell import (
    Memory,
    OpenedDataset,
    SaveWorker,
    WindowCommand,
    Workspace,
    WorkspaceContext,
    WorkspacePage,
    error_card,
    open_dataset,
    restore_form,
)
from touchdown.backend.annotations import (
    MergeReport,
    QualityReport,
    check_dataset_quality,
    check_person,
    parse_filter,
)
from touchdown.backend.core import InputError, TouchdownError
from touchdown.backend.learning import ModelRegistry, models_below
from touchdown.backend.placement import score_labels
from touchdown.backend.runs import dataset_folder, models_folder
from touchdown.widgets.base import Theme, count_noun, hbox, push_button, tr, vbox
from touchdown.widgets.shell import CardText

TELL_EVERY = 20
IN_USE = "-"
NO_FILTER = "Labels are saved at once. To keep a filter as a queue, type one first (Ctrl+F)."


class DatasetTasks:
    """Long tasks on the dataset, on a separate thread, so that saving goes on."""

    def __init__(self, page: LabelPage, presenter: LabelPresenter, opened: OpenedDataset) -> None:
        self._page, self._on, self._opened = page, presenter, opened
        self._jobs, self._ended = SaveWorker(page, "label-jobs"), threading.Event()

    def score(self) -> None:
        """Let the model judge every episode. Fills four queues; changes no label."""
        if self._jobs.busy:
            self._page.say("This action is already in progress.")
            return
        self._page.say("Scoring the dataset …")
        opened, progress = self._opened, self._teller("Scoring the dataset: {:,} of {:,}")
        self._jobs.submit(
            lambda: score_labels(opened.dataset, opened.prelabel.model, progress),
            lambda count: self._on.read_anew(
                tr("The model has scored {}.", count_noun(count, "episode"))
            ),
            self._failed,
        )

    def look_through(self, done: Callable[[QualityReport], None]) -> None:
        """Check the quality of all episodes."""
        if self._jobs.busy:
            self._page.say("Wait until the dataset is checked or scored.")
            return
        self._page.say("Looking through the dataset …")
        dataset, progress = (
            self._opened.dataset,
            self._teller("Looking through the dataset: {:,} of {:,}"),
        )

        def looked(health: QualityReport) -> None:
            self._page.say("")
            done(health)

        self._jobs.submit(lambda: check_dataset_quality(dataset, progress), looked, self._failed)

    def choose_models(self) -> None:
        """Ask for the folder of the models that pre-label the piece of the present episode."""
        now = self._on.present
        if now is None:
            self._page.say("Show an episode of the piece first.", bad=True)
            return
        piece = now.item.entry.piece
        hint = tr("Folder of the models that pre-label {}, or {} for the one in use", piece, IN_USE)
        self._page.ask_words(hint, "", lambda words: self._choose_models(piece, words))

    def _choose_models(self, piece: str, words: str) -> None:
        person, registry = self._on.session.person, ModelRegistry(models_folder())

        def choose() -> int:
            models = [] if words == IN_USE else models_below(Path(words).expanduser(), piece)
            if not models and words != IN_USE:
                raise InputError(
                    tr("There is no model of '{}'.", piece), words, "Name another folder."
                )
            registry.choose_ensemble(piece, models, person)
            return len(models)

        def chosen(count: int) -> None:
            self._opened.prelabel.forget()
            self._on.read_anew(
                tr("{} of {} pre-label together.", count_noun(count, "model"), piece) if count
                else tr("The model in use pre-labels {}.", piece)
            )  # fmt: skip

        self._jobs.submit(choose, chosen, self._failed)

    def merge(self) -> None:
        """Ask for the folder of another copy and merge its changes."""
        self._page.ask_words("Folder of the other copy", "", self._merge)

    def close(self) -> None:
        """Stop the running task; results so far are kept."""
        self._ended.set()
        self._jobs.close()

    def _teller(self, doing: str) -> Callable[[int, int], bool]:
        """Return a progress callback, which also cancels the task when the window closes."""

        def tell(done: int, count: int) -> bool:
            if done % TELL_EVERY == 0:
                text = tr(doing, done, count)
                self._jobs.put(lambda: self._page.say(text))
            return not self._ended.is_set()

        return tell

    def _merge(self, folder: str) -> None:
        person, dataset = self._on.session.person, self._opened.dataset
        self._page.say("Merging …")
        self._jobs.submit(
            lambda: dataset.merge(person, Path(folder).expanduser()), self._merged, self._failed
        )

    def _merged(self, done: MergeReport) -> None:
        counts = [count_noun(done.operations, "action"), count_noun(done.episodes, "episode")]
        if done.conflicts:
            counts.append(count_noun(len(done.conflicts), "conflict"))
        self._page.say(tr("Merged {}.", ", ".join(counts)))

    def _failed(self, error: Exception) -> None:
        self._page.say(str(error) if isinstance(error, TouchdownError) else repr(error), bad=True)


class FrontStack(QStackedWidget):
    """Pages of which the visible one alone needs room; a hidden page has no layout yet."""

    def minimumSizeHint(self) -> QSize:
        """Return the least size of the visible page."""
        front = self.currentWidget()
        return super().minimumSizeHint() if front is None else front.minimumSizeHint()


class HalvesPage(WorkspacePage):
    """Shows one half at a time, with a switch if there are two."""

    half_shown = Signal(str)

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self._stack, self._buttons = FrontStack(), QButtonGroup(self)
        self._names: list[str] = []
        self._halves: list[QWidget] = []
        self._bar = QWidget()
        self._row = hbox(1, parent=self._bar, margins=(10, 8, 10, 0), spacing=4)
        vbox(self._bar, (self._stack, 1), parent=self, margins=(0, 0, 0, 0), spacing=0)
        self._bar.hide()
        self._stack.currentChanged.connect(lambda _: self._stack.updateGeometry())
        self._buttons.idClicked.connect(lambda at: self.show_half(self._names[at]))

    def add(self, name: str, title: str, page: QWidget) -> None:
        """Add a half."""
        button = push_button(title, role="tab", checkable=True)
        self._buttons.addButton(button, len(self._names))
        self._row.insertWidget(len(self._names), button)
        self._names.append(name)
        self._halves.append(page)
        self._stack.addWidget(page)
        self._bar.setVisible(len(self._names) > 1)
        self._buttons.button(self._stack.currentIndex()).setChecked(True)

    def take_out(self) -> None:
        """Remove the halves before the page is added to a window."""
        for half in self._halves:
            self._stack.removeWidget(half)
            half.setParent(None)

    def put_back(self) -> Iterator[None]:
        """Add the halves again, one per step; each is styled then."""
        for half in self._halves:
            self._stack.addWidget(half)
            yield

    @property
    def front(self) -> str:
        """Name of the visible half."""
        return self._names[self._stack.currentIndex()]

    def show_half(self, name: str) -> None:
        """Show a half and report it."""
        self.bring(name)
        self.half_shown.emit(name)

    def bring(self, name: str) -> None:
        """Show a half without reporting it."""
        at = self._names.index(name)
        self._stack.setCurrentIndex(at)
        self._buttons.button(at).setChecked(True)


@dataclass(frozen=True, slots=True)
class LabelTools:
    """Presenters and keys of the open dataset."""

    presenter: LabelPresenter
    decisions: LabelDecisions
    side: SideTabsPresenter
    bulk: BulkPresenter
    tasks: DatasetTasks
    health: HealthPresenter
    keys: SideTabKeys


MEMORY = ("person", "queue", "sigma_mm", "blind", "filter", "saved")  # stored of the session


class LabelWorkspace(Workspace):
    """The label half. Opens the dataset when it is entered for the first time."""

    name, title, key = "collect", "Collect", "Ctrl+2"
    page: HalvesPage

    def __init__(self, context: WorkspaceContext) -> None:
        self._context, self.folder = context, dataset_folder()
        self.session = AnnotationSession()
        # Called when the dataset is open.
        self.opened: Callable[[OpenedDataset], None] = lambda _: None
        self.refused: Callable[[str], None] = lambda _: None  # the dataset cannot be opened
        self.person_changed: Callable[[str], None] = lambda _: None
        self.tools: LabelTools | None = None
        self._opened: OpenedDataset | None = None
        self.commands = label_commands(self, context)
        self.held_keys = tuple((key, "Type a displacement x,y in mm") for key in "0123456789-.")

    def build_in(self, page: HalvesPage) -> None:
        """Create the label half and add it to ``page``."""
        self.page = page
        self.label_page = LabelPage(self._context.theme)
        self._wire()
        self.page.add("label", "Label", self.label_page)
        self.worker = SaveWorker(self.label_page, "label-commits")

    @property
    def presenter(self) -> LabelPresenter | None:
        """The presenter of the open dataset."""
        return None if self.tools is None else self.tools.presenter

    # -- life -------------------------------------------------------------------------------------

    def enter(self) -> None:
        """Ask for the person, open the dataset, or read the queue again."""
        self.label_page.setFocus()
        if not self.session.person:
            self.ask_person()
        elif self.presenter is None:
            self.open()
        else:
            self.presenter.refresh()

    def leave(self) -> None:
        """Stop the film and save the present edit."""
        self.label_page.film.stop()
        self.label_page.choice.hide()
        if self.presenter is not None:
            self.presenter.do(self.presenter.editing.save)

    def close(self) -> None:
        """Save the present edit, end the threads and release the dataset."""
        if self.tools is not None:
            self.tools.tasks.close()
            self.tools.presenter.close()
        self.worker.close()
        if self._opened is not None:
            self._opened.dataset.close()
            self._opened = None

    def memory(self) -> Memory:
        """Return person, queue, uncertainty, blind mode and filters to store."""
        kept = {name: getattr(self.session, name) for name in MEMORY}
        return kept | ({"queue": "unlabelled"} if self.session.queue == FINDING else {})

    def recall(self, memory: Memory) -> Sequence[str]:
        """Restore stored settings; return the names of invalid fields."""
        s = self.session
        kept, dropped = restore_form(s, memory)
        if kept.person and not _is_name(kept.person):
            kept.person = s.person
            dropped.append("person")
        kept.queue = {"uncertainty": "training"}.get(kept.queue, kept.queue)  # up to 0.1.0
        if kept.queue not in (*dict(QUEUES), *kept.saved):
            kept.queue = s.queue
            dropped.append("queue")
        for name in MEMORY:
            setattr(s, name, getattr(kept, name))
        self.label_page.list_saved(list(s.saved))
        self._show_session()
        return dropped

    def open(self) -> None:
        """Open the dataset if a person is named and it is not open yet."""
        if self.presenter is not None or not self.session.person or self.worker.busy:
            return
        self.label_page.say("Opening the dataset …")
        person = self.session.person
        self.worker.submit(lambda: open_dataset(self.folder, person), self._take, self._failed)

    def _take(self, opened: OpenedDataset) -> None:
        self._opened, page = opened, self.label_page
        presenter = LabelPresenter(page, opened, self.worker, self.session)
        decisions = LabelDecisions(page, presenter)
        side = SideTabsPresenter(page.side, presenter, self.worker)
        bulk = BulkPresenter(page.bulk, presenter, opened.catalogue, page.choice)
        self.tools = LabelTools(
            presenter,
            decisions,
            side,
            bulk,
            DatasetTasks(page, presenter, opened),
            HealthPresenter(page, presenter),
            SideTabKeys(page, presenter, decisions, side, bulk),
        )
        presenter.ended = self._offer_next
        page.say("")
        for notice in (*opened.dataset.notices, opened.read_only):
            if notice:
                self._context.cards.show_card(
                    CardText("DATASET", notice, "", "", reset=False, notice=True)
                )
        presenter.refresh()
        self.opened(opened)

    def _offer_next(self, done: int, queue: str, size: int) -> None:
        """Tell that a queue is done; offer the next one, or a training."""
        titles, now, offer = dict(QUEUES), self.session.queue, self._context.offer
        text = tr("{}: {} done.", tr(titles.get(now, now)), count_noun(done, "episode"))
        if queue:
            text = f"{text} {tr(titles[queue])}: {count_noun(size, 'episode')}."
            offer(text, "Open that queue", partial(self._go_to, queue))
        elif size:
            text = f"{text} {tr('{} for a training.', count_noun(size, 'label'))}"
            offer(text, "Train on them", partial(self._context.go, "train"))

    def _go_to(self, queue: str) -> None:
        self._context.go(self.name)
        self.page.show_half("label")
        self._open_queue(queue)

    def _open_queue(self, name: str) -> None:
        self.label_page.list_saved(list(self.session.saved))
        self.label_page.show_queue(name)
        self._choose_queue(name)

    def ask_filter(self) -> None:
        """Show all episodes and let the filter be typed."""
        if self.session.wanted is None:
            self._open_queue("all")
            self.label_page.show_filter(self.session.filter, saved=False)
        self.label_page.filter.setFocus()
        self.label_page.filter.selectAll()

    def filter(self, text: str) -> None:
        """Show the episodes that pass a filter, or why it is none."""
        try:
            parse_filter(text)
        except InputError as error:
            self.label_page.say(f"{error.what} {error.fix}", bad=True)
            return
        self.session.filter = text.strip()
        self.label_page.setFocus()
        self._open_queue("all")

    def keep_filter(self) -> None:
        """Ask for the name of the filter; forget a saved one, whose list stays."""
        session = self.session
        if session.queue in session.saved:
            session.filter = session.saved.pop(session.queue)
            self._open_queue("all")
        elif session.wanted is not None:
            self.label_page.ask_words("Name of the filter", "", self._save_filter)
        else:
            self.label_page.say(NO_FILTER)

    def _save_filter(self, name: str) -> None:
        if name in {word for queue in QUEUES for word in queue} or not name.isprintable():
            self.label_page.say(tr("A filter cannot have the name '{}'.", name), bad=True)
        else:
            self.session.saved[name] = self.session.filter
            self._open_queue(name)

    def _failed(self, error: Exception) -> None:
        self.label_page.say("No dataset is open.", bad=True)
        card = error_card("DATASET", error, tr("In {}.", self.folder), "Look at the folder.")
        self._context.cards.show_card(card)
        self.refused(card.what)

    # -- who --------------------------------------------------------------------------------------

    def ask_person(self) -> None:
        """Ask for the person who labels."""
        if not self.session.person:
            self.label_page.show_nobody()
        self.label_page.ask_words("Your name", self.session.person, self.be)

    def be(self, name: str) -> None:
        """Continue as person ``name``; the first name opens the dataset."""
        try:
            person = check_person(name)
        except TouchdownError as error:
            self.label_page.say(str(error), bad=True)
            return
        self.label_page.close_lines()
        presenter = self.presenter
        if presenter is None:
            self._be(person)
            self.open()
            return

        async def switch() -> None:
            self._be(person)
            await presenter.read_queue(stay=False)

        presenter.flushed(switch)

    def _be(self, person: str) -> None:
        if person != self.session.person:
            # Each person has an uncertainty of their own.
            self.session.sigma_mm = None
        self.session.person = person
        self._show_session()
        self._context.remember()

    def _show_session(self) -> None:
        session, page = self.session, self.label_page
        page.person.setText(session.person or tr("nobody"))
        page.person.setAccessibleName(tr("Person: {}", page.person.text()))
        page.show_queue(session.queue)
        self.person_changed(session.person)

    # -- keys -------------------------------------------------------------------------------------

    def _wire(self) -> None:
        page = self.label_page
        page.row_chosen.connect(lambda at: self.on(lambda t: t.presenter.go_to(at)))
        page.queue_chosen.connect(self._choose_queue)
        page.face_dragged.connect(lambda at_mm: self.on(lambda t: t.presenter.editing.place(at_mm)))
        page.face_dropped.connect(lambda: self.on(lambda t: t.presenter.editing.drop()))
        page.version_chosen.connect(lambda rev: self.on(lambda t: t.decisions.restore(rev)))
        page.displacement_typed.connect(
            lambda text: self.on(lambda t: t.presenter.editing.typed(text))
        )
        page.key_typed.connect(self._type)
        page.retry_requested.connect(lambda: self.on(lambda t: t.decisions.enter()))
        page.discard_requested.connect(self.discard)
        page.search_changed.connect(self._search)
        page.person_requested.connect(self.ask_person)
        page.command_requested.connect(self._run)
        page.tab_chosen.connect(lambda _: self._search(""))
        page.preview_requested.connect(lambda: self.on(lambda t: t.bulk.preview()))
        page.apply_requested.connect(lambda: self.on(lambda t: t.bulk.apply()))
        page.value_entered.connect(lambda: self.on(lambda t: t.bulk.preview(ask=True)))
        page.health_requested.connect(self.look_through)
        page.filter_typed.connect(self.filter)
        page.filter_kept.connect(self.keep_filter)
        page.finding_chosen.connect(lambda row: self.on(lambda t: t.health.choose(row)))

    def on(self, act: Callable[[LabelTools], None]) -> None:
        """Call ``act`` once the dataset is open."""
        if self.tools is not None:
            act(self.tools)

    def ask_number(self) -> None:
        """Ask for a place of the queue and go there."""
        p = self.presenter
        if p is not None:
            hint = tr("Number in the queue, 1 to {:,}", len(p.walk.order))
            self.label_page.ask_words(hint, "", p.go_to_number)

    def _type(self, text: str) -> None:
        """Answer the open question with a digit, else start the entry of a displacement."""
        page, presenter = self.label_page, self.presenter
        if text == " ":
            page.film.play_or_pause()
        elif presenter is not None:
            presenter.do(
                lambda: page.choice.take(text) if page.choice.isVisible() else page.open_entry(text)
            )

    def look_through(self) -> None:
        """Check the quality of the dataset."""
        if self.tools is not None:
            self.label_page.side.choose(HEALTH)
            self.tools.tasks.look_through(self.tools.health.show)

    def discard(self) -> None:
        """Discard the save that failed."""
        if self.presenter is not None and self.presenter.saving.failure:
            self.presenter.saving.discard()
            self.presenter.reload()

    def _search(self, text: str) -> None:
        self.on(lambda t: t.side.show(text))

    def _run(self, name: str) -> None:
        """Run a command by name; ``collect`` switches to the other half."""
        if name == "collect":
            self.page.show_half("collect")
            return
        self.label_page.setFocus()
        next(command for command in self.commands if command.name == name).run()

    def hide(self) -> None:
        """Hide or show the model and other sources."""
        self.session.hidden = not self.session.hidden
        self.on(lambda t: t.presenter.show_edit())

    def toggle_blind(self) -> None:
        """Turn blind mode on or off."""

        def turn() -> None:
            opined = self.session.opines
            self.session.blind = not self.session.blind
            words = "Blind mode is on." if self.session.blind else "Blind mode is off."
            if self.session.opines is not opined:
                self.on(lambda t: t.presenter.read_with_news(words))
            else:
                self.on(lambda t: t.presenter.reload())
                self.label_page.say(words)

        if self.presenter is None:
            turn()
        else:
            self.presenter.flushed(turn)

    def _choose_queue(self, name: str) -> None:
        self.on(lambda t: t.presenter.choose_queue(name))
        self._context.remember()

    def list_queues(self) -> None:
        """Open the list of the queues; arrows and Enter choose."""
        self.label_page.queue.setFocus()
        self.label_page.queue.showPopup()


def _is_name(person: str) -> bool:
    try:
        return check_person(person) == person
    except TouchdownError:
        return False


NUDGES = {
    "Left": "Move the face {:g} mm left", "Right": "Move the face {:g} mm right",
    "Up": "Move the face {:g} mm up", "Down": "Move the face {:g} mm down",
}  # fmt: skip
STEPS_UM = (("", 100), ("Shift+", 1000), ("Alt+", 10))
ARROWS = (("Left", -1, 0), ("Right", 1, 0), ("Up", 0, 1), ("Down", 0, -1))


def label_commands(w: LabelWorkspace, context: WorkspaceContext) -> tuple[WindowCommand, ...]:
    """Return all commands of the label half."""

    def on(
        name: str, text: str, key: str, act: Callable[[LabelTools], None], *,
        beside: bool = False,
    ) -> WindowCommand:  # fmt: skip
        """Return a command on the open dataset; ``beside`` ones repeat while the key is held."""
        return WindowCommand(name, text, key, lambda: w.on(act), repeats=beside, beside=beside)

    def nudge(name: str, prefix: str, dx_um: int, dy_um: int) -> WindowCommand:
        step_um = max(abs(dx_um), abs(dy_um))
        return on(
            f"nudge-{name.lower()}-{step_um}",
            tr(NUDGES[name], step_um / 1000),
            f"{prefix}{name}",
            lambda t: t.presenter.editing.nudge(dx_um, dy_um),
            beside=True,
        )

    return (
        on("accept", "Accept (approve, while reviewing) and next", "Return",
           lambda t: t.decisions.enter()),
        on("carry", "Accept, and correct the rest of the grip in the same way", "K",
           lambda t: t.decisions.carry()),
        on("reject", "Reject, then 1 to 9 for the reason", "D", lambda t: t.decisions.reject()),
        on("flag", "Flag, or take the flag off", "X", lambda t: t.decisions.flag()),
        on("undo", "Undo my last action", "Ctrl+Z", lambda t: t.decisions.undo()),
        on("redo", "Redo", "Ctrl+Shift+Z", lambda t: t.decisions.redo()),
        on("undo-plain", "Undo my last action", "U", lambda t: t.decisions.undo()),
        on("redo-plain", "Redo", "Shift+U", lambda t: t.decisions.redo()),
        on("model", "Take the model's displacement", "M",
           lambda t: t.presenter.editing.take_model()),
        on("sigma", "Say how sure you are of what you set", "S",
           lambda t: t.presenter.editing.ask_sigma()),
        on("verdict", "Would it stand: V, then S, U or ?", "V", lambda t: t.decisions.verdict()),
        on("take-over", "Take over another's draft", "T", lambda t: t.decisions.take_over()),
        on("resolve", "Resolve a conflict", "C", lambda t: t.decisions.resolve()),
        on("delete", "Delete the episode, with a reason", "Delete",
           lambda t: t.decisions.delete()),
        *(nudge(name, prefix, dx * step_um, dy * step_um)
          for prefix, step_um in STEPS_UM for name, dx, dy in ARROWS),
        WindowCommand("play", "Play the film from the cursor, or pause (Space)", "",
                      lambda: w.label_page.film.play_or_pause()),
        WindowCommand("frame-back", "One frame back", "[", lambda: w.label_page.film.step(-1),
                      repeats=True, beside=True),
        WindowCommand("frame-on", "One frame forward", "]", lambda: w.label_page.film.step(1),
                      repeats=True, beside=True),
        WindowCommand("pictures", "Pictures: the tactile film, or the scene camera", "I",
                      lambda: w.label_page.next_pictures(), beside=True),
        WindowCommand("curves", "Choose the curves on one axis", "W",
                      lambda: w.label_page.list_curves()),
        WindowCommand("hide", "Hide or show the model and other sources", "H", w.hide),
        on("previous", "Previous, without a decision", "PgUp", lambda t: t.presenter.move(-1)),
        on("next", "Next, without a decision: skip", "PgDown", lambda t: t.presenter.move(1)),
        on("first", "First of the queue", "Home", lambda t: t.presenter.go_to(0)),
        on("last", "Last of the queue", "End",
           lambda t: t.presenter.go_to(len(t.presenter.walk.order) - 1)),
        WindowCommand("number", "Go to a place of the queue, by its number", "Q", w.ask_number),
        WindowCommand("queue", "Choose the queue", "Ctrl+J", w.list_queues),
        WindowCommand("filter", "Filter and sort all episodes", "Ctrl+F", w.ask_filter),
        WindowCommand("keep-filter", "Save the filter as a queue, or forget it", "Ctrl+S",
                      w.keep_filter),
        WindowCommand("select-next", "Select also the next episode, for a bulk change",
                      "Shift+PgDown", lambda: w.label_page.list.extend(1), repeats=True),
        WindowCommand("select-previous", "Select also the episode before, for a bulk change",
                      "Shift+PgUp", lambda: w.label_page.list.extend(-1), repeats=True),
        on("reread", "Read the queue again", "Ctrl+R",
           lambda t: t.presenter.flushed(t.presenter.read_queue)),
        on("versions", "Restore an earlier version, by its digit", "O",
           lambda t: t.keys.versions()),
        on("agreement", "Figures of agreement", "E", lambda t: t.keys.agreement()),
        on("log", "Search the log of all actions", "L", lambda t: t.keys.log()),
        on("bulk", "Change the selected labels, or all of the queue", "B", lambda t: t.keys.many()),
        WindowCommand("health", "Check all episodes of the dataset", "Ctrl+H", w.look_through),
        on("findings", "Choose a finding, by its digit", "F", lambda t: t.health.ask()),
        WindowCommand("blind", "Blind mode: no model, no other sources", "Ctrl+B", w.toggle_blind),
        WindowCommand("person", "Change the person", "Ctrl+U", w.ask_person),
        on("score", "Let the model score the dataset: fills four queues", "Ctrl+M",
           lambda t: t.tasks.score()),
        on("models", "Choose the models that pre-label: one, or several together", "Shift+M",
           lambda t: t.tasks.choose_models()),
        on("merge", "Merge another copy of this dataset", "Ctrl+Shift+M",
           lambda t: t.tasks.merge()),
        WindowCommand("discard", "Discard what could not be saved", "Esc", w.discard),
        WindowCommand("sheet", "Key sheet", "?", context.keys),
    )  # fmt: skip

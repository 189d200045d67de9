"""Page of the label workspace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QComboBox, QListWidget, QWidget

from touchdown.app.label.side import BulkForm, KeyboardLineEdit, SideTabs
from touchdown.app.label.text import QUEUES
from touchdown.backend.annotations import FILTER_HELP
from touchdown.widgets import base
from touchdown.widgets.forms import ChoiceBar
from touchdown.widgets.lists import LabelList
from touchdown.widgets.plots import CHANNEL_NAMES, PhasePlot, RecordedTraces
from touchdown.widgets.shell import StateStrip, UnsavedBanner
from touchdown.widgets.views import FilmView, OffsetView, SceneShotView


class DatasetHealthPanel(QWidget):
    """List of dataset problems. ``look`` starts a check, ``choose`` receives the chosen row."""

    def __init__(self, look: Callable[[], None], choose: Callable[[int], None]) -> None:
        super().__init__()
        self.said = base.label("The dataset was not checked yet.", "muted", wrap=True)
        self.list = QListWidget()
        self.list.setAccessibleName(base.tr("Findings of the dataset"))
        base.WrappedItemDelegate(self.list)
        tip = "Check all episodes of the dataset (Ctrl+H)"
        self.look = base.push_button("Check the dataset", tip)
        self.look.clicked.connect(look)
        self.list.itemClicked.connect(lambda item: choose(self.list.row(item)))
        self.list.itemActivated.connect(lambda item: choose(self.list.row(item)))
        base.vbox(self.said, (self.list, 1), self.look, parent=self, margins=(0, 0, 0, 0))

    def show_findings(self, said: str, lines: Sequence[str]) -> None:
        """Show a summary and one line per kind of problem."""
        self.said.setText(said)
        self.list.clear()
        self.list.addItems(list(lines))


@dataclass(frozen=True, slots=True)
class EmptyState:
    """Reason why nothing is shown. ``button`` is the text of the button that runs ``command``.

    Without a button the person can only wait.
    """

    title: str
    why: str
    button: str
    command: str


NO_PERSON = EmptyState(
    "No person is named yet", "The queue depends on the person who labels.",
    "Give your name (Ctrl+U)", "person",
)  # fmt: skip
NO_PROBES = EmptyState(
    "There are no probes yet", "Every probe that is collected waits here for its label.",
    "Collect probes (F2)", "collect",
)  # fmt: skip
LOADING = EmptyState("Loading the episode", "Its pictures and forces are being read.", "", "")
UNREADABLE = EmptyState(
    "This episode cannot be read", "The line below says why; its label stays as it is.",
    "Go to the next one (PgDown)", "next",
)  # fmt: skip
NOT_SCORED = EmptyState(
    "Nothing is in this queue",
    "The model has not scored the dataset yet, or no such label is left.",
    "Let the model score the dataset (Ctrl+M)",
    "score",
)


def empty_queue(title: str, why: str) -> EmptyState:
    """Return the state of a queue that is done."""
    return EmptyState(title, why, "Choose another queue (Ctrl+J)", "queue")


LABELLED = "Every probe has a label that was accepted or rejected."
EMPTY_QUEUES = {
    "unlabelled": empty_queue("Nothing is left to label", LABELLED),
    "review": empty_queue("Nothing waits for your review", "Other persons review your labels."),
    "returned": empty_queue(
        "None of your labels was rejected", "No label was returned, and you rejected no probe."
    ),
    "all": empty_queue("No episode passes the filter", "Change it above, or clear it."),
    "conflicts": empty_queue("There are no conflicts", "No merge gave an episode two labels."),
    **dict.fromkeys(("doubt", "disagreement", "training", "duplicates"), NOT_SCORED),
}
EMPTY_QUEUE = empty_queue("Nothing is in this queue", "No episode belongs to this queue.")


class EmptyStateView(QWidget):
    """Centred reason why nothing is shown; ``act`` receives the command of the button."""

    def __init__(self, act: Callable[[str], None]) -> None:
        super().__init__()
        self.shown = EMPTY_QUEUE
        self.title, self.why = base.label("", "head", wrap=True), base.label("", "muted", wrap=True)
        self.button = base.push_button(role="primary")
        self.button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.button.clicked.connect(lambda: act(self.shown.command))
        for widget in (self.title, self.why):
            widget.setAlignment(Qt.AlignmentFlag.AlignCenter)
        column = base.vbox(2, self.title, self.why, parent=self, spacing=8)
        column.addSpacing(4)
        column.addWidget(self.button, 0, Qt.AlignmentFlag.AlignHCenter)
        column.addStretch(3)
        self.show_why(EMPTY_QUEUE)
        self.hide()

    def show_why(self, nothing: EmptyState) -> None:
        """Show another reason."""
        self.shown = nothing
        self.title.setText(base.tr(nothing.title))
        self.why.setText(base.tr(nothing.why))
        self.button.setText(base.tr(nothing.button))
        self.button.setVisible(bool(nothing.button))
        self.setAccessibleName(self.title.text())
        self.setAccessibleDescription(self.why.text())


FORCES, MOMENTS = (0, 1, 2), (3, 4, 5)
REVIEWING, APPROVE = ("review", "audit"), "Approve  (Enter)"  # queues in which Enter approves
ACTS = {  # buttons below the displacement, and their commands
    "Accept  (Enter)": "accept", "Accept grip  (K)": "carry", "Reject  (D)": "reject",
    "Flag  (X)": "flag", "Skip  (PgDown)": "next",
}  # fmt: skip
PAIRS = [(a, b) for a in range(6) for b in range(a + 1, 6)]


class LabelPage(QWidget):
    """Queue on the left, the displacement in the middle, the evidence on the right."""

    row_chosen = Signal(int)
    queue_chosen = Signal(str)
    face_dragged = Signal(object)  # (x, y) in mm
    face_dropped = Signal()
    version_chosen = Signal(str)
    displacement_typed = Signal(str)
    key_typed = Signal(str)
    retry_requested = Signal()
    discard_requested = Signal()
    search_changed = Signal(str)
    person_requested = Signal()
    command_requested = Signal(str)
    tab_chosen = Signal(int)
    preview_requested = Signal()
    apply_requested = Signal()
    value_entered = Signal()
    health_requested = Signal()
    finding_chosen = Signal(int)
    filter_typed = Signal(str)
    filter_kept = Signal()

    def __init__(self, theme: base.Theme) -> None:
        super().__init__()
        self.setObjectName("frame")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.queue = QComboBox()
        for name, text in QUEUES:
            self.queue.addItem(base.tr(text), name)
        self.queue.setAccessibleName(base.tr("Queue"))
        hint = "piece:pot state:draft since:2026-11-30 sort:pair"
        self.filter = KeyboardLineEdit("Filter", hint, self.filter_typed.emit, self.setFocus)
        self.filter.setToolTip(base.tr(FILTER_HELP))
        self.keep_filter = base.flat_button("Save", "Give the filter a name, as a queue (Ctrl+S)")
        self.list = LabelList(theme, self.row_chosen.emit)
        self.bulk = BulkForm(
            self.preview_requested.emit,
            self.apply_requested.emit,
            self.value_entered.emit,
            self.setFocus,
        )
        self.health = DatasetHealthPanel(self.health_requested.emit, self.finding_chosen.emit)
        self.side = SideTabs(
            theme,
            self.version_chosen.emit,
            self.search_changed.emit,
            self.tab_chosen.emit,
            self.setFocus,
            (self.bulk, self.health),
        )
        self.strip = StateStrip(theme)
        self.view = OffsetView(theme, self.face_dragged.emit, self.face_dropped.emit)
        self.nothing = EmptyStateView(self.command_requested.emit)
        self.acts = [base.push_button(text) for text in ACTS]
        for button, name in zip(self.acts, ACTS.values(), strict=True):
            button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
            button.clicked.connect(partial(self.command_requested.emit, name))
        self.acts[0].setProperty("role", "primary")
        self.basis, self.message = base.label("", "title", wrap=True), base.label("", wrap=True)
        self.verdict = base.ElidedLabel("")
        self.model_line, self.scene_line = (base.label("", "muted", wrap=True) for _ in range(2))
        self.entry = KeyboardLineEdit(
            "Displacement x,y in mm", "1.5,-2", self.displacement_typed.emit, self.leave_entry
        )
        self.caption = base.ElidedLabel("muted")
        self.words = KeyboardLineEdit("Words", "", self._take_words, self.leave_entry)
        for line in (self.caption, self.entry, self.words):
            line.hide()
        self._answer: Callable[[str], None] = lambda _text: None
        self.banner = UnsavedBanner(self.retry_requested.emit, self.discard_requested.emit)
        self.film = FilmView(theme, self.show_cursor)
        self.shots = SceneShotView(theme)
        self.pictures = base.compact_combo_box(["Tactile film", "Scene camera"], "Pictures")
        self.forces = RecordedTraces(theme, FORCES, self.show_cursor)
        self.moments = RecordedTraces(theme, MOMENTS, self.show_cursor)
        self.phase = PhasePlot(theme)
        pairs = [base.tr("{} with {}", CHANNEL_NAMES[a], CHANNEL_NAMES[b]) for a, b in PAIRS]
        self.curves = base.compact_combo_box(["Forces, moments", *pairs], "Curves on one axis")
        self.person = base.push_button("nobody", "Who labels (Ctrl+U)", role="header")
        self.choice = ChoiceBar(self)
        self.queue.activated.connect(self._queue_chosen)
        self.curves.activated.connect(self._curves_chosen)
        self.pictures.currentIndexChanged.connect(self._pictures_chosen)
        self.person.clicked.connect(self.person_requested)
        self.keep_filter.clicked.connect(self.filter_kept)
        self._arrange()

    def _arrange(self) -> None:
        self.queue_panel = base.Panel("Queue", self.list)
        self.queue_panel.column.insertWidget(1, self.queue)
        self.queue_panel.column.insertLayout(2, base.hbox((self.filter, 1), self.keep_filter))
        self.show_filter(None, saved=False)
        self.view_panel = base.Panel("Displacement", self.view)
        self.view_panel.header.addWidget(self.person)
        inner = self.view_panel.column
        inner.insertWidget(1, self.strip)
        inner.insertWidget(2, self.nothing, 1)
        evidence = self.basis, self.verdict, self.scene_line, self.model_line
        base.add_items(inner, *evidence, self.caption, self.entry, self.words, self.message)
        for row in (self.acts[:2], self.acts[2:]):  # one row is too wide for small windows
            inner.addLayout(base.hbox(*((button, 1) for button in row), spacing=4))
        film = self.film_panel = base.Panel("Pictures", self.film)
        film.column.addWidget(self.shots, 1)
        self.shots.hide()
        film.header.addWidget(self.pictures)
        curves = base.Panel("Wrench")
        curves.header.addWidget(self.curves)
        plots = base.vbox((self.forces, 1), (self.moments, 1), spacing=2)
        curves.column.addLayout(base.hbox((plots, 3), (self.phase, 2)), 1)
        base.hbox(
            (base.vbox((self.queue_panel, 5), (self.side, 4), spacing=8), 6),
            # The question is below the view: it must not cover the face.
            (base.vbox(self.banner, (self.view_panel, 1), self.choice, spacing=8), 11),
            (base.vbox(film, (curves, 1), spacing=8), 10),
            parent=self, margins=(10, 8, 10, 8), spacing=8,
        )  # fmt: skip

    def show_cursor(self, t_s: float) -> None:
        """Move the cursor of every view."""
        self.film.show_cursor(t_s)
        for view in (self.forces, self.moments, self.phase):
            view.show_cursor(t_s)
        self.film_panel.detail.setText(f"{base.signed(t_s)} s")

    def show_queue(self, name: str, title: str = "") -> None:
        """Show the chosen queue; ``title`` names a queue that is not in the list."""
        at = self.queue.findData(name)
        if at < 0:
            at = self.queue.count()
            self.queue.addItem("", name)
        if title:
            self.queue.setItemText(at, title)
        self.queue.setCurrentIndex(at)
        self.acts[0].setText(base.tr(APPROVE if name in REVIEWING else next(iter(ACTS))))
        self.acts[1].setEnabled(name not in REVIEWING)

    def list_saved(self, names: Sequence[str]) -> None:
        """List the saved filters below the queues."""
        while self.queue.count() > len(QUEUES):
            self.queue.removeItem(len(QUEUES))
        for name in names:
            self.queue.addItem(name, name)

    def show_filter(self, text: str | None, *, saved: bool) -> None:
        """Show the filter of the queue, None if it has none; a saved one can be forgotten."""
        for widget in (self.filter, self.keep_filter):
            widget.setVisible(text is not None)
        if not self.filter.hasFocus():
            self.filter.setText(text or "")
            self.filter.setCursorPosition(0)
        self.keep_filter.setText(base.tr("Forget" if saved else "Save"))
        name = "Forget the filter" if saved else "Save the filter"
        self.keep_filter.setAccessibleName(base.tr(name))

    def open_entry(self, first: str) -> None:
        """Open the entry of a displacement with its first characters."""
        if not self.entry.isVisible():
            self.entry.clear()
            self._show_line(self.entry, "x,y in mm, or x,y,sigma: Enter sets, Esc leaves")
        self.entry.setFocus()
        self.entry.insert(first)

    def ask_words(self, hint: str, first: str, answer: Callable[[str], None]) -> None:
        """Ask for a text; an empty line is not an answer."""
        self._answer = answer
        self.words.setText(first)
        self.words.selectAll()
        hint = base.tr(hint)
        self.words.setAccessibleName(hint)
        self._show_line(self.words, base.tr("{}: Enter takes it, Esc leaves", hint))
        self.words.setFocus()

    def _show_line(self, line: KeyboardLineEdit, caption: str) -> None:
        for other in (self.entry, self.words):
            other.setVisible(other is line)
        self.caption.setText(base.tr(caption))
        self.caption.setToolTip(self.caption.text())
        self.caption.show()
        base.scroll_into_view(line)

    def _take_words(self, text: str) -> None:
        if text.strip():
            self.leave_entry()
            self._answer(text.strip())

    def leave_entry(self) -> None:
        """Close the entry line."""
        self.close_lines()
        self.setFocus()

    def close_lines(self) -> None:
        """Hide the entry lines."""
        if self.entry.hasFocus() or self.words.hasFocus():
            # Otherwise the next control would get the focus.
            self.setFocus()
        for line in (self.caption, self.entry, self.words):
            line.hide()

    def say(self, text: str, *, bad: bool = False) -> None:
        """Show one sentence below the view; ``bad`` marks a refusal."""
        base.set_property(self.message, "tone", "bad" if bad else "")
        self.message.setText(base.tr(text))

    def show_nobody(self) -> None:
        """Show that a person must be named first."""
        self.queue_panel.detail.setText(base.tr("no person is named"))
        self.show_nothing(NO_PERSON)
        self.say("")

    def show_nothing(self, nothing: EmptyState) -> None:
        """Show why there is no episode, and clear the previous one."""
        self.nothing.show_why(nothing)
        self._swap(here=False)
        self.view.show_scene(None)
        self.film.show_none()
        self.shots.show_shots((), why="")
        for view in (self.forces, self.moments, self.phase):
            view.show_trace(None, why="")
        for line in (self.verdict, self.basis, self.model_line, self.scene_line):
            line.setText("")
        for panel in (self.film_panel, self.view_panel):
            panel.detail.setText("")
        self.side.history.show_rows([])

    def show_something(self) -> None:
        """Make room for an episode."""
        if self.nothing.isVisibleTo(self):
            self._swap(here=True)

    def _swap(self, *, here: bool) -> None:
        focused = self.nothing.button.hasFocus()
        self.nothing.setVisible(not here)
        for widget in (self.strip, self.view, *self.acts):
            widget.setVisible(here)
        if focused and here:
            self.setFocus()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Report keys that start a displacement, and Space."""
        firm = event.modifiers() & ~(
            Qt.KeyboardModifier.ShiftModifier | Qt.KeyboardModifier.KeypadModifier
        )
        text = event.text()
        if text and text in "0123456789.,-+ " and not firm:
            self.key_typed.emit(text)
        else:
            super().keyPressEvent(event)

    def next_pictures(self) -> None:
        """Switch between the tactile film and the scene camera."""
        self.pictures.setCurrentIndex(1 - self.pictures.currentIndex())

    def list_curves(self) -> None:
        """Open the list of curves; arrows and Enter choose."""
        self.curves.setFocus()
        self.curves.showPopup()

    def _queue_chosen(self, at: int) -> None:
        self.queue_chosen.emit(str(self.queue.itemData(at)))
        self.setFocus()

    def _pictures_chosen(self, at: int) -> None:
        """Switch film and scene in place, without changing the layout below."""
        if at == 1:
            self.shots.setFixedHeight(self.film.height())
        self.film.stop()
        self.film.setVisible(at == 0)
        self.shots.setVisible(at == 1)
        self.setFocus()

    def _curves_chosen(self, at: int) -> None:
        if at == 0:
            self.forces.show_channels(FORCES)
        else:
            self.forces.show_channels(PAIRS[at - 1])
        self.moments.setVisible(at == 0)
        self.setFocus()

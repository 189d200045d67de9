"""Page of the review workspace."""

from __future__ import annotations

from PySide6.QtCore import Qt, Signal
from PySide6.QtGui import QKeyEvent, QResizeEvent
from PySide6.QtWidgets import QComboBox, QLineEdit, QToolButton, QWidget

from touchdown.app.shell import WorkspacePage
from touchdown.widgets.base import (
    ElidedLabel,
    KeylessList,
    Panel,
    Theme,
    add_items,
    flat_button,
    hbox,
    label,
    tr,
    vbox,
)
from touchdown.widgets.forms import set_entries
from touchdown.widgets.lists import RecordingList
from touchdown.widgets.plots import RecordedTraces
from touchdown.widgets.views import (
    BeliefLegend,
    BeliefView,
    DecisionPanel,
    FilmView,
    MapAndStrip,
    ProbeStrip,
    ScorePanel,
    TimeLine,
)

KINDS = (("all", "All"), ("runs", "Runs"), ("series", "Series"))
ORDERS = (("kind", "By kind"), ("newest", "Newest"), ("oldest", "Oldest"), ("pair", "By pair"))
STORY_PX = 82  # height of three lines at the minimum window size
FILM_SHARE = 0.18  # maximum share of the page height for a picture
FORCES, MOMENTS = (0, 1, 2), (3, 4, 5)


class ReviewPage(WorkspacePage):
    """Recordings on the left; belief, decision, film and wrench at one cursor on the right."""

    recording_chosen = Signal(int)
    probe_chosen = Signal(int)
    time_chosen = Signal(float)
    filter_changed = Signal()

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        seek = self.time_chosen.emit
        self.runs = RecordingList(theme, "Recorded runs", self.recording_chosen.emit)
        self.trials = KeylessList("Trials of the run", "The trials of a run appear here.")
        self.story = KeylessList("What happened", "The steps of a run appear here.")
        self.kind, self.order, self.filter = QComboBox(), QComboBox(), QLineEdit()
        self.refresh = flat_button("Refresh", "Look for new recordings (Ctrl+R)")
        report = "Open a report of experiments (Ctrl+Shift+O)"
        self.experiments = flat_button("Report", report)
        self.empty = label("", "muted", wrap=True)
        self.belief, self.legend = BeliefView(theme), BeliefLegend(theme)
        self.belief.setMinimumHeight(160)
        self.story.setMinimumHeight(STORY_PX)
        # Whole rows would leave free room below the last one.
        self.story.setVerticalScrollMode(self.story.ScrollMode.ScrollPerPixel)
        self.decision = DecisionPanel()
        self.strip = ProbeStrip(theme, self.probe_chosen.emit)
        self.score = ScorePanel(theme, "Outcomes")
        self.film = FilmView(theme, seek)
        self.forces = RecordedTraces(theme, FORCES, seek)
        self.moments = RecordedTraces(theme, MOMENTS, seek)
        self.estimate = ElidedLabel("muted")
        self.time_line, self.at = TimeLine(theme, seek), label("", "small")
        self.play = QToolButton()
        self._name()
        self._arrange()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Limit the height of the pictures."""
        self.film.limit_height(round(FILM_SHARE * self.seen_px))

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Play with Space. While the bench moves, Space stops it and does not arrive here."""
        if event.key() == Qt.Key.Key_Space and not event.isAutoRepeat():
            self.play.click()
        else:
            super().keyPressEvent(event)

    def show_cursor(self, t_s: float) -> None:
        """Show all views at one time."""
        self.film.show_cursor(t_s)
        for view in (self.forces, self.moments, self.time_line):
            view.show_cursor(t_s)
        self.at.setText(f"{t_s:.2f} s")

    # -- inside -----------------------------------------------------------------------------------

    def _name(self) -> None:
        for combo, entries, name, tip in (
            (self.kind, KINDS, "Kind of recording", "Show runs, series of the dataset, or all"),
            (self.order, ORDERS, "Order of the recordings",
             "Runs before series; by time; or by pair and outcome"),
        ):  # fmt: skip
            set_entries(combo, entries)
            combo.setSizeAdjustPolicy(
                QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon
            )
            combo.setMinimumContentsLength(4)
            combo.setAccessibleName(tr(name))
            combo.setToolTip(tr(tip))
            combo.currentIndexChanged.connect(self.filter_changed)
        self.filter.setPlaceholderText(tr("Filter: pot, fell, 2026-11"))
        self.filter.setAccessibleName(tr("Filter of the recordings"))
        self.filter.setClearButtonEnabled(True)
        for button in self.filter.findChildren(QToolButton):
            button.setAccessibleName(tr("Clear the filter"))
            button.setToolTip(tr("Clear the filter"))
        self.play.setText(tr("Play"))
        self.play.setToolTip(tr("Play from the cursor, or pause (Space, while nothing moves)"))
        self.play.setAccessibleName(tr("Play or pause"))
        self.filter.textChanged.connect(self.filter_changed)
        self.film.ran.connect(lambda on: self.play.setText(tr("Pause" if on else "Play")))

    def _arrange(self) -> None:
        runs = self.runs_panel = Panel("Recordings")
        choices = hbox((self.kind, 1), (self.order, 1))
        add_items(runs.column, choices, self.filter, (self.runs, 1), self.empty)
        runs.header.addWidget(self.experiments)
        runs.header.addWidget(self.refresh)
        self.trials_panel = Panel("Trials", self.trials)
        left = vbox((runs, 3), (self.trials_panel, 2), self.score, spacing=8)
        self.shown = QWidget()
        self.shown.setObjectName("frame")
        story = Panel("What happened", self.story)
        self.belief_panel = Panel("Belief map", MapAndStrip(self.belief, self.legend, self.strip))
        self.belief_panel.column.addWidget(self.estimate)
        self.signals_panel = Panel("Signals")
        add_items(self.signals_panel.column, self.film, (self.forces, 1), (self.moments, 1))
        views = hbox(
            (vbox(self.decision, (self.belief_panel, 1), spacing=8), 9),
            (vbox((self.signals_panel, 3), (story, 1), spacing=8), 8),
            spacing=8,
        )
        whole = (views, 1), self._time_panel()
        vbox(*whole, parent=self.shown, margins=(0, 0, 0, 0), spacing=8)
        hbox((left, 5), (self.shown, 17), parent=self, margins=(10, 8, 10, 8), spacing=8)

    def _time_panel(self) -> Panel:
        panel = Panel("Time")
        panel.column.addLayout(hbox(self.play, (self.time_line, 1)))
        panel.header.addWidget(self.at)
        self.bookmark = flat_button("Bookmark", "Note at the cursor: add, change or remove (B)")
        self.picture = flat_button("Save picture", "Save what is shown as PNG and SVG (Ctrl+E)")
        self.table = flat_button("Save table", "Save the probes as CSV (Ctrl+Shift+E)")
        self.html = flat_button("Save page", "Save picture and probes as one HTML page")
        viewer = "Open the file in the viewer of this computer (Ctrl+O)"
        self.viewer = flat_button("Open file", viewer)
        exports = self.picture, self.table, self.html, self.viewer
        add_items(panel.header, self.bookmark, *exports)
        self.acts = self.play, self.bookmark, *exports
        return panel

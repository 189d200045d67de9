"""Page of the collect workspace."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QCheckBox, QComboBox

from touchdown.app.collect.origin import OriginCheckNote, residual_text
from touchdown.app.collect.probes import SIGNALS
from touchdown.app.shell import LivePage, arm_position_mm, column_of
from touchdown.backend.bench import Session
from touchdown.backend.core import FINGERS
from touchdown.widgets.base import CaptionedView, Panel, Theme, flat_button, hbox, tr, vbox
from touchdown.widgets.forms import LastProbePanel, PairHealthPanel, TargetPanel
from touchdown.widgets.lists import EpisodeTable
from touchdown.widgets.plots import DistributionView


class CollectPage(LivePage):
    """Target on the left, live views and maps in the middle, probes on the right.

    The page is complete after ``build`` has finished.
    """

    decided = Signal(str)
    dot_chosen = Signal(int)
    row_chosen = Signal(str)
    filter_changed = Signal()
    tactile_share = 0.22  # the maps need the rest

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.target = TargetPanel(theme)

    def build(self) -> Iterator[None]:
        """Create the other widgets of the page, a few milliseconds per step."""
        theme, choose = self._theme, self.dot_chosen.emit
        self.captions = {f: CaptionedView(f.capitalize(), self.tactile[f]) for f in FINGERS}
        self.coverage = DistributionView(theme, "Coverage of the displacements", choose)
        self.distribution = DistributionView(theme, "Distribution of the displacements", choose)
        self.signal = QComboBox()
        self.signal.addItems([f"{tr(name)} ({unit})" for name, unit, _ in SIGNALS])
        self.signal.setProperty("role", "compact")
        self.signal.setAccessibleName(tr("Signal that colours the dots"))
        self.signal.setToolTip(tr("Colour the dots by this signal at the end of the press"))
        yield
        self.probe = LastProbePanel(self.decided.emit)
        self.table = EpisodeTable(theme, self.row_chosen.emit)
        self.deleted = QCheckBox(tr("Deleted too"))
        self.deleted.setToolTip(tr("Show probes that were discarded"))
        self.take_in = flat_button("Import", "Import recordings of other laboratories")
        self.health = PairHealthPanel()
        self._recorder_panel = Panel("Recorder")
        self.recorder = self._recorder_panel.detail
        self.recorder.setAccessibleName(tr("Recorder"))
        # Return the focus to the page, whose commands are single letters.
        self.target.person.returnPressed.connect(self.setFocus, Qt.ConnectionType.QueuedConnection)
        self.signal.currentIndexChanged.connect(self.filter_changed)
        self.deleted.toggled.connect(self.filter_changed)
        self._arrange()

    def _leave_room(self) -> None:
        for view in self.tactile.values():
            view.limit_height(round(self.tactile_share * self.seen_px))

    def fit_to_theme(self) -> None:
        """Set the widths of the controls for the size of the text."""
        em = self.em
        self._left.least_px = round(17.5 * em)
        self._left.setMaximumWidth(round(22 * em))
        self._right.least_px = round(22 * em)
        for plot in (self.force, self.moment):
            # Large axis labels need larger plots.
            plot.setMinimumSize(max(200, round(12 * em)), max(104, round(6.1 * em)))

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        self._left = column_of((self.target, 1))
        middle = vbox((self._live_panel(), 1), (self._maps_panel(), 1), spacing=8)
        self.episodes = Panel("Episodes", self.table)
        self.episodes.header.addWidget(self.deleted)
        self.episodes.header.addWidget(self.take_in)
        self._right = column_of(
            (self.probe, 0), (self.episodes, 1), (self.health, 0), (self._recorder_panel, 0)
        )
        hbox(
            (self._left, 5), (middle, 12), (self._right, 9),
            parent=self, margins=(10, 8, 10, 8), spacing=8,
        )  # fmt: skip
        self.fit_to_theme()

    def _live_panel(self) -> Panel:
        self.live = Panel("Live")
        for plot in (self.force, self.moment):
            plot.setMinimumSize(200, 104)
        fingers = hbox(*((caption, 1) for caption in self.captions.values()), spacing=10)
        plots = hbox((self.force, 1), (self.moment, 1), spacing=10)
        self.live.column.addLayout(fingers)
        self.live.column.addLayout(plots, 1)
        return self.live

    def _maps_panel(self) -> Panel:
        self.maps = Panel("Displacements")
        self.maps.header.addWidget(self.signal)
        self.coverage_caption = CaptionedView("Coverage", self.coverage)
        self.distribution_caption = CaptionedView("Distribution", self.distribution)
        line = hbox((self.coverage_caption, 1), (self.distribution_caption, 1), spacing=16)
        self.maps.column.addLayout(line, 1)
        return self.maps


AGE_S = 1.0  # maximum age of an arm pose that is used as the origin


class OriginField:
    """Origin x and y with the result of the last origin check."""

    def __init__(self, target: TargetPanel) -> None:
        self._target = target
        self.note: OriginCheckNote | None = None

    def show_note(self, note: OriginCheckNote | None) -> None:
        """Show the result of the last origin check."""
        self.note = note
        usable = note is not None and not note.used
        self._target.show_residual(residual_text(note), usable=usable)

    def take_residual(self) -> None:
        """Add the residual of the last check to the origin, once."""
        if self.note is not None and not self.note.used:
            x, y = self._target.origin
            x.setValue(x.value() + self.note.residual_mm[0])
            y.setValue(y.value() + self.note.residual_mm[1])
            self.show_note(replace(self.note, used=True))

    def set_here(self, bench: Session | None) -> None:
        """Set the origin to the present position of the arm."""
        at_mm = None if bench is None else arm_position_mm(bench, AGE_S)
        if at_mm is not None:
            for field, value_mm in zip(self._target.origin, at_mm, strict=False):
                field.setValue(value_mm)
            self.show_note(None)

"""Where everything of the Stack workspace stands: feel on the left, believe, then decide."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtGui import QFontMetrics, QResizeEvent
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QToolButton, QVBoxLayout, QWidget

from backend.core.flow import FINGERS, Finger
from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.colour_maps import MAPS
from widgets.decision_panel import DecisionPanel, DecisionText
from widgets.force_traces import TracePlot
from widgets.freshness import Age
from widgets.panel import Panel, rule
from widgets.probe_strip import ProbeStrip
from widgets.run_panel import RunPanel
from widgets.score_panel import ScorePanel
from widgets.side_view import SideView
from widgets.tactile_view import TactileView
from widgets.theme import Theme, ui_font

TACTILE_SHARE = 0.45
"""The fingers take at most this share of the page's height; the traces need the rest."""


@dataclass(frozen=True, slots=True)
class StackIntents:
    """What the operator can ask for on this page."""

    start: Callable[[], None]
    pause: Callable[[], None]
    cancel: Callable[[], None]
    approve: Callable[[], None]
    decline: Callable[[], None]
    choose: Callable[[int], None]


class StackPage(QWidget):
    """The views of one stacking run."""

    def __init__(self, theme: Theme, intents: StackIntents) -> None:
        super().__init__()
        self.setObjectName("frame")
        self._theme = theme
        titles = {"left": "Tactile L", "right": "Tactile R"}
        self.tactile: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.tactile_panels = {f: Panel(titles[f], self.tactile[f]) for f in FINGERS}
        self.force = TracePlot(theme, "Force", "F", "N", 10.0)
        self.moment = TracePlot(theme, "Moment", "T", "N\N{MIDDLE DOT}m", 0.2)
        self.belief = BeliefView(theme)
        self.legend = BeliefLegend(theme)
        self.decision = DecisionPanel(intents.approve, intents.decline)
        self.strip = ProbeStrip(theme, intents.choose)
        self.run = RunPanel(theme, intents.start, intents.pause, intents.cancel)
        self.score = ScorePanel(theme)
        self.side = SideView(theme)
        self.belief_panel = self._belief_panel()
        self.side_panel = Panel("Bench from the side", self.side)
        self._arrange()

    def _belief_panel(self) -> Panel:
        panel = Panel("Belief map", self.belief)
        panel.column.addWidget(self.legend)
        panel.column.addWidget(rule())
        panel.column.addWidget(self.strip)
        chooser = QComboBox()
        chooser.addItems(list(MAPS))
        chooser.setProperty("role", "compact")
        chooser.setAccessibleName("Colour map")
        chooser.setToolTip("Colour map of the belief")
        chooser.currentIndexChanged.connect(self._choose_map)
        panel.header.addWidget(chooser)
        return panel

    def _choose_map(self, index: int) -> None:
        for view in (self.belief, *(t.view for t in self.strip.thumbnails)):
            view.show_map(MAPS[index])

    def _traces_panel(self) -> Panel:
        panel = Panel("Force and moment at the wrist")
        panel.column.setSpacing(2)
        panel.column.addWidget(self.force, 1)
        panel.column.addWidget(self.moment, 1)
        fit = QToolButton()
        fit.setText("Fit")
        fit.setProperty("role", "plain")
        fit.setToolTip("Set both ranges to what is shown now")
        fit.setAccessibleName("Fit the ranges of force and moment")
        fit.clicked.connect(self.fit)
        panel.header.addWidget(fit)
        return panel

    def fit_to_theme(self) -> None:
        """Give the controls the width that their text needs."""
        em = QFontMetrics(ui_font(self._theme.scale)).height()
        self._right.setMinimumWidth(round(16.5 * em))

    def show_waiting(self, verdict: str, why: str) -> None:
        """Say why nothing is shown yet, wherever something will be shown."""
        for view in self.tactile.values():
            view.show_age(Age.NEVER, 0.0, why)
        for plot in (self.force, self.moment):
            plot.show_age(Age.NEVER, 0.0, why)
        self.decision.show_text(DecisionText(verdict, "", "", why))

    def fit(self) -> None:
        """Fit the ranges of both plots."""
        self.force.fit()
        self.moment.fit()

    def heightForWidth(self, _width: int) -> int:
        """Ask for no more than the least height: the views share what there is."""
        return self.minimumHeight()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Leave out the side view where the controls need its room."""
        super().resizeEvent(event)
        for view in self.tactile.values():
            view.limit_height(round(TACTILE_SHARE * self.height()))
        controls = self.run.sizeHint().height() + self.score.sizeHint().height()
        self.side_panel.setVisible(self.height() > controls + 150)

    def _arrange(self) -> None:
        fingers = QHBoxLayout()
        fingers.setSpacing(8)
        for panel in self.tactile_panels.values():
            fingers.addWidget(panel, 1)
        self.traces_panel = self._traces_panel()
        feel = _column((fingers, 0), (self.traces_panel, 1))
        believe = _column((self.decision, 0), (self.belief_panel, 1))
        decide = _column((self.run, 0), (self.score, 0), (self.side_panel, 1))
        self._right = QWidget()
        self._right.setLayout(decide)
        decide.setContentsMargins(0, 0, 0, 0)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 8, 10, 8)
        row.setSpacing(8)
        row.addLayout(feel, 10)
        row.addLayout(believe, 9)
        row.addWidget(self._right, 5)
        self.fit_to_theme()


def _column(*parts: tuple[QWidget | QHBoxLayout, int]) -> QVBoxLayout:
    column = QVBoxLayout()
    column.setSpacing(8)
    for part, stretch in parts:
        if isinstance(part, QWidget):
            column.addWidget(part, stretch)
        else:
            column.addLayout(part, stretch)
    return column

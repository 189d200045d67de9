"""Where everything of the Review workspace stands: a recorded run, trial by trial."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QHBoxLayout, QListWidget, QPushButton, QVBoxLayout, QWidget

from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.decision_panel import DecisionPanel
from widgets.panel import Panel, label, rule
from widgets.probe_strip import ProbeStrip
from widgets.score_panel import ScorePanel
from widgets.theme import Theme


class ReviewPage(QWidget):
    """Runs on the left, the chosen trial in the middle, its story on the right."""

    def __init__(self, theme: Theme, choose_probe: Callable[[int], None]) -> None:
        super().__init__()
        self.setObjectName("frame")
        self.runs, self.trials, self.story = QListWidget(), QListWidget(), QListWidget()
        self.refresh = QPushButton("Refresh")
        self.empty = label("", "muted", wrap=True)
        self.belief = BeliefView(theme)
        self.legend = BeliefLegend(theme)
        self.decision = DecisionPanel(_nothing, _nothing)
        self.strip = ProbeStrip(theme, choose_probe)
        self.score = ScorePanel(theme)
        for widget, name in ((self.runs, "Recorded runs"), (self.trials, "Trials of the run"),
                             (self.story, "What happened")):  # fmt: skip
            widget.setAccessibleName(name)
        self.refresh.setToolTip("Look for new runs")
        for wrapped in (self.runs, self.story):
            wrapped.setWordWrap(True)
            wrapped.setResizeMode(QListWidget.ResizeMode.Adjust)
            wrapped.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self._arrange()

    def heightForWidth(self, _width: int) -> int:
        """Ask for no more than the least height: the views share what there is."""
        return self.minimumHeight()

    def _arrange(self) -> None:
        runs = Panel("Recorded runs", self.runs)
        runs.column.addWidget(self.empty)
        runs.column.addWidget(self.refresh)
        trials = Panel("Trials", self.trials)
        left = QVBoxLayout()
        left.setSpacing(8)
        left.addWidget(runs, 3)
        left.addWidget(trials, 2)
        self.belief_panel = Panel("Belief map", self.belief)
        self.belief_panel.column.addWidget(self.legend)
        self.belief_panel.column.addWidget(rule())
        self.belief_panel.column.addWidget(self.strip)
        middle = QVBoxLayout()
        middle.setSpacing(8)
        middle.addWidget(self.decision)
        middle.addWidget(self.belief_panel, 1)
        right = QVBoxLayout()
        right.setSpacing(8)
        right.addWidget(self.score)
        right.addWidget(Panel("What happened", self.story), 1)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 8, 10, 8)
        row.setSpacing(8)
        row.addLayout(left, 5)
        row.addLayout(middle, 10)
        row.addLayout(right, 7)


def _nothing() -> None:
    """Do nothing: a recorded decision cannot be approved any more."""

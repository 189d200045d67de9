"""Two strategies on the same seed, side by side: outcomes, probes, beliefs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from PySide6.QtWidgets import QDialog, QHBoxLayout, QPushButton, QSpinBox, QVBoxLayout, QWidget

from backend.core.flow import Outcome
from widgets.belief_scene import BeliefScene
from widgets.belief_view import BeliefView
from widgets.number_inset import inset
from widgets.panel import Panel, label, set_property
from widgets.score_panel import OutcomeMarks
from widgets.theme import Theme


@dataclass(frozen=True, slots=True)
class RivalLook:
    """One strategy. ``count``: placed of tried; ``trial``: how the chosen trial went, in words."""

    title: str
    outcomes: tuple[Outcome, ...] = ()
    trials: int = 0
    count: str = "Not run yet"
    trial: str = ""
    good: bool | None = None
    scene: BeliefScene = field(default_factory=BeliefScene)


class RivalPanel(Panel):
    """One column of the comparison."""

    def __init__(self, theme: Theme) -> None:
        super().__init__("")
        self.count, self.marks = label("", "figure"), OutcomeMarks(theme)
        self.trial = label("", wrap=True)
        self.belief = BeliefView(theme)
        for widget in (self.count, self.marks, self.trial):
            self.column.addWidget(widget)
        self.column.addWidget(self.belief, 1)

    def show_look(self, look: RivalLook) -> None:
        """Show how a strategy did."""
        self.rename(look.title)
        self.count.setText(look.count)
        self.marks.show_outcomes(look.outcomes, look.trials)
        self.trial.setText(look.trial)
        set_property(self.trial, "tone", {True: "good", False: "bad", None: ""}[look.good])
        if self.belief.scene is not look.scene:
            self.belief.show_scene(look.scene)


class ComparisonSheet(QDialog):
    """``run`` asks for what is missing; ``choose`` is told the trial (from 1). Not modal."""

    def __init__(
        self, parent: QWidget, theme: Theme, run: Callable[[], None], choose: Callable[[int], None]
    ) -> None:
        super().__init__(parent)
        self._window = parent
        self.setWindowTitle("Strategies on the same seed")
        self.setModal(False)
        self.head = label("", "head", wrap=True)
        self.panels = RivalPanel(theme), RivalPanel(theme)
        self.trial = QSpinBox()
        self.trial.setRange(1, 1)
        inset(self.trial)
        self.trial.setAccessibleName("Trial")
        self.trial.setToolTip("The trial that is shown on both sides")
        self.trial.valueChanged.connect(choose)
        self.run, close = QPushButton("Run both"), QPushButton("Close")
        self.run.setProperty("role", "primary")
        self.run.setAutoDefault(False)
        self.run.clicked.connect(run)
        close.clicked.connect(self.close)
        top, columns = QHBoxLayout(), QHBoxLayout()
        buddy = label("Trial", "muted")
        buddy.setBuddy(self.trial)
        top.addWidget(self.head, 1)
        top.addWidget(buddy)
        top.addWidget(self.trial)
        columns.setSpacing(8)
        for panel in self.panels:
            columns.addWidget(panel, 1)
        foot = QHBoxLayout()
        foot.addStretch(1)
        foot.addWidget(close)
        foot.addWidget(self.run)
        column = QVBoxLayout(self)
        column.setContentsMargins(14, 12, 14, 12)
        column.setSpacing(8)
        column.addLayout(top)
        column.addLayout(columns, 1)
        column.addLayout(foot)

    def open_large(self) -> None:
        """Show it over most of its window."""
        room = self._window.size()
        self.resize(min(1040, room.width() - 120), min(640, room.height() - 120))
        self.show()
        self.raise_()
        self.activateWindow()

    def show_run(self, text: str, why_not: str) -> None:
        """Offer to run what is missing, or say why not; "" for ``text``: nothing is missing."""
        self.run.setVisible(bool(text))
        self.run.setText(text)
        self.run.setEnabled(not why_not)
        self.run.setToolTip(why_not or "One after the other, with the same seed")

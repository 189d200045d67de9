"""Two strategies on the same seed, side by side: outcomes, probes, beliefs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from PySide6.QtWidgets import (
    QComboBox,
    QDialog,
    QHBoxLayout,
    QPushButton,
    QSpinBox,
    QVBoxLayout,
    QWidget,
)

from backend.core.flow import Outcome
from widgets.belief_scene import BeliefScene
from widgets.belief_view import BeliefView
from widgets.number_inset import inset
from widgets.panel import Panel, label, set_property
from widgets.score_panel import OutcomeMarks
from widgets.theme import Theme


@dataclass(frozen=True, slots=True)
class RivalLook:
    """One strategy. ``count``: placed of tried; ``rate``: success with its interval, in words;
    ``trial``: how the chosen trial went.
    """

    title: str
    outcomes: tuple[Outcome, ...] = ()
    trials: int = 0
    count: str = "Not run yet"
    rate: str = ""
    trial: str = ""
    good: bool | None = None
    scene: BeliefScene = field(default_factory=BeliefScene)


class RivalPanel(Panel):
    """One column of the comparison."""

    def __init__(self, theme: Theme) -> None:
        super().__init__("")
        self.count, self.marks = label("", "figure"), OutcomeMarks(theme)
        self.rate = label("", "small", wrap=True)
        self.trial = label("", wrap=True)
        self.belief = BeliefView(theme)
        for widget in (self.count, self.marks, self.rate, self.trial):
            self.column.addWidget(widget)
        self.column.addWidget(self.belief, 1)

    def show_look(self, look: RivalLook) -> None:
        """Show how a strategy did."""
        self.rename(look.title)
        self.count.setText(look.count)
        self.rate.setText(look.rate)
        self.rate.setVisible(bool(look.rate))
        self.marks.show_outcomes(look.outcomes, look.trials)
        self.trial.setText(look.trial)
        set_property(self.trial, "tone", {True: "good", False: "bad", None: ""}[look.good])
        if self.belief.scene is not look.scene:
            self.belief.show_scene(look.scene)


class ComparisonSheet(QDialog):
    """``run`` asks for what is missing; ``choose`` is told the trial (from 1), ``against`` the
    strategy on the right. Not modal.
    """

    def __init__(
        self,
        parent: QWidget,
        theme: Theme,
        run: Callable[[], None],
        choose: Callable[[int], None],
        against: Callable[[str], None],
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
        self.against = QComboBox()
        self.against.setAccessibleName("Strategy to compare with")
        self.against.setToolTip("The strategy on the right")
        self.against.activated.connect(lambda at: against(self.against.itemData(at)))
        self.run = QPushButton("Run both")
        self.run.setProperty("role", "primary")
        self.run.setAutoDefault(False)
        self.run.clicked.connect(run)
        self._arrange()

    def _arrange(self) -> None:
        close = QPushButton("Close")
        close.clicked.connect(self.close)
        top, columns = QHBoxLayout(), QHBoxLayout()
        buddy = label("Trial", "muted")
        buddy.setBuddy(self.trial)
        versus = label("Against", "muted")
        versus.setBuddy(self.against)
        top.addWidget(self.head, 1)
        top.addWidget(versus)
        top.addWidget(self.against)
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

    def offer(self, rivals: Sequence[tuple[str, str]], chosen: str) -> None:
        """Offer these strategies (key, title) for the right side."""
        self.against.clear()
        for key, title in rivals:
            self.against.addItem(title, key)
        self.against.setCurrentIndex(self.against.findData(chosen))

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

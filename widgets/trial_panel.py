"""What a trial on devices wants of its operator: set the scene, hold the piece, say the outcome."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QKeyEvent
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLineEdit, QPushButton, QWidget

from backend.core.flow import Outcome
from widgets.offset_scene import OffsetScene
from widgets.offset_view import OffsetView
from widgets.panel import Panel, label, set_property
from widgets.theme import Theme

OUTCOMES: tuple[tuple[Outcome, str, str], ...] = (
    (Outcome.PLACED, "Stands  1", "The piece stands by itself"),
    (Outcome.FELL, "Fell  2", "The piece fell or leans"),
    (Outcome.KNOCKED_OVER, "Disturbed  3", "The bottom was moved or knocked over"),
    (Outcome.ABORTED, "Void\N{HORIZONTAL ELLIPSIS}  4", "It says nothing: write why, then press"),
)


@dataclass(frozen=True, slots=True)
class TrialLook:
    """One question. ``scene``: where the face starts over the bottom, None for no picture.

    ``yes``: text of its button, "" where an outcome is asked for; ``proposed`` stands out.
    """

    title: str
    text: str
    yes: str = ""
    scene: OffsetScene | None = None
    proposed: Outcome | None = None


@dataclass(frozen=True, slots=True)
class TrialIntents:
    """What the operator can answer; ``judge`` gets the outcome and the reason that was written."""

    answer: Callable[[bool], None]
    judge: Callable[[Outcome, str], None]
    photo: Callable[[], None]


class _Reason(QLineEdit):
    """A line whose Enter is its own, whatever Enter does on the page."""

    def event(self, event: QEvent) -> bool:
        """Claim Enter before a shortcut does."""
        if isinstance(event, QKeyEvent) and event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            event.accept()
        return super().event(event)


class TrialPanel(Panel):
    """Hidden while nothing is asked."""

    def __init__(self, theme: Theme, intents: TrialIntents) -> None:
        super().__init__("Your turn")
        self._intents = intents
        self.text = label("", wrap=True)
        self.picture = OffsetView(theme, _stay, _drop)
        self.picture.editable = False
        self.picture.setAccessibleName("Start of the trial, seen from above")
        self.yes, self.no = QPushButton("Ready"), QPushButton("Not now")
        self.yes.setProperty("role", "primary")
        self.outcomes = {outcome: QPushButton(text) for outcome, text, _ in OUTCOMES}
        self.reason = _Reason()
        self.reason.setPlaceholderText("Why (a void trial needs it)")
        self.reason.setAccessibleName("Why")
        self.reason.setMaxLength(200)
        self.photo = QPushButton("Photo\N{HORIZONTAL ELLIPSIS}")
        self.photo.setToolTip("Keep a picture of the bench with this trial")
        self._ready, self._judging = QWidget(), QWidget()
        self._arrange()
        self._wire()
        self.show_look(None)

    def show_look(self, look: TrialLook | None) -> None:
        """Show a question; None: nothing is asked."""
        self.setVisible(look is not None)
        if look is None:
            self.reason.clear()
            return
        self.rename(look.title)
        self.setAccessibleDescription(look.text)
        self.text.setText(look.text)
        self.picture.setVisible(look.scene is not None)
        if look.scene is not None:
            self.picture.show_scene(look.scene)
        self._ready.setVisible(bool(look.yes))
        self.yes.setText(look.yes)
        self._judging.setVisible(not look.yes)
        for outcome, button in self.outcomes.items():
            set_property(button, "role", "primary" if outcome is look.proposed else "")

    def judge(self, outcome: Outcome) -> None:
        """Give this outcome; a void trial without a reason asks for one."""
        reason = self.reason.text().strip()
        if outcome is Outcome.ABORTED and not reason:
            self.reason.setFocus()
        else:
            self._intents.judge(outcome, reason)

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        ready = QHBoxLayout(self._ready)
        ready.setContentsMargins(0, 0, 0, 0)
        ready.addStretch(1)
        ready.addWidget(self.no)
        ready.addWidget(self.yes)
        judging = QGridLayout(self._judging)
        judging.setContentsMargins(0, 0, 0, 0)
        judging.setSpacing(6)
        for column, (outcome, _, tip) in enumerate(OUTCOMES):
            self.outcomes[outcome].setToolTip(tip)
            judging.addWidget(self.outcomes[outcome], 0, column)
        judging.addWidget(self.reason, 1, 0, 1, 3)
        judging.addWidget(self.photo, 1, 3)
        self.column.addWidget(self.text)
        self.column.addWidget(self.picture, 1)
        self.column.addWidget(self._ready)
        self.column.addWidget(self._judging)

    def _wire(self) -> None:
        self.yes.clicked.connect(lambda: self._intents.answer(True))
        self.no.clicked.connect(lambda: self._intents.answer(False))
        self.photo.clicked.connect(self._intents.photo)
        self.no.setToolTip("End the run; nothing has moved")
        self.yes.setToolTip("Go on (Y)")
        self.reason.returnPressed.connect(lambda: self.judge(Outcome.ABORTED))
        for outcome, button in self.outcomes.items():
            button.clicked.connect(_judged(self, outcome))


def _judged(panel: TrialPanel, outcome: Outcome) -> Callable[[], None]:
    return lambda: panel.judge(outcome)


def _stay(_at_mm: tuple[float, float]) -> None:
    """Do nothing: the start is drawn by the run."""


def _drop() -> None:
    """Do nothing: nothing is dragged."""

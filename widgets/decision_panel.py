"""The decision in words: verdict, signed margin, chosen move and its reason; and the approval."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QFrame, QHBoxLayout, QPushButton, QVBoxLayout, QWidget

from backend.core.flow import PlaceAction, Stability, SupportKind
from widgets.panel import label, set_property

MINUS = "\N{MINUS SIGN}"
ESTIMATED, TRUE = "estimated margin", "true margin"


@dataclass(frozen=True, slots=True)
class DecisionText:
    """What the panel says. ``tone``: "good", "bad" or "" (no verdict).

    ``caption`` says what the margin is: estimated during a trial, true after a simulated one.
    """

    verdict: str
    tone: str
    margin: str
    text: str
    caption: str = ESTIMATED


NOTHING_YET = DecisionText("No verdict yet", "", "", "Press Start stacking to let the piece probe.")


def signed_mm(value: float) -> str:
    """Write a signed length with a true minus; infinite and NaN in words."""
    if math.isnan(value):
        return "no estimate"
    if math.isinf(value):
        return "no support"
    return f"{value:+.1f} mm".replace("-", MINUS)


def decide_in_words(stability: Stability | None, action: PlaceAction | None) -> DecisionText:
    """Put verdict and margin into words; the reason with its numbers is the backend's."""
    if stability is None:
        return NOTHING_YET
    if stability.support is SupportKind.NO_ESTIMATE or math.isnan(stability.margin_mm):
        verdict, tone = "? No estimate", ""
    elif stability.stable:
        verdict, tone = "\N{CHECK MARK} Would stand", "good"
    else:
        verdict, tone = "\N{MULTIPLICATION X} Would fall", "bad"
    reason = action.reason if action is not None else ""
    return DecisionText(verdict, tone, signed_mm(stability.margin_mm), reason)


class DecisionPanel(QFrame):
    """Verdict and margin on one line, the reason below, and the question if there is one."""

    def __init__(self, on_approve: Callable[[], None], on_decline: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "card")
        self.setAccessibleName("Decision")
        self._verdict = label("", "figure")
        self._margin = label("", "figure")
        self._caption = label(ESTIMATED, "small")
        self._text = label("", wrap=True)
        self._text.setAlignment(Qt.AlignmentFlag.AlignTop | Qt.AlignmentFlag.AlignLeft)
        self._text.setMinimumHeight(2 * self.fontMetrics().lineSpacing() + 4)
        self.approve = QPushButton("Approve  A")
        self.approve.setProperty("role", "primary")
        self.approve.setToolTip("Carry out this move (A; N in step mode)")
        self.approve.clicked.connect(on_approve)
        self.decline = QPushButton("Decline")
        self.decline.setToolTip("Do not carry it out: the trial ends, the piece stays held")
        self.decline.clicked.connect(on_decline)
        self._asking = QWidget()
        self._arrange()
        self.show_text(NOTHING_YET)
        self.show_question("")

    def _arrange(self) -> None:
        top = QHBoxLayout()
        top.addWidget(self._verdict)
        top.addStretch(1)
        top.addWidget(self._caption, 0, Qt.AlignmentFlag.AlignBottom)
        top.addWidget(self._margin)
        asking = QHBoxLayout(self._asking)
        asking.setContentsMargins(0, 0, 0, 0)
        self._ask_text = label("", "title", wrap=True)
        asking.addWidget(self._ask_text, 1)
        asking.addWidget(self.decline)
        asking.addWidget(self.approve)
        column = QVBoxLayout(self)
        column.setContentsMargins(12, 8, 12, 8)
        column.setSpacing(4)
        column.addLayout(top)
        column.addWidget(self._text)
        column.addWidget(self._asking)

    def show_text(self, text: DecisionText) -> None:
        """Show a decision."""
        self._verdict.setText(text.verdict)
        self._margin.setText(text.margin)
        self._caption.setText(text.caption)
        self._caption.setVisible(bool(text.margin))
        self._text.setText(text.text)
        self._text.setToolTip(text.text)
        for part in (self._verdict, self._margin):
            set_property(part, "tone", text.tone)
        margin = f"{text.caption} {text.margin}. " if text.margin else ""
        self.setAccessibleDescription(f"{text.verdict}. {margin}{text.text}")

    def keep_room(self, asks: bool) -> None:
        """Keep the place of the question where one will come: the views below stay put."""
        policy = self._asking.sizePolicy()
        if policy.retainSizeWhenHidden() != asks:
            policy.setRetainSizeWhenHidden(asks)
            self._asking.setSizePolicy(policy)

    def show_question(self, text: str, button: str = "Approve  A") -> None:
        """Ask for approval; the empty text withdraws the question."""
        self._ask_text.setText(text)
        self.approve.setText(button)
        self._asking.setVisible(bool(text))

"""Decision of the policy, in numbers."""

from __future__ import annotations

import math
from dataclasses import dataclass

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QFrame, QGridLayout, QWidget

from touchdown.backend.core import Outcome, PlaceAction, Stability, SupportKind
from touchdown.widgets import base
from touchdown.widgets.forms import NameField
from touchdown.widgets.views.belief import HULL
from touchdown.widgets.views.offset import OffsetScene, OffsetView

OUTCOMES: tuple[tuple[Outcome, str, str], ...] = (
    (Outcome.PLACED, "Stands  1", "The piece stands by itself"),
    (Outcome.FELL, "Fell  2", "The piece fell or leans"),
    (Outcome.KNOCKED_OVER, "Disturbed  3", "The bottom was moved or knocked over"),
    (
        Outcome.ABORTED,
        "Void\N{HORIZONTAL ELLIPSIS}  4",
        "The trial is listed as aborted and counts as a failure; give the reason first",
    ),
)


@dataclass(frozen=True, slots=True)
class TrialPrompt:
    """Question to the operator. ``scene``: start of the face over the bottom, None for no picture.

    ``yes``: label of the confirm button, "" where an outcome is asked for. ``proposed``: the
    outcome to highlight.
    """

    title: str
    text: str
    yes: str = ""
    scene: OffsetScene | None = None
    proposed: Outcome | None = None


class TrialPanel(base.Panel):
    """Question to the operator during a trial; hidden if there is none."""

    answered = Signal(bool)
    judged = Signal(object, str)  # outcome, written reason

    def __init__(self, theme: base.Theme) -> None:
        super().__init__("Your turn")
        self.text = base.label("", wrap=True)
        self.picture = OffsetView(theme, lambda _: None, lambda: None)
        self.picture.editable = False
        self.picture.setAccessibleName(base.tr("Start of the trial, seen from above"))
        self.yes = base.push_button("Ready", "Continue (Y)", role="primary")
        self.no = base.push_button("Not now", "End the run; nothing has moved")
        self.outcomes = {outcome: base.push_button(text) for outcome, text, _ in OUTCOMES}
        self.reason = NameField()
        self.reason.setPlaceholderText(base.tr("Reason (required for a void trial)"))
        self.reason.setAccessibleName(base.tr("Reason"))
        self.reason.setMaxLength(200)
        tip = "Store a photo of the bench with this trial"
        self.photo = base.push_button("Photo\N{HORIZONTAL ELLIPSIS}", tip)
        self._ready, self._judging = QWidget(), QWidget()
        self._arrange()
        self.yes.clicked.connect(lambda: self.answered.emit(True))
        self.no.clicked.connect(lambda: self.answered.emit(False))
        self.reason.returnPressed.connect(lambda: self.judge(Outcome.ABORTED))
        for outcome, button in self.outcomes.items():
            button.clicked.connect(lambda _=False, outcome=outcome: self.judge(outcome))
        self.show_look(None)

    def show_look(self, look: TrialPrompt | None) -> None:
        """Show a question, or None to hide the panel."""
        self.setVisible(look is not None)
        if look is None:
            self.reason.clear()
            return
        self.rename(look.title)
        self.setAccessibleDescription(base.tr(look.text))
        self.text.setText(base.tr(look.text))
        self.picture.setVisible(look.scene is not None)
        if look.scene is not None:
            self.picture.show_scene(look.scene)
        self._ready.setVisible(bool(look.yes))
        self.yes.setText(base.tr(look.yes))
        self._judging.setVisible(not look.yes)
        for outcome, button in self.outcomes.items():
            base.set_property(button, "role", "primary" if outcome is look.proposed else "")

    def judge(self, outcome: Outcome) -> None:
        """Report this outcome; a void trial needs a reason first."""
        reason = self.reason.text().strip()
        if outcome is Outcome.ABORTED and not reason:
            self.reason.setFocus()
        else:
            self.judged.emit(outcome, reason)

    def _arrange(self) -> None:
        base.hbox(1, self.no, self.yes, parent=self._ready, margins=(0, 0, 0, 0))
        judging = QGridLayout(self._judging)
        judging.setContentsMargins(0, 0, 0, 0)
        judging.setSpacing(6)
        for column, (outcome, _, tip) in enumerate(OUTCOMES):
            self.outcomes[outcome].setToolTip(base.tr(tip))
            judging.addWidget(self.outcomes[outcome], 0, column)
        judging.addWidget(self.reason, 1, 0, 1, 3)
        judging.addWidget(self.photo, 1, 3)
        base.add_items(self.column, self.text, (self.picture, 1), self._ready, self._judging)


ESTIMATED_MARGIN, TRUE_MARGIN = "est. margin", "true margin"
DECLINING = "Decline ends the trial; the piece stays in the gripper."


@dataclass(frozen=True, slots=True)
class DecisionText:
    """Texts of a decision. ``tone``: "good", "bad" or "" (no result).

    ``caption``: kind of margin, estimated during a trial, true after a simulated one.
    """

    result: str
    tone: str
    margin: str
    text: str
    caption: str = ESTIMATED_MARGIN


NO_DECISION = DecisionText("No result yet", "", "", "Press Start stacking to begin.")


def signed_mm(value: float) -> str:
    """Format a signed length with a true minus sign; infinite and NaN as words."""
    if math.isnan(value):
        return base.tr("no estimate")
    if math.isinf(value):
        return base.tr("no support")
    return f"{base.signed(value, 1)} mm"


def decision_text(stability: Stability | None, action: PlaceAction | None) -> DecisionText:
    """Return stability and margin as text; the reason comes from the policy."""
    if stability is None:
        return NO_DECISION
    if stability.support is SupportKind.NO_ESTIMATE or math.isnan(stability.margin_mm):
        result, tone = "? No estimate", ""
    elif stability.stable:
        result, tone = "\N{CHECK MARK} Would stand here", "good"
    else:
        result, tone = "\N{MULTIPLICATION X} Would fall here", "bad"
    reason = action.reason if action is not None else ""
    return DecisionText(result, tone, signed_mm(stability.margin_mm), reason)


def question_text(action: PlaceAction) -> tuple[str, str]:
    """Return the question before a step that waits for approval, and the label of its button."""
    if action.kind == "release":
        return "Press once more and release here?", "Release"
    if action.kind != "shift":
        return "Go on probing?", "Go on"
    return "Take this step and probe again?", "Move and probe"


class DecisionPanel(QFrame):
    """Stability and margin on one line, the reason below, then the question if there is one."""

    def __init__(self) -> None:
        super().__init__()
        self.setProperty("role", "card")
        self.setAccessibleName(base.tr("Decision"))
        self._result = base.label("", "figure")
        self._margin = base.label("", "figure")
        self._caption = base.label(ESTIMATED_MARGIN, "small")
        self._text = base.label("", wrap=True)
        self._text.setAlignment(Qt.AlignmentFlag.AlignTop | Qt.AlignmentFlag.AlignLeft)
        self._text.setMinimumHeight(2 * self.fontMetrics().lineSpacing() + 4)
        tip = "Approve this step (A; N in step mode)"
        self.approve = base.push_button("Approve  A", tip, role="primary")
        self.decline = base.push_button("Decline  D", DECLINING)
        self._asking = QWidget()
        self._arrange()
        self.show_text(NO_DECISION)
        self.show_question("")

    def _arrange(self) -> None:
        top = base.hbox(self._result, 1)
        top.addWidget(self._caption, 0, Qt.AlignmentFlag.AlignBottom)
        top.addWidget(self._margin)
        self._ask_text = base.label("", "title", wrap=True)
        low = base.label(DECLINING, "small", wrap=True)
        answers = base.hbox((low, 1), self.decline, self.approve)
        base.vbox(self._ask_text, answers, parent=self._asking, margins=(0, 0, 0, 0), spacing=2)
        base.vbox(top, self._text, self._asking, parent=self, margins=(10, 8, 10, 8), spacing=4)

    def show_text(self, text: DecisionText) -> None:
        """Show a decision."""
        self._result.setText(base.tr(text.result))
        self._margin.setText(text.margin)
        self._caption.setText(base.tr(text.caption))
        self._caption.setVisible(bool(text.margin))
        self._text.setText(base.tr(text.text))
        self._text.setToolTip(base.tr(HULL if "hull" in text.text else text.text))
        for part in (self._result, self._margin):
            base.set_property(part, "tone", text.tone)
        margin = f"{base.tr(text.caption)} {text.margin}. " if text.margin else ""
        self.setAccessibleDescription(f"{base.tr(text.result)}. {margin}{base.tr(text.text)}")

    def keep_room(self, asks: bool) -> None:
        """Reserve room for a question in runs that ask, so that the views below do not move."""
        policy = self._asking.sizePolicy()
        if policy.retainSizeWhenHidden() != asks:
            policy.setRetainSizeWhenHidden(asks)
            self._asking.setSizePolicy(policy)

    def show_question(self, text: str, button: str = "Approve  A") -> None:
        """Ask for approval; an empty text withdraws the question."""
        self._ask_text.setText(base.tr(text))
        self.approve.setText(base.tr(button))
        self._asking.setVisible(bool(text))

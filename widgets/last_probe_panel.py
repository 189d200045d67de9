"""What the last probe was worth, and the keys that say what becomes of it. Never modal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QGridLayout, QPushButton

from widgets.elided import ElidedLabel
from widgets.panel import Panel, label, set_property

DECISIONS: tuple[tuple[str, str, str], ...] = (
    ("keep", "Keep", "Enter"),
    ("discard", "Discard", "Backspace"),
    ("flag", "Flag", "X"),
    ("redo", "Redo", "R"),
    ("skip", "Skip", "S"),
)
TIPS = {
    "keep": "Keep the probe and go on (Enter, F5)",
    "discard": "Delete it; its place is probed again at the end (Backspace)",
    "flag": "Keep it with a flag, to be looked at (X)",
    "redo": "Delete it and probe the same place again at once (R)",
    "skip": "Delete it and leave its place out (S)",
}


@dataclass(frozen=True, slots=True)
class ProbeWords:
    """A probe in words. ``tone``: good, bad or "". ``asking``: the run waits for the answer."""

    verdict: str
    tone: str = ""
    where: str = ""
    detail: str = ""
    asking: bool = False
    allowed: tuple[str, ...] = ()


class LastProbePanel(Panel):
    """Verdict, displacement, and one button per decision."""

    def __init__(self, decide: Callable[[str], None]) -> None:
        super().__init__("Probe")
        self.verdict = label("No probe yet", "head", wrap=True)
        self.where, self.words = ElidedLabel("small"), label("", "small", wrap=True)
        self.words.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.words.setMinimumHeight(2 * self.fontMetrics().lineSpacing())
        self.buttons: dict[str, QPushButton] = {}
        grid = QGridLayout()
        grid.setSpacing(6)
        for at, (name, text, key) in enumerate(DECISIONS):
            button = QPushButton(f"{text}  ({key})")
            button.setAccessibleName(text)
            button.setToolTip(TIPS[name])
            button.setFocusPolicy(Qt.FocusPolicy.NoFocus)
            button.clicked.connect(lambda _=False, name=name: decide(name))
            self.buttons[name] = button
            row, column, span = (0, 3 * at, 3) if at < 2 else (1, 2 * (at - 2), 2)
            grid.addWidget(button, row, column, 1, span)
        for widget in (self.verdict, self.where, self.words):
            self.column.addWidget(widget)
        self.column.addLayout(grid)
        self.show_words(ProbeWords("No probe yet"))

    def show_words(self, words: ProbeWords) -> None:
        """Show what is known of the probe; only ``allowed`` decisions can be taken."""
        self.verdict.setText(words.verdict)
        set_property(self.verdict, "tone", words.tone)
        self.where.setText(words.where)
        self.words.setText(words.detail)
        self.detail.setText("waiting for you" if words.asking else "")
        for name, button in self.buttons.items():
            button.setEnabled(name in words.allowed)
        self.setAccessibleDescription(". ".join((words.verdict, words.where, words.detail)))


class HealthPanel(Panel):
    """What looks wrong in what was collected: a line each, the worst first."""

    MOST = 4

    def __init__(self) -> None:
        super().__init__("Health")
        self.words = label("Nothing to judge yet.", "small", wrap=True)
        self.words.setAlignment(Qt.AlignmentFlag.AlignTop)
        self.column.addWidget(self.words, 1)

    def show_findings(self, texts: Sequence[str], *, judged: int) -> None:
        """Show findings about ``judged`` probes; the tool tip has all of them."""
        probes = "1 probe" if judged == 1 else f"{judged} probes"
        self.detail.setText(f"{len(texts)} in {probes}" if texts else probes)
        if not judged:
            self.words.setText("Nothing to judge yet.")
        elif not texts:
            self.words.setText("\N{CHECK MARK} Nothing looks wrong.")
        else:
            more = len(texts) - self.MOST
            tail = [f"and {more} more"] if more > 0 else []
            self.words.setText("\n".join([*texts[: self.MOST], *tail]))
        self.words.setToolTip("\n".join(texts[:40]))

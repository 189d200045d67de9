"""What stands in place of an episode where there is none: why, and the one thing to do about it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QPushButton, QVBoxLayout, QWidget

from widgets.panel import label


@dataclass(frozen=True, slots=True)
class Nothing:
    """Why nothing is shown. ``button`` says what ``command`` (its name) does about it.

    Without a button there is only to wait.
    """

    title: str
    why: str
    button: str
    command: str


OTHER = "Choose another queue (Ctrl+J)", "queue"
SCORE = "Let the model score the dataset (Ctrl+M)", "score"
NOBODY = Nothing(
    "Nobody is named yet",
    "What is to be labelled depends on who labels.",
    "Give your name (Ctrl+U)",
    "person",
)
NO_PROBES = Nothing(
    "There are no probes yet",
    "Every probe that is collected waits here for its label.",
    "Collect probes (F2)",
    "collect",
)
LOADING = Nothing("Loading the episode", "Its pictures and forces are being read.", "", "")
UNREADABLE = Nothing(
    "This episode cannot be read",
    "The line below says why; its label stays as it is.",
    "Go to the next one (PgDown)",
    "next",
)
LABELLED = "Every probe has a label that was accepted or rejected."
NOT_SCORED = "The model has not looked for such labels yet, or none is left."
EMPTY_QUEUES = {
    "unlabelled": Nothing("Nothing is left to label", LABELLED, *OTHER),
    "review": Nothing(
        "Nothing waits for your review", "What you labelled is for others to review.", *OTHER
    ),
    "returned": Nothing("Nothing of yours was rejected", "No label came back to you.", *OTHER),
    "conflicts": Nothing("There are no conflicts", "No merge left an episode two labels.", *OTHER),
    **{
        name: Nothing("Nothing is in this queue", NOT_SCORED, *SCORE)
        for name in ("doubt", "disagreement", "uncertainty", "duplicates")
    },
}
EMPTY = Nothing("Nothing is in this queue", "No episode is what it asks for.", *OTHER)


class NothingHere(QWidget):
    """Says in the middle why there is nothing; ``act`` is told the command of the button."""

    def __init__(self, act: Callable[[str], None]) -> None:
        super().__init__()
        self.shown = EMPTY
        self.title, self.why = label("", "head", wrap=True), label("", "muted", wrap=True)
        self.button = QPushButton()
        self.button.setProperty("role", "primary")
        self.button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.button.clicked.connect(lambda: act(self.shown.command))
        column = QVBoxLayout(self)
        column.setSpacing(8)
        column.addStretch(2)
        for widget in (self.title, self.why):
            widget.setAlignment(Qt.AlignmentFlag.AlignCenter)
            column.addWidget(widget)
        column.addSpacing(4)
        column.addWidget(self.button, 0, Qt.AlignmentFlag.AlignHCenter)
        column.addStretch(3)
        self.show_why(EMPTY)
        self.hide()

    def show_why(self, nothing: Nothing) -> None:
        """Show another reason."""
        self.shown = nothing
        self.title.setText(nothing.title)
        self.why.setText(nothing.why)
        self.button.setText(nothing.button)
        self.button.setVisible(bool(nothing.button))
        self.setAccessibleName(nothing.title)
        self.setAccessibleDescription(nothing.why)

"""One row per command: name, text, key, what it does. Keys never clash and never mean STOP."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtGui import QAction, QKeySequence
from PySide6.QtWidgets import QWidget

from app.stop_key import typing


@dataclass(frozen=True, slots=True)
class Command:
    """``plain``: a single letter, off while a text field has the focus."""

    name: str
    text: str
    key: str
    plain: bool = False


COMMANDS: tuple[Command, ...] = (
    Command("start", "Start stacking", "Ctrl+Return"),
    Command("step", "Next step: carry out the move that waits", "N", plain=True),
    Command("approve", "Approve the move that waits", "A", plain=True),
    Command("pause", "Pause or resume", "P", plain=True),
    Command("stack", "Stack workspace", "Ctrl+1"),
    Command("review", "Review workspace", "Ctrl+2"),
    Command("fit", "Fit the force and moment ranges", "Ctrl+F"),
    Command("theme", "Next theme: dark, light, high contrast", "Ctrl+T"),
    Command("larger", "Larger text", "Ctrl++"),
    Command("smaller", "Smaller text", "Ctrl+-"),
    Command("keys", "Key sheet", "F1"),
    Command("fullscreen", "Full screen", "F11"),
    Command("quit", "Quit", "Ctrl+Q"),
)

STOP_ROWS: tuple[tuple[str, str], ...] = (
    ("F12", "STOP motion (software), always"),
    ("Space", "STOP motion while something moves and no text field has the focus"),
)


def key_rows() -> Sequence[tuple[str, str]]:
    """Return the rows of the key sheet."""
    return (*STOP_ROWS, *((c.key, c.text) for c in COMMANDS))


class Actions:
    """The commands as Qt actions of one window."""

    def __init__(self, window: QWidget, slots: Mapping[str, Callable[[], None]]) -> None:
        self._rows: dict[str, _Bound] = {}
        for command in COMMANDS:
            bound = _Bound(window, command, slots[command.name])
            window.addAction(bound.action)
            self._rows[command.name] = bound

    def action(self, name: str) -> QAction:
        """Return one action."""
        return self._rows[name].action


class _Bound:
    """One command, its action, and the rule for plain letters."""

    def __init__(self, window: QWidget, command: Command, slot: Callable[[], None]) -> None:
        self._command, self._slot = command, slot
        self.action = QAction(command.text, window)
        self.action.setShortcut(QKeySequence(command.key))
        self.action.setAutoRepeat(False)
        self.action.triggered.connect(self._run)

    def _run(self) -> None:
        if not (self._command.plain and typing()):
            self._slot()

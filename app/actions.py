"""The commands as Qt actions: those of the workspace in front and those of everywhere are on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from PySide6.QtGui import QAction, QKeySequence
from PySide6.QtWidgets import QWidget

from app.keys import EVERYWHERE, Row, plain, refusal, remapped
from app.stop_key import typing
from widgets.choice_bar import BESIDE


class Actions:
    """One action per row that has a command; keys never clash within a context."""

    def __init__(self, window: QWidget, rows: Sequence[Row], changed: Mapping[str, str]) -> None:
        self.rows, self.refused = remapped(rows, changed)
        self.changed = {k: v for k, v in changed.items() if k not in self.refused}
        self._first = {row.id: row.key for row in rows}
        self._bound = {
            row.id: _Bound(window, row, on=row.context == EVERYWHERE)
            for row in self.rows
            if row.command is not None
        }

    def action(self, name: str) -> QAction:
        """Return one action by the id of its row; raises KeyError."""
        return self._bound[name].action

    def enter(self, context: str) -> None:
        """Switch the keys to the workspace that came to the front."""
        for bound in self._bound.values():
            bound.action.setEnabled(bound.row.context in (EVERYWHERE, context))

    def change_key(self, name: str, key: str) -> str:
        """Give command ``name`` another key; return "" or why it keeps its own."""
        reason = refusal(self.rows, name, key)
        if reason:
            return reason
        self.rows, _ = remapped(self.rows, {name: key})
        bound = self._bound[name]
        bound.take(next(row for row in self.rows if row.id == name))
        if bound.row.key == self._first[name]:
            self.changed.pop(name, None)
        else:
            self.changed[name] = bound.row.key
        return ""


class _Bound:
    """One command, its action, and the rule for keys that could be typed."""

    def __init__(self, window: QWidget, row: Row, *, on: bool) -> None:
        assert row.command is not None
        self._run_command = row.command.run
        self.action = QAction(row.text, window)
        self.action.setAutoRepeat(row.command.repeats)
        self.action.setProperty(BESIDE, row.command.beside)
        self.action.triggered.connect(self._run)
        self.action.setEnabled(on)
        self.take(row)
        window.addAction(self.action)

    def take(self, row: Row) -> None:
        """Take another key."""
        self.row = row
        self.action.setShortcut(QKeySequence(row.key))
        tip = f"{row.text} ({row.key})" if row.key else row.text
        self.action.setToolTip(tip)

    def _run(self) -> None:
        if not (plain(self.row.key) and typing()):
            self._run_command()

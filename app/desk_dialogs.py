"""Key sheet, command palette and the change of a key: all from the rows of the actions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from PySide6.QtWidgets import QWidget

from app.actions import Actions
from app.keys import EVERYWHERE, Row
from app.layouts import Entry
from widgets.command_palette import Choice, CommandPalette
from widgets.key_asker import KeyAsker
from widgets.key_sheet import KeySheet

CHANGE, MORE = "key:", "more:"
"""Prefixes of the palette's entries that change a key, and of those that come and go."""


class DeskDialogs:
    """Made when first needed; none of them is modal."""

    def __init__(
        self, window: QWidget, actions: Actions, go: Callable[[str], None],
        changed: Callable[[], None],
    ) -> None:  # fmt: skip
        self._window, self._actions, self._go, self._changed = window, actions, go, changed
        self.more: Callable[[], Sequence[Entry]] = tuple
        """Further entries of the palette, those that come and go: (text, act)."""
        self._offered: Sequence[Entry] = ()
        self.sheet: KeySheet | None = None
        self.palette: CommandPalette | None = None
        self.asker: KeyAsker | None = None

    def show_keys(self) -> None:
        """Show all keys as they are now."""
        if self.sheet is None:
            self.sheet = KeySheet(self._window)
        self.sheet.show_rows([(row.title, row.key, row.text) for row in self._actions.rows])

    def show_palette(self) -> None:
        """Show everything that can be done."""
        if self.palette is None:
            self.palette = CommandPalette(self._window, self._chosen)
        self.palette.open_with(self._choices())

    def _choices(self) -> list[Choice]:
        rows = [row for row in self._actions.rows if row.command is not None]
        acts = [Choice(row.id, row.title, row.text, row.key) for row in rows]
        self._offered = self.more()
        acts += [
            Choice(f"{MORE}{at}", "Here", text, "") for at, (text, _) in enumerate(self._offered)
        ]
        return acts + [
            Choice(CHANGE + row.id, row.title, f"Change key of: {row.text}", "") for row in rows
        ]

    def _chosen(self, name: str) -> None:
        if name.startswith(CHANGE):
            row = self._row(name.removeprefix(CHANGE))
            if self.asker is None:
                self.asker = KeyAsker(self._window)
            self.asker.ask(row.text, row.key, partial(self._change, row.id))
            return
        if name.startswith(MORE):
            self._offered[int(name.removeprefix(MORE))][1]()
            return
        row = self._row(name)
        if row.context != EVERYWHERE:
            self._go(row.context)
        self._actions.action(name).trigger()

    def _change(self, name: str, key: str) -> str:
        reason = self._actions.change_key(name, key)
        if not reason:
            self._changed()
        return reason

    def _row(self, name: str) -> Row:
        return next(row for row in self._actions.rows if row.id == name)

"""The menu of the layouts: what can be done with the one of the workspace in front."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from PySide6.QtCore import QPoint
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMenu, QWidget

from app.layouts import USUAL, Layouts
from widgets.name_asker import NameAsker


class LayoutMenu:
    """``front`` names the workspace in front, ``reset`` puts its page and the window back."""

    def __init__(
        self, window: QWidget, layouts: Layouts, front: Callable[[], str], reset: QAction
    ) -> None:
        self._window, self._layouts, self._front, self._reset = window, layouts, front, reset
        self.menu = QMenu(window)
        self.asker: NameAsker | None = None

    def show(self, beside: QWidget) -> None:
        """Open the menu beside a button; nothing waits for it."""
        self.menu.clear()
        self._fill(self._front())
        corner = beside.mapToGlobal(QPoint(beside.width() + 4, beside.height()))
        self.menu.popup(corner - QPoint(0, self.menu.sizeHint().height()))

    def ask_name(self) -> None:
        """Ask for the name of a layout and save it."""
        front = self._front()
        if not self._layouts.has(front):
            return
        if self.asker is None:
            self.asker = NameAsker(self._window, "Save the layout")
        taken = self._layouts.names(front)
        self.asker.ask("Name of this layout", taken, partial(self._layouts.save, front))

    def _fill(self, front: str) -> None:
        layouts = self._layouts
        if not layouts.has(front):
            self._add("This workspace has one layout", None).setEnabled(False)
            self.menu.addAction(self._reset)
            return
        present = layouts.present(front)
        for name in (USUAL, *layouts.names(front)):
            self._add(name, partial(layouts.choose, front, name), checked=name == present)
        self._add("Save under a name \N{HORIZONTAL ELLIPSIS}", self.ask_name)
        for name in layouts.names(front):
            self._add(f"Delete '{name}'", partial(layouts.delete, front, name))
        self.menu.addSeparator()
        self._add("Locked", layouts.toggle_lock, checked=layouts.locked)
        for title, shown in layouts.panels(front):
            act = self._add(title, partial(layouts.turn_panel, front, title), checked=shown)
            act.setEnabled(not layouts.locked)
        self.menu.addSeparator()
        self.menu.addAction(self._reset)

    def _add(
        self, text: str, act: Callable[[], object] | None, *, checked: bool | None = None
    ) -> QAction:
        made = QAction(text.replace("&", "&&"), self.menu)
        if checked is not None:
            made.setCheckable(True)
            made.setChecked(checked)
        if act is not None:
            # A menu hands over whether the entry is checked; the act knows by itself.
            made.triggered.connect(lambda _checked=False, run=act: run())
        self.menu.addAction(made)
        return made

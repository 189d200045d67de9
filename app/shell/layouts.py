"""Saved window layouts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path

from pydantic import ValidationError
from PySide6.QtCore import QPoint
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QMenu, QWidget

from touchdown.app.shell.settings import kept_aside, parse_stored, read_stored, write_stored
from touchdown.widgets.base import ColumnArrangement, Columns, tr
from touchdown.widgets.forms import NameDialog

VERSION = 1
LONGEST_NAME = 40
LayoutKey = dict[str, ColumnArrangement]


@dataclass(slots=True)
class SavedLayouts:
    """``present`` layout by workspace; ``saved`` by workspace and name.

    ``locked``: edges are fixed.
    """

    locked: bool = True
    present: LayoutKey = field(default_factory=dict)
    saved: dict[str, LayoutKey] = field(default_factory=dict)


def load_layouts(path: Path) -> tuple[SavedLayouts, str]:
    """Return (layouts, notice). Of an invalid file the usual ones are used."""
    raw, wrong = read_stored(path, VERSION, "layouts")
    if not raw:
        return SavedLayouts(), kept_aside(path, f"{wrong} {tr(INSTEAD)}") if wrong else ""
    missing = [one.name for one in fields(SavedLayouts) if one.name not in raw]
    try:
        book: SavedLayouts = parse_stored(SavedLayouts, {} if missing else raw)
    except ValidationError as error:
        missing = [".".join(map(str, error.errors()[0]["loc"]))]
    if missing:
        wrong = tr("The layouts make no sense ({}). {}", missing[0], tr(INSTEAD))
        return SavedLayouts(), kept_aside(path, wrong)
    return book, ""


INSTEAD = "The usual ones are used."
USUAL = "Usual"


class LayoutsPresenter:
    """Layouts of the workspaces. ``tell`` shows a sentence, ``failed`` receives disk errors.

    The stored layout of a workspace is checked and applied when its page is created.
    """

    def __init__(
        self, path: Path, tell: Callable[[str], None], failed: Callable[[OSError], None]
    ) -> None:
        self._path, self._tell, self._failed = path, tell, failed
        self._columns: dict[str, Columns] = {}
        self.book = SavedLayouts()

    def load(self, workspaces: Collection[str]) -> str:
        """Read the stored layouts of these workspaces; return a notice, "" if they are valid."""
        self.book, notice = load_layouts(self._path)
        unknown = [name for name in self.book.present if name not in workspaces]
        return self._without(dict.fromkeys(unknown, tr("no such workspace"))) or notice

    def add(self, workspace: str, columns: Columns | None) -> str:
        """Apply the stored layout to a new page; return a notice, "" if it is valid.

        Without columns the page has one fixed layout.
        """
        wanted, notice = self.book.present.get(workspace), ""
        if wanted is not None:
            misfit = tr("no columns") if columns is None else columns.misfit(wanted)
            notice = self._without({workspace: misfit} if misfit else {})
        if columns is not None:
            self._columns[workspace] = columns
            columns.show_arrangement(self.book.present.get(workspace, columns.usual))
            columns.lock(self.book.locked)
        return notice

    def remember(self) -> None:
        """Write the present layouts of all workspaces."""
        for name, columns in self._columns.items():
            self.book.present[name] = columns.arrangement()
        try:
            write_stored(self._path, VERSION, self.book)
        except OSError as error:
            self._failed(error)

    def has(self, workspace: str) -> bool:
        """Return True if the workspace can be arranged."""
        return workspace in self._columns

    @property
    def locked(self) -> bool:
        """True while edges and panels are fixed."""
        return self.book.locked

    def toggle_lock(self) -> None:
        """Lock or unlock the layout."""
        self.book.locked = not self.book.locked
        for columns in self._columns.values():
            columns.lock(self.book.locked)
        self._tell(
            "The layout is locked."
            if self.locked
            else "The layout is unlocked: drag the edges between the columns, leave panels out."
        )
        self.remember()

    def names(self, workspace: str) -> tuple[str, ...]:
        """Return the names of the saved layouts of a workspace."""
        return tuple(self.book.saved.get(workspace, {}))

    def present(self, workspace: str) -> str:
        """Return the name of the present layout, "" if it has none."""
        columns = self._columns[workspace]
        now = columns.arrangement()
        known = {USUAL: columns.usual, **self.book.saved.get(workspace, {})}
        return next((name for name, saved in known.items() if _same(saved, now)), "")

    def save(self, workspace: str, name: str) -> str:
        """Save the present layout as ``name``; return "" or the reason of refusal."""
        name = name.strip()
        if not name or len(name) > LONGEST_NAME:
            return tr("A name has 1 to {} letters.", LONGEST_NAME)
        if name == USUAL:
            return tr("'{}' is the layout of the first start.", tr(USUAL))
        self.book.saved.setdefault(workspace, {})[name] = self._columns[workspace].arrangement()
        self.remember()
        self._tell(tr("The layout is saved as '{}'.", name))
        return ""

    def choose(self, workspace: str, name: str) -> None:
        """Show a saved layout, or the default one."""
        columns = self._columns[workspace]
        wanted = columns.usual if name == USUAL else self.book.saved[workspace][name]
        wrong = columns.misfit(wanted)
        if wrong:
            self._tell(tr("The layout '{}' does not fit this version: {}.", name, wrong))
            return
        columns.show_arrangement(wanted)
        self.remember()

    def delete(self, workspace: str, name: str) -> None:
        """Delete a saved layout; the present arrangement stays."""
        self.book.saved.get(workspace, {}).pop(name, None)
        self.remember()

    def reset(self, workspace: str) -> None:
        """Show the default layout, also while locked."""
        if self.has(workspace):
            self.choose(workspace, USUAL)

    def turn_panel(self, workspace: str, title: str) -> None:
        """Show or hide a panel; not possible while locked."""
        columns = self._columns[workspace]
        if self.locked:
            self._tell("The layout is locked: unlock it first.")
            return
        columns.show_panel(title, shown=columns.hides(title))
        self.remember()

    def panels(self, workspace: str) -> list[tuple[str, bool]]:
        """Return the panels that can be hidden, with their visibility."""
        columns = self._columns[workspace]
        return [(title, not columns.hides(title)) for title in columns.panels]

    def _without(self, wrong: Mapping[str, str]) -> str:
        """Remove layouts that do not fit, given with the reason; return the notice."""
        if not wrong:
            return ""
        told = ", ".join(f"{name} ({reason})" for name, reason in wrong.items())
        what = tr("Layouts that do not fit this version: {}.", told)
        notice = kept_aside(self._path, f"{what} {tr(INSTEAD)}")
        for name in wrong:
            del self.book.present[name]
        return notice


def _same(one: ColumnArrangement, other: ColumnArrangement) -> bool:
    close = all(abs(a - b) < 1e-4 for a, b in zip(one.shares, other.shares, strict=False))
    return close and one.hidden == other.hidden


class LayoutMenu:
    """Menu of the layouts. ``front`` returns the name of the workspace in front."""

    def __init__(
        self, window: QWidget, layouts: LayoutsPresenter, front: Callable[[], str], reset: QAction
    ) -> None:
        self._window, self._layouts, self._front, self._reset = window, layouts, front, reset
        self.menu = QMenu(window)
        self.asker: NameDialog | None = None

    def show(self, beside: QWidget) -> None:
        """Open the menu beside a button, without blocking."""
        self.menu.clear()
        self._fill(self._front())
        corner = beside.mapToGlobal(QPoint(beside.width() + 4, beside.height()))
        self.menu.popup(corner - QPoint(0, self.menu.sizeHint().height()))

    def ask_name(self) -> None:
        """Ask for a name and save the layout."""
        front = self._front()
        if not self._layouts.has(front):
            return
        if self.asker is None:
            self.asker = NameDialog(self._window, "Save the layout")
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
            self._add(tr("Delete '{}'", name), partial(layouts.delete, front, name))
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
        made = self.menu.addAction(tr(text).replace("&", "&&"))
        if checked is not None:
            made.setCheckable(True)
            made.setChecked(checked)
        if act is not None:
            # Drop the checked state, which the function does not take.
            made.triggered.connect(lambda _checked=False, run=act: run())
        return made

"""Layouts of the workspaces: lock, arrange, save under a name, choose, reset."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path

from app.layout_file import LONGEST_NAME, LayoutBook, keep_aside, load_book, save_book
from widgets.columns import Arrangement, Columns

USUAL = "Usual"
Entry = tuple[str, Callable[[], None]]


class Layouts:
    """``columns`` by workspace. ``tell`` shows one sentence; ``failed`` takes a disk's refusal."""

    def __init__(
        self,
        path: Path,
        columns: Mapping[str, Columns],
        tell: Callable[[str], None],
        failed: Callable[[OSError], None],
    ) -> None:
        self._path, self._columns, self._tell, self._failed = path, columns, tell, failed
        self.book = LayoutBook()

    def load(self) -> str:
        """Arrange all workspaces as they were left; return a notice, "" if all is well."""
        self.book, notice = load_book(self._path, datetime.now())
        wrong = {name: self._misfit(name, wanted) for name, wanted in self.book.present.items()}
        wrong = {name: reason for name, reason in wrong.items() if reason}
        if wrong:
            told = ", ".join(f"{name} ({reason})" for name, reason in wrong.items())
            notice = f"Layouts that do not fit this version: {told}. {self._kept()}"
        for name in wrong:
            del self.book.present[name]
        for name, columns in self._columns.items():
            columns.show_arrangement(self.book.present.get(name, columns.usual))
        self._lock(self.book.locked)
        return notice

    def remember(self) -> None:
        """Write how all workspaces are arranged now."""
        for name, columns in self._columns.items():
            self.book.present[name] = columns.arrangement()
        try:
            save_book(self._path, self.book)
        except OSError as error:
            self._failed(error)

    def has(self, workspace: str) -> bool:
        """Whether the workspace can be arranged."""
        return workspace in self._columns

    @property
    def locked(self) -> bool:
        """Whether the edges stand still and the panels stay."""
        return self.book.locked

    def toggle_lock(self) -> None:
        """Lock what is unlocked and the other way round."""
        self._lock(not self.book.locked)
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
        """Return the name of the layout that is shown, "" if it has none."""
        columns = self._columns[workspace]
        now = columns.arrangement()
        known = {USUAL: columns.usual, **self.book.saved.get(workspace, {})}
        return next((name for name, saved in known.items() if _same(saved, now)), "")

    def save(self, workspace: str, name: str) -> str:
        """Save the present layout under ``name``; return "" or why it cannot be."""
        name = name.strip()
        if not name or len(name) > LONGEST_NAME:
            return f"A name has 1 to {LONGEST_NAME} letters."
        if name == USUAL:
            return f"'{USUAL}' is the layout of the first start."
        self.book.saved.setdefault(workspace, {})[name] = self._columns[workspace].arrangement()
        self.remember()
        self._tell(f"The layout is saved as '{name}'.")
        return ""

    def choose(self, workspace: str, name: str) -> None:
        """Show a saved layout, or the usual one."""
        columns = self._columns[workspace]
        wanted = columns.usual if name == USUAL else self.book.saved[workspace][name]
        wrong = columns.misfit(wanted)
        if wrong:
            self._tell(f"The layout '{name}' does not fit this version: {wrong}.")
            return
        columns.show_arrangement(wanted)
        self.remember()

    def delete(self, workspace: str, name: str) -> None:
        """Forget a saved layout; what is shown stays as it is."""
        self.book.saved.get(workspace, {}).pop(name, None)
        self.remember()

    def reset(self, workspace: str) -> None:
        """Show the layout of the first start, also while locked."""
        if self.has(workspace):
            self.choose(workspace, USUAL)

    def turn_panel(self, workspace: str, title: str) -> None:
        """Leave out a panel or bring it back; a locked layout keeps its panels."""
        columns = self._columns[workspace]
        if self.locked:
            self._tell("The layout is locked: unlock it first.")
            return
        columns.show_panel(title, shown=columns.hides(title))
        self.remember()

    def panels(self, workspace: str) -> list[tuple[str, bool]]:
        """Return the panels that can be left out, and whether each is shown."""
        columns = self._columns[workspace]
        return [(title, not columns.hides(title)) for title in columns.panels]

    def entries(self, workspace: str) -> list[Entry]:
        """Return what the palette offers for a workspace: (text, act)."""
        if not self.has(workspace):
            return []
        found: list[Entry] = [
            (f"Layout: {name}", partial(self.choose, workspace, name))
            for name in (USUAL, *self.names(workspace))
        ]
        found += [
            (f"Delete the layout '{name}'", partial(self.delete, workspace, name))
            for name in self.names(workspace)
        ]
        if not self.locked:
            found += [
                (f"{'Leave out' if shown else 'Show'} the panel '{title}'",
                 partial(self.turn_panel, workspace, title))
                for title, shown in self.panels(workspace)
            ]  # fmt: skip
        return found

    def _kept(self) -> str:
        try:
            kept = keep_aside(self._path, datetime.now())
        except OSError as error:
            return f"The usual ones are used; the file could not be kept aside ({error})."
        return f"The usual ones are used; the file is kept as {kept.name}."

    def _misfit(self, workspace: str, wanted: Arrangement) -> str:
        columns = self._columns.get(workspace)
        return "no such workspace" if columns is None else columns.misfit(wanted)

    def _lock(self, locked: bool) -> None:
        self.book.locked = locked
        for columns in self._columns.values():
            columns.lock(locked)


def _same(one: Arrangement, other: Arrangement) -> bool:
    close = all(abs(a - b) < 1e-4 for a, b in zip(one.shares, other.shares, strict=False))
    return close and one.hidden == other.hidden

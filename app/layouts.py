"""Layouts of the workspaces: lock, arrange, save under a name, choose, reset."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from datetime import datetime
from functools import partial
from pathlib import Path

from app.layout_file import LONGEST_NAME, LayoutBook, keep_aside, load_book, save_book
from widgets.columns import Arrangement, Columns

USUAL = "Usual"
Entry = tuple[str, Callable[[], None]]


class Layouts:
    """Of the workspaces that have a page; ``tell`` shows one sentence, ``failed`` a disk's refusal.

    What is remembered of a workspace is judged, and shown, when its page comes.
    """

    def __init__(
        self,
        path: Path,
        tell: Callable[[str], None],
        failed: Callable[[OSError], None],
    ) -> None:
        self._path, self._tell, self._failed = path, tell, failed
        self._columns: dict[str, Columns] = {}
        self.book = LayoutBook()

    def load(self, workspaces: Collection[str]) -> str:
        """Read what is remembered of these workspaces; return a notice, "" if all is well."""
        self.book, notice = load_book(self._path, datetime.now())
        unknown = [name for name in self.book.present if name not in workspaces]
        return self._without(dict.fromkeys(unknown, "no such workspace")) or notice

    def add(self, workspace: str, columns: Columns | None) -> str:
        """Arrange a page that was just made as it was left; return a notice, "" if all is well.

        None: the page has one arrangement.
        """
        wanted, notice = self.book.present.get(workspace), ""
        if wanted is not None:
            misfit = "no columns" if columns is None else columns.misfit(wanted)
            notice = self._without({workspace: misfit} if misfit else {})
        if columns is not None:
            self._columns[workspace] = columns
            columns.show_arrangement(self.book.present.get(workspace, columns.usual))
            columns.lock(self.book.locked)
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

    def _without(self, wrong: Mapping[str, str]) -> str:
        """Forget the layouts that do not fit, by workspace with the reason; return the notice."""
        if not wrong:
            return ""
        told = ", ".join(f"{name} ({reason})" for name, reason in wrong.items())
        notice = f"Layouts that do not fit this version: {told}. {self._kept()}"
        for name in wrong:
            del self.book.present[name]
        return notice

    def _lock(self, locked: bool) -> None:
        self.book.locked = locked
        for columns in self._columns.values():
            columns.lock(locked)


def _same(one: Arrangement, other: Arrangement) -> bool:
    close = all(abs(a - b) < 1e-4 for a, b in zip(one.shares, other.shares, strict=False))
    return close and one.hidden == other.hidden

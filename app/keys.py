"""Which key does what where: rows of commands, their contexts, and why a key cannot be had."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QKeyCombination, Qt
from PySide6.QtGui import QKeySequence

from app.workspace import Command, Workspace

EVERYWHERE = ""
STOP_ROWS: tuple[tuple[str, str], ...] = (
    ("F12", "STOP motion (software), always"),
    ("Space", "STOP motion while something moves and no text field has the focus"),
)
_FIRM = (Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.AltModifier,
         Qt.KeyboardModifier.MetaModifier)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Row:
    """One key in one context ("" is everywhere); ``command`` is None for a key that is held."""

    context: str
    title: str
    key: str
    text: str
    command: Command | None = None

    @property
    def id(self) -> str:
        """Name under which a changed key is remembered, such as "stack.pause"."""
        name = self.command.name if self.command is not None else self.key
        return f"{self.context}.{name}" if self.context else name


def rows_of(frame: Sequence[Command], workspaces: Iterable[Workspace]) -> list[Row]:
    """Return all rows: those of everywhere first, then workspace by workspace."""
    rows = [Row(EVERYWHERE, "Everywhere", key, text) for key, text in STOP_ROWS]
    rows += [Row(EVERYWHERE, "Everywhere", c.key, c.text, c) for c in frame]
    for ws in workspaces:
        rows += [Row(ws.name, ws.title, c.key, c.text, c) for c in ws.commands]
        rows += [Row(ws.name, ws.title, key, text) for key, text in ws.held_keys]
    return rows


def remapped(rows: Sequence[Row], changed: Mapping[str, str]) -> tuple[list[Row], list[str]]:
    """Return rows with the remembered keys, and the ids whose key could not be had."""
    kept, refused = list(rows), []
    for name, key in changed.items():
        if refusal(kept, name, key):
            refused.append(name)
        else:
            kept = [_with_key(row, key) if row.id == name else row for row in kept]
    return kept, refused


def refusal(rows: Sequence[Row], name: str, key: str) -> str:
    """Return "" if command ``name`` may have ``key`` ("" takes its key away), else the reason."""
    own = next((row for row in rows if row.id == name and row.command is not None), None)
    if own is None:
        return f"There is no command '{name}'."
    if not key:
        return ""
    wanted = portable(key)
    if not wanted:
        return f"'{key}' is no key."
    for row in rows:
        meets = EVERYWHERE in (row.context, own.context) or row.context == own.context
        if row is not own and meets and portable(row.key) == wanted:
            return f"{wanted} already means '{row.text}' ({row.title})."
    return ""


def portable(key: str) -> str:
    """Return the one spelling of a key, "" if it is none."""
    sequence = QKeySequence(key)
    pressed = _pressed(sequence)
    if pressed is None or sequence.count() > 1 or pressed.key() is Qt.Key.Key_unknown:
        return ""
    return sequence.toString(QKeySequence.SequenceFormat.PortableText)


def plain(key: str) -> bool:
    """Whether a key would also be typed into a text field."""
    pressed = _pressed(QKeySequence(key))
    if pressed is None:
        return False
    firm = any(pressed.keyboardModifiers() & modifier for modifier in _FIRM)
    return not firm and not Qt.Key.Key_F1 <= pressed.key() <= Qt.Key.Key_F35


def _pressed(sequence: QKeySequence) -> QKeyCombination | None:
    """Return the first key of a sequence."""
    if not sequence.count():
        return None
    first: QKeyCombination = sequence[0]  # type: ignore[index]
    return first


def _with_key(row: Row, key: str) -> Row:
    return Row(row.context, row.title, portable(key), row.text, row.command)

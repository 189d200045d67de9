"""Actions of the window, their keys and the stop key."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from PySide6.QtCore import QEvent, QKeyCombination, QObject, Qt
from PySide6.QtGui import QAction, QKeyEvent, QKeySequence, QWindow
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QApplication,
    QComboBox,
    QLineEdit,
    QPlainTextEdit,
    QWidget,
)

from touchdown.app.shell.workspace import WindowCommand, Workspace
from touchdown.widgets.base import tr
from touchdown.widgets.forms import ACTIVE_DURING_QUESTION
from touchdown.widgets.shell import CommandPalette, KeyDialog, KeySheet, PaletteEntry

EVERYWHERE_CONTEXT = ""
STOP_BINDINGS: tuple[tuple[str, str], ...] = (
    ("F12", "STOP motion (software), always"),
    ("Space", "STOP motion while something moves and no text field has the focus"),
)
_FIXED_KEYS = (Qt.KeyboardModifier.ControlModifier, Qt.KeyboardModifier.AltModifier,
         Qt.KeyboardModifier.MetaModifier)  # fmt: skip


@dataclass(frozen=True, slots=True)
class KeyBinding:
    """One key in one context ("" is everywhere). ``command`` is None for a key that is held."""

    context: str
    title: str
    key: str
    text: str
    command: WindowCommand | None = None

    @property
    def id(self) -> str:
        """Identifier of a changed key in the settings, such as "stack.pause"."""
        name = self.command.name if self.command is not None else self.key
        return f"{self.context}.{name}" if self.context else name


def key_bindings(
    frame: Sequence[WindowCommand], workspaces: Iterable[Workspace]
) -> list[KeyBinding]:
    """Return all key bindings: global ones first, then by workspace."""
    everywhere = EVERYWHERE_CONTEXT, tr("Everywhere")
    rows = [KeyBinding(*everywhere, key, tr(text)) for key, text in STOP_BINDINGS]
    rows += [KeyBinding(*everywhere, c.key, tr(c.text), c) for c in frame]
    for ws in workspaces:
        rows += [KeyBinding(ws.name, tr(ws.title), c.key, tr(c.text), c) for c in ws.commands]
        rows += [KeyBinding(ws.name, tr(ws.title), key, tr(text)) for key, text in ws.held_keys]
    return rows


def remap_keys(
    rows: Sequence[KeyBinding], changed: Mapping[str, str]
) -> tuple[list[KeyBinding], list[str]]:
    """Return the bindings with the stored keys, and the ids whose key is not possible."""
    kept, refused = list(rows), []
    for name, key in changed.items():
        if key_refusal(kept, name, key):
            refused.append(name)
        else:
            new = portable_key(key)
            kept = [replace(row, key=new) if row.id == name else row for row in kept]
    return kept, refused


def key_refusal(rows: Sequence[KeyBinding], name: str, key: str) -> str:
    """Return why command ``name`` cannot have ``key``, "" if it can.

    An empty ``key`` removes it.
    """
    own = next((row for row in rows if row.id == name and row.command is not None), None)
    if own is None:
        return tr("There is no command '{}'.", name)
    if not key:
        return ""
    wanted = portable_key(key)
    if not wanted:
        return tr("'{}' is no key.", key)
    for row in rows:
        meets = EVERYWHERE_CONTEXT in (row.context, own.context) or row.context == own.context
        if row is not own and meets and portable_key(row.key) == wanted:
            return tr("{} already means '{}' ({}).", wanted, row.text, row.title)
    return ""


def portable_key(key: str) -> str:
    """Return the canonical spelling of a key, "" if it is invalid."""
    sequence = QKeySequence(key)
    pressed = _pressed_key(sequence)
    if pressed is None or sequence.count() > 1 or pressed.key() is Qt.Key.Key_unknown:
        return ""
    return sequence.toString(QKeySequence.SequenceFormat.PortableText)


def is_plain_key(key: str) -> bool:
    """Return True if a key could also be typed into a text field."""
    pressed = _pressed_key(QKeySequence(key))
    if pressed is None:
        return False
    firm = any(pressed.keyboardModifiers() & modifier for modifier in _FIXED_KEYS)
    return not firm and not Qt.Key.Key_F1 <= pressed.key() <= Qt.Key.Key_F35


def _pressed_key(sequence: QKeySequence) -> QKeyCombination | None:
    if not sequence.count():
        return None
    first: QKeyCombination = sequence[0]  # type: ignore[index]
    return first


_PRESSED = frozenset({QEvent.Type.ShortcutOverride, QEvent.Type.KeyPress})


class StopKeyFilter(QObject):
    """Event filter of the application. ``stop`` must return at once."""

    def __init__(
        self, parent: QObject, stop: Callable[[], None], moving: Callable[[], bool]
    ) -> None:
        super().__init__(parent)
        self._stop, self._moving = stop, moving

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Handle F12 and, while something moves, Space."""
        # Called for every event of the window: the cheapest test comes first.
        if not isinstance(event, QKeyEvent) or not isinstance(watched, QWindow):
            return False
        space = event.key() == Qt.Key.Key_Space and self._moving() and not is_typing()
        if event.type() not in _PRESSED or not (space or event.key() == Qt.Key.Key_F12):
            return False
        # Qt sends ShortcutOverride before a key press. Accept it, so that no shortcut takes the
        # key; it is not a key press itself.
        if event.type() is QEvent.Type.KeyPress and not event.isAutoRepeat():
            self._stop()
        event.accept()
        return True


def is_typing() -> bool:
    """Return True if an editable text field has the focus."""
    focus = QApplication.focusWidget()
    if isinstance(focus, (QLineEdit, QPlainTextEdit)):
        return not focus.isReadOnly()
    if isinstance(focus, QComboBox):
        return focus.isEditable()
    return isinstance(focus, QAbstractSpinBox)


class ActionRegistry:
    """One action per binding with a command; keys are unique within a context."""

    def __init__(
        self, window: QWidget, rows: Sequence[KeyBinding], changed: Mapping[str, str]
    ) -> None:
        self.rows, self.refused = remap_keys(rows, changed)
        self.changed = {k: v for k, v in changed.items() if k not in self.refused}
        self._first = {row.id: row.key for row in rows}
        self._bound = {
            row.id: _BoundCommand(window, row, on=row.context == EVERYWHERE_CONTEXT)
            for row in self.rows
            if row.command is not None
        }

    def action(self, name: str) -> QAction:
        """Return the action with this id. Raises ``KeyError``."""
        return self._bound[name].action

    def enter(self, context: str) -> None:
        """Enable the keys of the workspace in front."""
        for bound in self._bound.values():
            bound.action.setEnabled(bound.row.context in (EVERYWHERE_CONTEXT, context))

    def change_key(self, name: str, key: str) -> str:
        """Change the key of command ``name``; return "" or the reason of refusal."""
        reason = key_refusal(self.rows, name, key)
        if reason:
            return reason
        self.rows, _ = remap_keys(self.rows, {name: key})
        bound = self._bound[name]
        bound.take(next(row for row in self.rows if row.id == name))
        if bound.row.key == self._first[name]:
            self.changed.pop(name, None)
        else:
            self.changed[name] = bound.row.key
        return ""


class _BoundCommand:
    """One command, its action, and the rule for keys that can be typed."""

    def __init__(self, window: QWidget, row: KeyBinding, *, on: bool) -> None:
        assert row.command is not None
        self._run_command = row.command.run
        self.action = QAction(row.text, window)
        self.action.setAutoRepeat(row.command.repeats)
        self.action.setProperty(ACTIVE_DURING_QUESTION, row.command.beside)
        self.action.triggered.connect(self._run)
        self.action.setEnabled(on)
        self.take(row)
        window.addAction(self.action)

    def take(self, row: KeyBinding) -> None:
        self.row = row
        self.action.setShortcut(QKeySequence(row.key))
        tip = f"{row.text} ({row.key})" if row.key else row.text
        self.action.setToolTip(tip)

    def _run(self) -> None:
        if not (is_plain_key(self.row.key) and is_typing()):
            self._run_command()


CHANGE = "key:"  # prefix of the palette entries for key changes


class CommandDialogs:
    """Key sheet and command palette, created when first needed. Not modal."""

    def __init__(
        self, window: QWidget, actions: ActionRegistry, go: Callable[[str], None],
        changed: Callable[[], object],
    ) -> None:  # fmt: skip
        self._window, self._actions, self._go, self._changed = window, actions, go, changed
        self.sheet: KeySheet | None = None
        self.palette: CommandPalette | None = None
        self.asker: KeyDialog | None = None

    def show_keys(self) -> None:
        """Show all present keys."""
        if self.sheet is None:
            self.sheet = KeySheet(self._window)
        self.sheet.show_rows([(row.title, row.key, row.text) for row in self._actions.rows])

    def show_palette(self) -> None:
        """Show all commands."""
        if self.palette is None:
            self.palette = CommandPalette(self._window, self._chosen)
        self.palette.open_with(self._choices())

    def _choices(self) -> list[PaletteEntry]:
        rows = [row for row in self._actions.rows if row.command is not None]
        acts = [PaletteEntry(row.id, row.title, row.text, row.key) for row in rows]
        return acts + [
            PaletteEntry(CHANGE + row.id, row.title, tr("Change key of: {}", row.text), "")
            for row in rows
        ]

    def _chosen(self, name: str) -> None:
        if name.startswith(CHANGE):
            row = self._row(name.removeprefix(CHANGE))
            if self.asker is None:
                self.asker = KeyDialog(self._window)
            self.asker.ask(row.text, row.key, partial(self._change, row.id))
            return
        row = self._row(name)
        if row.context != EVERYWHERE_CONTEXT:
            self._go(row.context)
        self._actions.action(name).trigger()

    def _change(self, name: str, key: str) -> str:
        reason = self._actions.change_key(name, key)
        if not reason:
            self._changed()
        return reason

    def _row(self, name: str) -> KeyBinding:
        return next(row for row in self._actions.rows if row.id == name)

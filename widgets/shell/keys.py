"""Command palette and key sheet."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import groupby

from PySide6.QtCore import QEvent, QKeyCombination, QObject, Qt
from PySide6.QtGui import QColor, QKeyEvent, QKeySequence, QPainter, QPalette
from PySide6.QtWidgets import (
    QDialog,
    QGridLayout,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QWidget,
)

from touchdown.widgets.base import (
    ENTER,
    ModelIndex,
    hbox,
    label,
    push_button,
    rule,
    scroll_area,
    tr,
    vbox,
)

SHOWN = 200
NAME, CHOICE = Qt.ItemDataRole.UserRole, Qt.ItemDataRole.UserRole + 1
INSET_PX, GAP_PX = 10, 12
FAINT = 0.72  # opacity of the workspace name of a command


@dataclass(frozen=True, slots=True)
class PaletteEntry:
    """One command. ``where``: its workspace. ``key``: its shortcut or ""."""

    name: str
    where: str
    text: str
    key: str


def match_score(query: str, text: str) -> float | None:
    """Return the fuzzy match of ``query`` (lower is better), None if its letters are not in order.

    Letters at the start of words and consecutive letters score best.
    """
    wanted, given = query.casefold().replace(" ", ""), text.casefold()
    at, gaps, last = 0, 0.0, -1
    for letter in wanted:
        found = given.find(letter, at)
        # Prefer a letter at the start of a word.
        word = given.find(f" {letter}", max(at - 1, 0))
        if word >= 0 and found >= 0 and word + 1 != found and found != last + 1:
            found = word + 1
        if found < 0:
            return None
        starts_word = found == 0 or given[found - 1] == " "
        gaps += 0.0 if found == last + 1 else 0.5 if starts_word else 1.0 + 0.02 * (found - last)
        last, at = found, found + 1
    return gaps + 0.001 * len(given)


def best_matches(query: str, choices: Sequence[PaletteEntry]) -> list[PaletteEntry]:
    """Return the matching commands, best first; all in their order for an empty query."""
    scored = [(match_score(query, f"{c.text} {c.where}"), c) for c in choices]
    fits = [(score if query else 0.0, c) for score, c in scored if score is not None]
    return [choice for _, choice in sorted(fits, key=lambda row: row[0])][:SHOWN]


class _PaletteDelegate(QStyledItemDelegate):
    """Row with the command, its workspace, and its shortcut at the right."""

    def paint(self, painter: QPainter, option: QStyleOptionViewItem, index: ModelIndex) -> None:
        choice = index.data(CHOICE)
        self.initStyleOption(option, index)
        option.text = ""
        widget: QWidget = option.widget
        widget.style().drawControl(QStyle.ControlElement.CE_ItemViewItem, option, painter, widget)
        chosen = bool(option.state & QStyle.StateFlag.State_Selected)
        role = QPalette.ColorRole.HighlightedText if chosen else QPalette.ColorRole.Text
        ink = widget.palette().color(role)
        faint = QColor(ink)
        faint.setAlphaF(1.0 if chosen else FAINT)
        box = option.rect.adjusted(INSET_PX, 0, -INSET_PX, 0)
        metrics, middle = painter.fontMetrics(), Qt.AlignmentFlag.AlignVCenter
        room = box.width() - (metrics.horizontalAdvance(choice.key) + GAP_PX if choice.key else 0)
        text = metrics.elidedText(choice.text, Qt.TextElideMode.ElideRight, room)
        painter.setPen(ink)
        painter.drawText(box, int(middle), text)
        painter.drawText(box, int(middle | Qt.AlignmentFlag.AlignRight), choice.key)
        used = metrics.horizontalAdvance(text) + GAP_PX
        if used < room:
            where = metrics.elidedText(choice.where, Qt.TextElideMode.ElideRight, room - used)
            painter.setPen(faint)
            painter.drawText(box.adjusted(used, 0, 0, 0), int(middle), where)


class CommandPalette(QDialog):
    """Text field over a list. Return runs the selected command, Esc closes; not modal."""

    def __init__(self, parent: QWidget, on_choice: Callable[[str], None]) -> None:
        super().__init__(parent)
        self._window, self._on_choice = parent, on_choice
        self._choices: Sequence[PaletteEntry] = ()
        self.setWindowTitle(tr("Commands"))
        self.field, self.list = QLineEdit(), QListWidget()
        self.field.setPlaceholderText(tr("What do you want to do?"))
        self.field.setAccessibleName(tr("Find a command"))
        self.list.setAccessibleName(tr("Matching commands"))
        self.list.setItemDelegate(_PaletteDelegate(self.list))
        self.list.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.list.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.field.textChanged.connect(self._filter)
        self.list.itemClicked.connect(self._take)
        self.field.installEventFilter(self)
        vbox(self.field, (self.list, 1), parent=self, margins=(12, 12, 12, 12), spacing=8)

    def open_with(self, choices: Sequence[PaletteEntry]) -> None:
        """Show all of ``choices`` with an empty field."""
        self._choices = choices
        self.field.clear()
        self._filter("")
        em = self.fontMetrics().height()
        room = self._window.size()
        self.resize(min(44 * em, room.width() - 40), min(28 * em, room.height() - 80))
        self.show()
        self.raise_()
        self.activateWindow()
        self.field.setFocus()

    def shown(self) -> list[str]:
        """Return the names in the list, best first."""
        rows = (self.list.item(row) for row in range(self.list.count()))
        return [str(item.data(NAME)) for item in rows]

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        """Let arrows and Return act on the list while the field has the focus."""
        if isinstance(event, QKeyEvent) and event.type() is QEvent.Type.ShortcutOverride:
            if event.key() in ENTER:
                event.accept()
            return False
        if not isinstance(event, QKeyEvent) or event.type() is not QEvent.Type.KeyPress:
            return False
        steps = {Qt.Key.Key_Down: 1, Qt.Key.Key_Up: -1, Qt.Key.Key_PageDown: 8,
                 Qt.Key.Key_PageUp: -8}  # fmt: skip
        step = steps.get(Qt.Key(event.key()))
        if step is not None and self.list.count():
            row = self.list.currentRow() + step
            self.list.setCurrentRow(min(max(row, 0), self.list.count() - 1))
            self._describe()
            return True
        if event.key() in ENTER:
            self._take(self.list.currentItem() if self.list.count() else None)
            return True
        return False

    def _filter(self, query: str) -> None:
        self.list.clear()
        for choice in best_matches(query, self._choices):
            key = f"   {choice.key}" if choice.key else ""
            item = QListWidgetItem(f"{choice.text}   ({choice.where}){key}")
            item.setData(NAME, choice.name)
            item.setData(CHOICE, choice)
            self.list.addItem(item)
        self.list.setCurrentRow(0)
        self._describe()

    def _describe(self) -> None:
        """Describe the selected command at the field, which screen readers follow."""
        text = self.list.currentItem().text() if self.list.count() else tr("No match")
        self.field.setAccessibleDescription(text)

    def _take(self, item: QListWidgetItem | None) -> None:
        if item is not None:
            self.close()
            self._on_choice(str(item.data(NAME)))


Row = tuple[str, str, str]  # (workspace, shortcut, command)
Groups = list[tuple[str, list[Row]]]
COLUMN_EM = 34
TOP_EM = 8  # height left free above and below in total, so that the STOP button stays visible


class KeySheet(QDialog):
    """Shortcuts by workspace, in two columns where they fit."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._window = parent
        self.setWindowTitle(tr("Keys"))
        self._scroll = scroll_area()
        self._scroll.setAccessibleName(tr("Keyboard shortcuts"))
        close = push_button("Close")
        close.clicked.connect(self.close)
        column = vbox((self._scroll, 1), rule(), parent=self, margins=(20, 16, 20, 16), spacing=12)
        column.addWidget(close, 0, Qt.AlignmentFlag.AlignRight)

    def show_rows(self, rows: Sequence[Row]) -> None:
        """Show the present shortcuts; commands without one are left out."""
        groups = [(title, [row for row in group if row[1]])
                  for title, group in groupby(rows, key=lambda row: row[0])]  # fmt: skip
        em = self.fontMetrics().height()
        columns = 2 if 2 * COLUMN_EM * em < self._window.width() else 1
        body = QWidget()
        tables = [(_table(part), 1) for part in _shared_out(groups, columns)]
        hbox(*tables, parent=body, spacing=round(1.5 * em))
        self._scroll.setWidget(body)
        most = self._window.height() - round(TOP_EM * em)
        high = body.heightForWidth(columns * COLUMN_EM * em) + 110
        self.resize(columns * COLUMN_EM * em, min(high, most))
        self.show()
        self.raise_()


def _shared_out(groups: Groups, columns: int) -> list[Groups]:
    """Distribute whole groups over columns of about equal height."""
    lengths = [1 + len(rows) for _, rows in groups]
    parts: list[Groups] = [[] for _ in range(columns)]
    before = 0
    for group, length in zip(groups, lengths, strict=True):
        middle = (before + length / 2) / max(sum(lengths), 1)
        parts[min(int(columns * middle), columns - 1)].append(group)
        before += length
    return [part for part in parts if part]


def _table(groups: Groups) -> QGridLayout:
    grid = QGridLayout()
    grid.setHorizontalSpacing(24)
    grid.setVerticalSpacing(7)
    grid.setColumnStretch(1, 1)
    line = 0
    for title, rows in groups:
        grid.addWidget(label(title, "head"), line, 0, 1, 2)
        for _, key, text in rows:
            line += 1
            grid.addWidget(label(key, "title"), line, 0, Qt.AlignmentFlag.AlignTop)
            grid.addWidget(label(text, wrap=True), line, 1)
        line += 1
    grid.setRowStretch(line, 1)
    return grid


_ALONE = frozenset({Qt.Key.Key_Control, Qt.Key.Key_Shift, Qt.Key.Key_Alt, Qt.Key.Key_Meta,
                    Qt.Key.Key_AltGr})  # fmt: skip


class KeyDialog(QDialog):
    """Dialog for a shortcut; ``change`` sets it ("" for none) and returns "" or an error."""

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._change: Callable[[str], str] = str
        self.setWindowTitle(tr("Change a key"))
        self.head, self.said = label("", "head", wrap=True), label("", wrap=True)
        none = push_button("No key", "The command stays available in the palette")
        close = push_button("Close")
        for button in (none, close):
            button.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        none.clicked.connect(lambda: self._try(""))
        close.clicked.connect(self.close)
        row = hbox(1, none, close)
        vbox(self.head, self.said, row, parent=self, margins=(18, 14, 18, 14), spacing=10)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)

    def ask(self, text: str, key: str, change: Callable[[str], str]) -> None:
        """Ask for a shortcut of the command ``text``; ``key`` is the present one."""
        self._change = change
        self.head.setText(tr(text))
        self.said.setText(
            tr("Present key: {}. Press another one.", key) if key else tr("Press a key.")
        )
        self.setMinimumWidth(26 * self.fontMetrics().height())
        self.show()
        self.activateWindow()
        self.setFocus()

    def event(self, event: QEvent) -> bool:
        """Claim every key, shortcuts of the window too."""
        if event.type() is QEvent.Type.ShortcutOverride:
            event.accept()
            return True
        return super().event(event)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Try the pressed key."""
        key = Qt.Key(event.key())
        if key in _ALONE or event.isAutoRepeat():
            return
        if key is Qt.Key.Key_Escape and not event.modifiers().value:
            self.close()
            return
        modifiers = event.modifiers() & ~Qt.KeyboardModifier.KeypadModifier
        pressed = QKeySequence(QKeyCombination(modifiers, key))
        self._try(pressed.toString(QKeySequence.SequenceFormat.PortableText))

    def _try(self, key: str) -> None:
        reason = self._change(key)
        if reason:
            self.said.setText(reason)
        else:
            self.said.setText(tr("Key set to {}.", key) if key else tr("Key removed."))

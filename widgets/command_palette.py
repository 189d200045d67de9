"""Everything that can be done, by typing a part of its name (Ctrl+K); no mouse is needed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QModelIndex, QObject, QPersistentModelIndex, Qt
from PySide6.QtGui import QColor, QKeyEvent, QPainter, QPalette
from PySide6.QtWidgets import (
    QDialog,
    QLineEdit,
    QListWidget,
    QListWidgetItem,
    QStyle,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QVBoxLayout,
    QWidget,
)

SHOWN = 200
NAME, CHOICE = Qt.ItemDataRole.UserRole, Qt.ItemDataRole.UserRole + 1
INSET_PX, GAP_PX = 10, 12
FAINT = 0.72
"""How strongly the workspace of a command is written."""


@dataclass(frozen=True, slots=True)
class Choice:
    """One entry. ``where`` is the workspace, ``key`` its key or ""."""

    name: str
    where: str
    text: str
    key: str


def score(query: str, text: str) -> float | None:
    """Return how well ``query`` fits (lower is better), None if its letters do not occur in order.

    Letters at the beginning of words and letters that follow each other count most.
    """
    wanted, given = query.casefold().replace(" ", ""), text.casefold()
    at, gaps, last = 0, 0.0, -1
    for letter in wanted:
        found = given.find(letter, at)
        # The beginning of a word is a better place for a letter than the middle of one.
        word = given.find(f" {letter}", max(at - 1, 0))
        if word >= 0 and found >= 0 and word + 1 != found and found != last + 1:
            found = word + 1
        if found < 0:
            return None
        starts_word = found == 0 or given[found - 1] == " "
        gaps += 0.0 if found == last + 1 else 0.5 if starts_word else 1.0 + 0.02 * (found - last)
        last, at = found, found + 1
    return gaps + 0.001 * len(given)


def best(query: str, choices: Sequence[Choice]) -> list[Choice]:
    """Return the choices that fit, best first; all in their order for an empty query."""
    scored = []
    for order, choice in enumerate(choices):
        fits = score(query, f"{choice.text} {choice.where}")
        if fits is not None:
            scored.append((fits if query else 0.0, order, choice))
    return [choice for _, _, choice in sorted(scored, key=lambda row: row[:2])][:SHOWN]


class _Entry(QStyledItemDelegate):
    """Writes what is done at the left, where it acts beside it, and the key at the right."""

    def paint(
        self,
        painter: QPainter,
        option: QStyleOptionViewItem,
        index: QModelIndex | QPersistentModelIndex,
    ) -> None:
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


TAKES = (Qt.Key.Key_Return, Qt.Key.Key_Enter)
"""Keys that take the entry, whatever they mean on the page."""


class CommandPalette(QDialog):
    """A text field over a list. Return takes the chosen one, Esc goes away; not modal."""

    def __init__(self, parent: QWidget, on_choice: Callable[[str], None]) -> None:
        super().__init__(parent)
        self._window, self._on_choice = parent, on_choice
        self._choices: Sequence[Choice] = ()
        self.setWindowTitle("Commands")
        self.setModal(False)
        self.field, self.list = QLineEdit(), QListWidget()
        self.field.setPlaceholderText("What do you want to do?")
        self.field.setAccessibleName("Find a command")
        self.list.setAccessibleName("Commands that fit")
        self.list.setItemDelegate(_Entry(self.list))
        self.list.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.list.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.field.textChanged.connect(self._filter)
        self.list.itemClicked.connect(self._clicked)
        self.field.installEventFilter(self)
        column = QVBoxLayout(self)
        column.setContentsMargins(12, 12, 12, 12)
        column.setSpacing(8)
        column.addWidget(self.field)
        column.addWidget(self.list, 1)

    def open_with(self, choices: Sequence[Choice]) -> None:
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
        """Let the arrows walk in the list and Return take the entry while the text is edited."""
        if isinstance(event, QKeyEvent) and event.type() is QEvent.Type.ShortcutOverride:
            # Return has a meaning on some pages: here it takes the entry.
            if event.key() in TAKES:
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
        if event.key() in TAKES:
            self._take(self.list.currentItem() if self.list.count() else None)
            return True
        return False

    # -- inside -----------------------------------------------------------------------------------

    def _filter(self, query: str) -> None:
        self.list.clear()
        for choice in best(query, self._choices):
            key = f"   {choice.key}" if choice.key else ""
            item = QListWidgetItem(f"{choice.text}   ({choice.where}){key}")
            item.setData(NAME, choice.name)
            item.setData(CHOICE, choice)
            self.list.addItem(item)
        self.list.setCurrentRow(0)
        self._describe()

    def _describe(self) -> None:
        """Tell a screen reader, which follows the field, what Return would do."""
        text = self.list.currentItem().text() if self.list.count() else "Nothing fits"
        self.field.setAccessibleDescription(text)

    def _clicked(self, item: QListWidgetItem) -> None:
        self._take(item)

    def _take(self, item: QListWidgetItem | None) -> None:
        if item is not None:
            self.close()
            self._on_choice(str(item.data(NAME)))

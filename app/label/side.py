"""Beside the queue: versions of this label, agreement, log, many at once, health of the data."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QButtonGroup,
    QFrame,
    QListWidget,
    QPushButton,
    QScrollArea,
    QStackedWidget,
    QVBoxLayout,
    QWidget,
)

from app.label.entry import Entry
from widgets.history_list import HistoryList
from widgets.panel import Panel, label
from widgets.wrapped_items import WrappedItems

TABS = ("History", "Agree", "Log", "Bulk", "Health")
HISTORY, BULK, HEALTH = 0, 3, 4


class SideTabs(Panel):
    """Views in one place; ``search`` is told what to look for in the log, ``leave`` its end."""

    def __init__(
        self,
        restore: Callable[[str], None],
        search: Callable[[str], None],
        entered: Callable[[int], None],
        leave: Callable[[], None],
        bulk: QWidget,
        health: QWidget,
    ) -> None:
        super().__init__("")
        self.history = HistoryList(restore)
        self.agreement = label("", wrap=True)
        self.log = QListWidget()
        hint = "Search person, action, episode"
        self.needle = Entry("Search the log", hint, lambda _: leave(), leave)
        WrappedItems(self.log)
        self.log.setAccessibleName("Log of all actions")
        self.needle.textChanged.connect(search)
        self._stack = QStackedWidget()
        log = QWidget()
        column = QVBoxLayout(log)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self.needle)
        column.addWidget(self.log, 1)
        for page in (self.history, _top(self.agreement), log, bulk, health):
            self._stack.addWidget(page)
        self.column.addWidget(self._stack, 1)
        self._buttons = QButtonGroup(self)
        for number, name in enumerate(TABS):
            button = QPushButton(name)
            button.setCheckable(True)
            button.setProperty("role", "header")
            self._buttons.addButton(button, number)
            self.header.insertWidget(number, button)
        self._buttons.idClicked.connect(self.choose)
        self.choose(0)
        self._buttons.idClicked.connect(entered)

    def choose(self, tab: int) -> None:
        """Bring one view to the front."""
        self._stack.setCurrentIndex(tab)
        self._buttons.button(tab).setChecked(True)

    @property
    def tab(self) -> int:
        """Which view is in front."""
        return self._stack.currentIndex()

    def show_log(self, lines: Sequence[str]) -> None:
        """Show operations, newest first."""
        self.log.clear()
        self.log.addItems(list(lines))


def _top(widget: QWidget) -> QWidget:
    """Keep a text at the top of its place; more of it than there is room for scrolls."""
    holder = QWidget()
    column = QVBoxLayout(holder)
    column.setContentsMargins(0, 0, 0, 0)
    column.addWidget(widget)
    column.addStretch(1)
    scroll = QScrollArea()
    scroll.setWidget(holder)
    scroll.setWidgetResizable(True)
    scroll.setFrameShape(QFrame.Shape.NoFrame)
    scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
    return scroll

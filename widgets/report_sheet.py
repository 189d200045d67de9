"""A report over the window: its parts by name on the left, tables and pictures beside it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtCore import QEvent, QRect, QSize, Qt
from PySide6.QtGui import QImage, QPixmap
from PySide6.QtWidgets import (
    QDialog,
    QFrame,
    QHBoxLayout,
    QLabel,
    QListWidget,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from widgets.elided import ElidedLabel
from widgets.panel import label
from widgets.wrapped_items import WrappedItems

GAP = 10
PARTS_PX = 220


@dataclass(frozen=True, slots=True)
class ReportIntents:
    """What can be asked for here; ``part`` is told the number of the part that was chosen."""

    part: Callable[[int], None]
    folder: Callable[[], None]
    browser: Callable[[], None]
    other: Callable[[], None]


class PictureCard(QWidget):
    """A picture of known size, which may come later, between its title and its note."""

    def __init__(self, title: str, note: str, name: str, size: QSize) -> None:
        super().__init__()
        self.picture = QLabel()
        self.picture.setFixedSize(size)
        self.picture.setAccessibleName(name)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(4)
        if title:
            column.addWidget(label(title, "muted"))
        column.addWidget(self.picture)
        if note:
            words = label(note, "small", wrap=True)
            words.setFixedWidth(size.width())
            column.addWidget(words)
        column.addStretch(1)

    def show_picture(self, image: QImage) -> None:
        """Show it, drawn at the size that was said."""
        self.picture.setPixmap(QPixmap.fromImage(image))


class Flow(QWidget):
    """Cards side by side, as many to a line as there is room for."""

    def __init__(self, cards: Sequence[PictureCard]) -> None:
        super().__init__()
        self.cards = list(cards)
        for card in cards:
            card.setParent(self)

    def resizeEvent(self, _event: object) -> None:
        """Stand anew in lines."""
        self.setFixedHeight(self._stand(self.width()))

    def event(self, event: QEvent) -> bool:
        """Stand anew where a card got another size."""
        if event.type() == QEvent.Type.LayoutRequest:
            self.setFixedHeight(self._stand(self.width()))
        return super().event(event)

    def _stand(self, width: int) -> int:
        """Place the cards; return how high they are together."""
        x = y = line = 0
        for card in self.cards:
            size = card.sizeHint()
            if x and x + size.width() > width:
                x, y, line = 0, y + line + GAP, 0
            card.setGeometry(QRect(x, y, size.width(), size.height()))
            x, line = x + size.width() + GAP, max(line, size.height())
        return y + line


class ReportSheet(QDialog):
    """Not modal: the bench goes on, and STOP is where it was."""

    def __init__(self, parent: QWidget, intents: ReportIntents) -> None:
        super().__init__(parent)
        self._window = parent
        self.setModal(False)
        self.setWindowTitle("Report of experiments")
        self.head, self.banner = label("", "head", wrap=True), label("", "title", wrap=True)
        self.banner.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.file = ElidedLabel("small")
        self.parts = QListWidget()
        self.parts.setAccessibleName("Parts of the report")
        self.parts.setFixedWidth(PARTS_PX)
        WrappedItems(self.parts)
        self.parts.currentRowChanged.connect(intents.part)
        self.room = QScrollArea()
        self.room.setWidgetResizable(True)
        self.room.setFrameShape(QFrame.Shape.NoFrame)
        self.room.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.trace = ElidedLabel("small")
        self.folder = _button("Open run folder", "The folder that this cell was made from")
        self.browser = _button("Open in browser", "The same report as a page")
        self.other = _button("Open another", "Choose another report")
        for button, act in (
            (self.folder, intents.folder),
            (self.browser, intents.browser),
            (self.other, intents.other),
        ):
            button.clicked.connect(act)
        self.show_trace("", can_open=False)
        self._arrange()

    def _arrange(self) -> None:
        close = _button("Close", "")
        close.clicked.connect(self.close)
        top, middle, foot = QHBoxLayout(), QHBoxLayout(), QHBoxLayout()
        top.addWidget(self.head, 1)
        top.addWidget(self.banner, 1)
        middle.setSpacing(GAP)
        middle.addWidget(self.parts)
        middle.addWidget(self.room, 1)
        foot.addWidget(self.trace, 1)
        for button in (self.folder, self.browser, self.other, close):
            foot.addWidget(button)
        column = QVBoxLayout(self)
        column.setContentsMargins(14, 12, 14, 12)
        column.setSpacing(8)
        column.addLayout(top)
        column.addWidget(self.file)
        column.addLayout(middle, 1)
        column.addLayout(foot)

    def open_large(self) -> None:
        """Show it over most of its window."""
        room = self._window.size()
        self.resize(min(1400, room.width() - 60), min(900, room.height() - 60))
        self.show()
        self.raise_()
        self.activateWindow()

    def show_head(self, title: str, banner: str, file: str, parts: Sequence[str]) -> None:
        """Show what the report is, and the names of its parts; the first is chosen."""
        self.head.setText(title)
        self.banner.setText(banner)
        self.file.setText(file)
        self.parts.blockSignals(True)
        self.parts.clear()
        self.parts.addItems(list(parts))
        self.parts.blockSignals(False)
        self.parts.setCurrentRow(0)

    def show_part(self, widgets: Sequence[QWidget]) -> None:
        """Show one part, from its top."""
        body = QWidget()
        body.setObjectName("frame")
        column = QVBoxLayout(body)
        column.setContentsMargins(2, 0, GAP, 0)
        column.setSpacing(GAP)
        for widget in widgets:
            column.addWidget(widget)
        column.addStretch(1)
        self.room.setWidget(body)
        self.room.verticalScrollBar().setValue(0)

    def show_trace(self, words: str, *, can_open: bool) -> None:
        """Say where the chosen cell comes from, and whether its folder is here."""
        self.trace.setText(words or "Choose a cell to see where it comes from.")
        self.folder.setEnabled(can_open)


def _button(text: str, tip: str) -> QPushButton:
    button = QPushButton(text)
    button.setAutoDefault(False)
    button.setToolTip(tip)
    return button

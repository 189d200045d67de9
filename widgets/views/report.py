"""Pages of a report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from PySide6.QtCore import QRect, QSize, Qt, Signal
from PySide6.QtGui import QFont, QFontMetrics, QImage, QPainter, QPixmap, QResizeEvent
from PySide6.QtWidgets import (
    QAbstractItemView,
    QDialog,
    QHeaderView,
    QLabel,
    QListWidget,
    QPushButton,
    QStyledItemDelegate,
    QStyleOptionViewItem,
    QTableWidget,
    QTableWidgetItem,
    QWidget,
)

from touchdown.widgets import base

GAP = 10
PARTS_PX = 220  # width of the list


class PictureCard(QWidget):
    """Picture of known size between title and note; it may be set later."""

    def __init__(self, title: str, note: str, name: str, size: QSize) -> None:
        super().__init__()
        self.picture = QLabel()
        self.picture.setFixedSize(size)
        self.picture.setAccessibleName(name)
        column = base.vbox(parent=self, margins=(0, 0, 0, 0), spacing=4)
        if title:
            column.addWidget(base.label(title, "muted"))
        column.addWidget(self.picture)
        if note:
            words = base.label(note, "small", wrap=True)
            words.setFixedWidth(size.width())
            column.addWidget(words)
        column.addStretch(1)

    def show_picture(self, image: QImage) -> None:
        """Show the picture, which has the declared size."""
        self.picture.setPixmap(QPixmap.fromImage(image))


class ReportSheet(QDialog):
    """Non-modal window of a report: list of parts at the left, one part at the right."""

    part_chosen = Signal(int)

    def __init__(self, parent: QWidget) -> None:
        super().__init__(parent)
        self._window = parent
        self.setWindowTitle(base.tr("Report of experiments"))
        self.head, self.banner = (
            base.label("", "head", wrap=True),
            base.label("", "title", wrap=True),
        )
        self.banner.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self.file = base.ElidedLabel("small")
        self.parts = QListWidget()
        self.parts.setAccessibleName(base.tr("Parts of the report"))
        self.parts.setFixedWidth(PARTS_PX)
        base.WrappedItemDelegate(self.parts)
        self.parts.currentRowChanged.connect(self.part_chosen)
        self.room = base.scroll_area()
        self.room.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.browser = _button("Open in browser", "Show this report as a web page")
        self.other = _button("Open another", "Open another report")
        self._arrange()

    def _arrange(self) -> None:
        close = _button("Close", "")
        close.clicked.connect(self.close)
        top = base.hbox((self.head, 1), (self.banner, 1))
        middle = base.hbox(self.parts, (self.room, 1), spacing=GAP)
        foot = base.hbox(1, self.browser, self.other, close)
        base.vbox(
            top, self.file, (middle, 1), foot, parent=self, margins=(14, 12, 14, 12), spacing=8
        )

    def open_large(self) -> None:
        """Show the sheet over most of its window."""
        base.open_over(self, self._window, (1400, 900), 60)

    def show_head(self, title: str, banner: str, file: str, parts: Sequence[str]) -> None:
        """Show title, banner, file and the names of the parts; select the first."""
        self.head.setText(title)
        self.banner.setText(banner)
        self.file.setText(file)
        self.parts.blockSignals(True)
        self.parts.clear()
        self.parts.addItems(list(parts))
        self.parts.blockSignals(False)
        self.parts.setCurrentRow(0)

    def show_part(self, widgets: Sequence[QWidget]) -> None:
        """Show one part from its top."""
        body = QWidget()
        body.setObjectName("frame")
        base.vbox(*widgets, 1, parent=body, margins=(2, 0, GAP, 0), spacing=GAP)
        self.room.setWidget(body)
        self.room.verticalScrollBar().setValue(0)


def _button(text: str, tip: str) -> QPushButton:
    button = base.push_button(text, tip)
    button.setAutoDefault(False)
    return button


PAD_X, PAD_Y = 9, 6


@dataclass(frozen=True, slots=True)
class ReportCell:
    """``value`` with ``lines`` below it; ``trace`` names its source in the tool tip."""

    value: str
    lines: tuple[str, ...] = ()
    trace: str = ""


class ReportGrid(QTableWidget):
    """Table as high as its rows; scrolls sideways."""

    def __init__(
        self,
        theme: base.Theme,
        name: str,
        columns: Sequence[str],
        rows: Sequence[tuple[str, Sequence[ReportCell]]],
    ) -> None:
        super().__init__(len(rows), len(columns))
        self.setAccessibleName(name)
        self.setEditTriggers(QAbstractItemView.EditTrigger.NoEditTriggers)
        self.setSelectionMode(QAbstractItemView.SelectionMode.NoSelection)
        self.setHorizontalScrollMode(QAbstractItemView.ScrollMode.ScrollPerPixel)
        self.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setTabKeyNavigation(False)
        self.setWordWrap(False)
        # Kept alive here: Qt does not own the delegate.
        self._painter = _CellPainter(theme, self)
        self.setItemDelegate(self._painter)
        self.setHorizontalHeaderLabels(list(columns))
        self.setVerticalHeaderLabels([title for title, _ in rows])
        left = Qt.AlignmentFlag.AlignLeft | Qt.AlignmentFlag.AlignVCenter
        self.verticalHeader().setDefaultAlignment(left)
        for row, (title, cells) in enumerate(rows):
            for column, look in enumerate(cells):
                self.setItem(row, column, _item(look, title, columns[column]))
        for header in (self.horizontalHeader(), self.verticalHeader()):
            header.setSectionResizeMode(QHeaderView.ResizeMode.Fixed)
            header.setHighlightSections(False)
            header.setSectionsClickable(False)
        self.setCornerButtonEnabled(False)
        self.fit_to_theme()

    def fit_to_theme(self) -> None:
        """Adapt the sizes to the font scale."""
        self.resizeColumnsToContents()
        self.resizeRowsToContents()
        self._be_high()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Leave room for the scroll bar if the columns are wider than the view."""
        super().resizeEvent(event)
        self._be_high()

    def _be_high(self) -> None:
        across, down = self.horizontalHeader(), self.verticalHeader()
        high = across.sizeHint().height() + down.length() + 2 * self.frameWidth()
        if across.length() + down.sizeHint().width() + 2 * self.frameWidth() > self.width():
            high += self.horizontalScrollBar().sizeHint().height()
        self.setFixedHeight(high)


def _item(look: ReportCell, row: str, column: str) -> QTableWidgetItem:
    item = QTableWidgetItem(", ".join(filter(None, (look.value, *look.lines))))
    item.setData(Qt.ItemDataRole.UserRole, look)
    item.setToolTip(look.trace)
    words = f"{row}, {column.replace(chr(10), ' ')}: {item.text() or 'nothing'}"
    item.setData(Qt.ItemDataRole.AccessibleTextRole, words)
    return item


class _CellPainter(QStyledItemDelegate):
    def __init__(self, theme: base.Theme, parent: ReportGrid) -> None:
        super().__init__(parent)
        self._theme = theme

    def sizeHint(self, option: QStyleOptionViewItem, index: base.ModelIndex) -> QSize:
        look: ReportCell = index.data(Qt.ItemDataRole.UserRole)
        value, small = (QFontMetrics(font) for font in self._fonts())
        wide = [value.horizontalAdvance(look.value)]
        wide += [small.horizontalAdvance(line) for line in look.lines]
        high = value.height() + len(look.lines) * small.height()
        return QSize(max(wide) + 2 * PAD_X, high + 2 * PAD_Y)

    def paint(
        self, painter: QPainter, option: QStyleOptionViewItem, index: base.ModelIndex
    ) -> None:
        look: ReportCell = index.data(Qt.ItemDataRole.UserRole)
        tokens = self._theme.tokens
        painter.save()
        room = QRect(option.rect).adjusted(PAD_X, PAD_Y, -PAD_X, -PAD_Y)
        right = Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignTop
        for k, text in enumerate((look.value, *look.lines)):
            font = self._fonts()[min(k, 1)]
            painter.setFont(font)
            painter.setPen(tokens.colour("muted" if k else "text"))
            painter.drawText(room, int(right), text)
            room.setTop(room.top() + QFontMetrics(font).height())
        painter.restore()

    def _fonts(self) -> tuple[QFont, QFont]:
        scale = self._theme.scale
        return base.ui_font(scale, weight=600), base.ui_font(scale, 0.85)

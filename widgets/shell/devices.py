"""Device chips and inspector."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from PySide6.QtCore import QPoint, QPointF, QRectF, QSize, Qt, Signal
from PySide6.QtGui import QColor, QFontMetrics, QKeyEvent, QMouseEvent, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QDialog, QGridLayout, QLabel, QSizePolicy, QWidget

from touchdown.widgets import base
from touchdown.widgets.shell.state import Colour, Shape, draw_shape

ChipState = Literal["ready", "connecting", "degraded", "stale", "fault", "closed"]
_LOOK: dict[ChipState, tuple[Shape, Colour]] = {
    "ready": ("disc", "green"),
    "connecting": ("ring", "blue"),
    "degraded": ("triangle", "yellow"),
    "stale": ("triangle", "yellow"),
    "fault": ("square", "red"),
    "closed": ("ring", "grey"),
}


@dataclass(frozen=True, slots=True)
class ChipValue:
    """State and figures of one device. ``detail``: second line, such as "25.0 Hz, 12 ms"."""

    state: ChipState
    detail: str
    lost: int = 0
    tip: str = ""


def mark_colours(state: ChipState, tokens: base.Tokens) -> tuple[QColor, QColor | None]:
    """Return fill and rim of a state mark; a rim only where the fill lacks contrast."""
    colour = _LOOK[state][1]
    named = {"green": "good", "red": "bad", "grey": "muted", "blue": "text"}
    if colour != "yellow":
        return tokens.colour(named[colour]), None
    return tokens.colour("pill_yellow"), tokens.colour("text") if tokens.name == "light" else None


class DeviceChip(QWidget):
    """Two lines, device name and figures, beside a state mark; ``short`` hides the figures.

    ``clicked`` is emitted on a click and on Return.
    """

    clicked = Signal()

    def __init__(self, theme: base.Theme, name: str) -> None:
        super().__init__()
        self.short = False
        self._theme, self._name, self._tactile = theme, base.tr(name), "Tactile" in name
        self.value = ChipValue("closed", "no data")
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        self.setAccessibleName(base.tr("{}: closed", self._name))
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setCursor(Qt.CursorShape.PointingHandCursor)
        self.setAttribute(Qt.WidgetAttribute.WA_Hover)

    def show_value(self, value: ChipValue) -> None:
        """Show new figures."""
        if value == self.value:
            return
        self.value = value
        self.setToolTip(value.tip)
        self.setAccessibleName(f"{self._name}: {base.tr(value.state)}, {base.tr(value.detail)}")
        self.update()

    def sizeHint(self) -> QSize:
        """Return room for typical figures or, if ``short``, for the name."""
        figures = QFontMetrics(base.ui_font(self._theme.scale, 0.86))
        name = QFontMetrics(base.ui_font(self._theme.scale, 0.86, 600))
        width = name.horizontalAdvance(self._name)
        if not self.short:
            lost = name.horizontalAdvance(base.tr("  10 lost")) if self._tactile else 0
            width = max(figures.horizontalAdvance("1000 Hz, 00 ms"), width + lost)
        return QSize(width + self._left_px() + 10, 2 * figures.height() + 8)

    def _left_px(self) -> int:
        """Return the left edge of the text; the mark before it scales with the font."""
        return round(12 + 10 * max(self._theme.scale, 1.0))

    def minimumSizeHint(self) -> QSize:
        """Return the size hint: the bar decides what to leave out."""
        return self.sizeHint()

    def show_short(self, short: bool) -> None:
        """Hide or show the figures; the tool tip keeps them."""
        if short != self.short:
            self.short = short
            self.updateGeometry()
            self.update()

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:
        """Emit ``clicked`` if the button is released on the chip."""
        inside = self.rect().contains(event.position().toPoint())
        if event.button() is Qt.MouseButton.LeftButton and inside:
            self.clicked.emit()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Emit ``clicked`` on Return; Space can mean STOP."""
        if event.key() in base.ENTER and not event.isAutoRepeat():
            self.clicked.emit()
        else:
            super().keyPressEvent(event)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw mark, name and figures."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t = self._theme.tokens
        focused = self.hasFocus()
        painter.setPen(QPen(t.colour("focus" if focused else "hairline"), 2 if focused else 1))
        painter.setBrush(t.colour("hover" if self.underMouse() else "raised"))
        painter.drawRoundedRect(QRectF(self.rect()).adjusted(0.5, 0.5, -0.5, -0.5), 6, 6)
        ink, rim = mark_colours(self.value.state, t)
        size = (self._left_px() - 12) / 2
        place = QPointF(8 + size, self.height() / 2)
        draw_shape(painter, _LOOK[self.value.state][0], place, ink, size, rim)
        self._draw_text(painter)

    def _draw_text(self, painter: QPainter) -> None:
        t = self._theme.tokens
        left = self._left_px()
        middle, width = self.height() / 2, self.width() - left - 4
        painter.setPen(t.colour("text"))
        painter.setFont(base.ui_font(self._theme.scale, 0.86, 600))
        low, right = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignRight
        if self.short:
            high = painter.fontMetrics().height()
            box = QRectF(left, (self.height() - high) / 2, width, high)
            base.draw_elided_line(painter, box, self._name, t.colour("text"))
            return
        painter.drawText(QRectF(left, 3, width, middle - 2), int(low), self._name)
        if self.value.lost:
            painter.setFont(base.ui_font(self._theme.scale, 0.8, 500))
            box = QRectF(left, 3, width - 4, middle - 2)
            painter.drawText(box, int(low | right), base.tr("{} lost", self.value.lost))
        painter.setFont(base.ui_font(self._theme.scale, 0.8))
        box = QRectF(left, middle, width, middle - 3)
        base.draw_elided_line(painter, box, base.tr(self.value.detail), t.colour("muted"))


Rows = Sequence[tuple[str, str]]


class DeviceInspector(QDialog):
    """Table of the raw fields of one device."""

    def __init__(self, parent: QWidget, on_reconnect: Callable[[], None]) -> None:
        super().__init__(parent)
        self.key = ""
        tip = "Close the connection and open it again; the grip is kept"
        self.reconnect = base.push_button("Reconnect", tip)
        self.reconnect.clicked.connect(on_reconnect)
        self._head = base.label("", "head")
        self._grid = QGridLayout()
        self._grid.setHorizontalSpacing(28)
        self._grid.setVerticalSpacing(6)
        self._grid.setColumnStretch(1, 1)
        self._values: dict[str, QLabel] = {}
        close = base.push_button("Close")
        close.clicked.connect(self.close)
        buttons = base.hbox(self.reconnect, 1, close)
        rows = self._head, self._grid, 1, base.rule(), buttons
        base.vbox(*rows, parent=self, margins=(18, 14, 18, 14), spacing=10)
        self.setMinimumWidth(300)

    def open_at(self, key: str, title: str, rows: Rows, below: QPoint) -> None:
        """Show device ``key`` with the upper left corner at ``below`` (global coordinates)."""
        self.key = key
        self.setWindowTitle(base.tr("{}: raw fields", base.tr(title)))
        self._head.setText(base.tr(title))
        self.reconnect.setAccessibleName(base.tr("Reconnect {}", base.tr(title)))
        self._build(rows)
        self.adjustSize()
        self.move(below)
        self.show()
        self.raise_()

    def show_rows(self, rows: Rows) -> None:
        """Update the values; rebuild the table only if the fields changed."""
        if [field for field, _ in rows] != list(self._values):
            self._build(rows)
            return
        for field, value in rows:
            self._values[field].setText(value)

    def rows(self) -> dict[str, str]:
        """Return the shown values by field."""
        return {field: value.text() for field, value in self._values.items()}

    def _build(self, rows: Rows) -> None:
        while (item := self._grid.takeAt(0)) is not None:
            old = item.widget()
            if old is not None:
                old.deleteLater()
        self._values.clear()
        for row, (field, value) in enumerate(rows):
            shown = base.label(value)
            shown.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
            shown.setAccessibleName(base.tr(field))
            self._values[field] = shown
            self._grid.addWidget(base.label(field, "muted"), row, 0)
            self._grid.addWidget(shown, row, 1)

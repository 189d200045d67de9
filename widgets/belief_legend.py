"""What the marks on the belief map mean, each with its own shape."""

from __future__ import annotations

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QFontMetrics, QPainter, QPaintEvent, QPen, QResizeEvent
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.theme import Theme, ui_font

ENTRIES = (
    ("plus", "centre of mass"),
    ("line", "hull p > 0.9"),
    ("dots", "face"),
    ("arrow", "step"),
    ("ring", "target"),
)
TRUTH = ("dashes", "true overlap")


class BeliefLegend(QWidget):
    """A wrapping row of mark and word."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._truth = False
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAccessibleName("Legend of the belief map")

    def show_truth(self, shown: bool) -> None:
        """Add or leave out the true overlap."""
        if shown != self._truth:
            self._truth = shown
            self.updateGeometry()
            self.update()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Ask for another row where the entries do not fit."""
        self.updateGeometry()

    def sizeHint(self) -> QSize:
        """Return the rows that the present width needs."""
        rows = 1 + max((row for _, _, _, row in self._places()), default=0)
        return QSize(300, rows * self._line())

    def minimumSizeHint(self) -> QSize:
        """Return the same as the size hint."""
        return self.sizeHint()

    def _line(self) -> int:
        return self.fontMetrics().height() + 2

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the entries, row by row."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(ui_font(self._theme.scale, 0.88))
        line = self._line()
        for kind, text, x, row in self._places():
            y = row * line
            painter.setPen(QPen(self._theme.tokens.colour("text"), 1.6))
            _mark(painter, kind, QPointF(x + 9, y + line / 2))
            painter.setPen(self._theme.tokens.colour("muted"))
            box = QRectF(x + 22, y, self.width(), line)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignVCenter), text)

    def _places(self) -> list[tuple[str, str, float, int]]:
        """Return (mark, text, x, row) of every entry."""
        metrics = QFontMetrics(ui_font(self._theme.scale, 0.88))
        x, row, places = 0.0, 0, []
        for kind, text in (*ENTRIES, TRUTH) if self._truth else ENTRIES:
            width = 22 + metrics.horizontalAdvance(text) + 12
            if x > 0 and x + width - 12 > self.width():
                x, row = 0.0, row + 1
            places.append((kind, text, x, row))
            x += width
        return places


def _mark(painter: QPainter, kind: str, at: QPointF) -> None:
    left, right = at - QPointF(8, 0), at + QPointF(8, 0)
    pen = painter.pen()
    if kind == "plus":
        painter.drawLine(at - QPointF(5, 0), at + QPointF(5, 0))
        painter.drawLine(at - QPointF(0, 5), at + QPointF(0, 5))
    elif kind == "ring":
        painter.drawEllipse(at, 5, 5)
    elif kind == "arrow":
        painter.drawLine(left, right)
        painter.drawLine(right, right + QPointF(-5, -4))
        painter.drawLine(right, right + QPointF(-5, 4))
    else:
        styles = {"dots": Qt.PenStyle.DotLine, "dashes": Qt.PenStyle.DashLine}
        pen.setStyle(styles.get(kind, Qt.PenStyle.SolidLine))
        painter.setPen(pen)
        painter.drawLine(left, right)

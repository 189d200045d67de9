"""What views show instead of data: an honest sentence when there is none, a date when it is old."""

from __future__ import annotations

from PySide6.QtCore import QRect, QRectF, Qt
from PySide6.QtGui import QColor, QPainter

from widgets.theme import Theme, ui_font


def draw_message(
    painter: QPainter, rect: QRect | QRectF, theme: Theme, text: str, detail: str = ""
) -> None:
    """Write an empty state in the middle of ``rect``."""
    area = QRectF(rect)
    both = int(Qt.AlignmentFlag.AlignHCenter | Qt.TextFlag.TextWordWrap)
    middle = area.center().y()
    painter.setPen(theme.tokens.colour("text"))
    painter.setFont(ui_font(theme.scale, 1.1, 500))
    line = painter.fontMetrics().height()
    painter.drawText(
        QRectF(area.left() + 8, middle - line - 2, area.width() - 16, line + 2), both, text
    )
    if detail:
        painter.setPen(theme.tokens.colour("muted"))
        painter.setFont(ui_font(theme.scale, 0.92))
        painter.drawText(
            QRectF(area.left() + 12, middle + 4, area.width() - 24, area.height() / 2), both, detail
        )


def draw_stale(painter: QPainter, rect: QRectF, theme: Theme, age_s: float) -> None:
    """Dim ``rect`` to half and date it."""
    painter.fillRect(rect, QColor(0, 0, 0, 128))
    painter.setFont(ui_font(theme.scale, 1.0, 600))
    text = f"STALE {age_s:.1f} s"
    metrics = painter.fontMetrics()
    width = metrics.horizontalAdvance(text) + 16
    badge = QRectF(rect.center().x() - width / 2, rect.top() + 8, width, metrics.height() + 6)
    painter.fillRect(badge, theme.tokens.colour("pill_yellow"))
    painter.setPen(theme.tokens.colour("on_light"))
    painter.drawText(badge, int(Qt.AlignmentFlag.AlignCenter), text)

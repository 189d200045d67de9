"""What views show instead of data: an honest sentence when there is none, a date when it is old."""

from __future__ import annotations

from PySide6.QtCore import QRect, QRectF, Qt
from PySide6.QtGui import QColor, QPainter

from widgets.theme import Theme, ui_font

LINE_GAP_PX = 5


def draw_message(
    painter: QPainter, rect: QRect | QRectF, theme: Theme, text: str, detail: str = ""
) -> None:
    """Write an empty state in the middle of ``rect``: as many lines as the words need there."""
    both = int(Qt.AlignmentFlag.AlignHCenter | Qt.TextFlag.TextWordWrap)
    area = QRectF(rect).adjusted(8, 0, -8, 0)
    parts = [(text, "text", ui_font(theme.scale, 1.1, 500)),
             (detail, "muted", ui_font(theme.scale, 0.92))]  # fmt: skip
    boxes = []
    for words, token, font in parts:
        painter.setFont(font)
        high = painter.boundingRect(area, both, words).height() if words else 0.0
        boxes.append((words, token, font, high))
    top = area.center().y() - (sum(high for *_, high in boxes) + LINE_GAP_PX) / 2
    for words, token, font, high in boxes:
        if words:
            painter.setFont(font)
            painter.setPen(theme.tokens.colour(token))
            painter.drawText(QRectF(area.left(), top, area.width(), high), both, words)
            top += high + LINE_GAP_PX


def draw_stale(
    painter: QPainter, rect: QRectF, theme: Theme, age_s: float, into: QColor | None = None
) -> None:
    """Fade ``rect`` to half of ``into``, a picture to black, and date it."""
    veil = QColor(0, 0, 0) if into is None else QColor(into)
    veil.setAlpha(128)
    painter.fillRect(rect, veil)
    painter.setFont(ui_font(theme.scale, 1.0, 600))
    text = f"STALE {age_s:.1f} s"
    metrics = painter.fontMetrics()
    width = metrics.horizontalAdvance(text) + 16
    badge = QRectF(rect.center().x() - width / 2, rect.top() + 8, width, metrics.height() + 6)
    painter.fillRect(badge, theme.tokens.colour("pill_yellow"))
    painter.setPen(theme.tokens.colour("on_light"))
    painter.drawText(badge, int(Qt.AlignmentFlag.AlignCenter), text)

"""The bundled line icons, drawn in a colour of the theme."""

from __future__ import annotations

from importlib.resources import files

from PySide6.QtCore import QByteArray, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QIcon, QPainter, QPixmap, QPixmapCache
from PySide6.QtSvg import QSvgRenderer
from PySide6.QtWidgets import QAbstractButton

ICON_SHARE = 0.9


def icon(name: str, colour: QColor, size_px: int = 20) -> QIcon:
    """Return icon ``name`` (a file in resources/icons) drawn in ``colour``."""
    return QIcon(pixmap(name, colour, size_px * 2))


def fit_icon(*buttons: QAbstractButton) -> None:
    """Draw the icons of buttons as high as their letters."""
    for button in buttons:
        side = round(ICON_SHARE * button.fontMetrics().height())
        button.setIconSize(QSize(side, side))


def pixmap(name: str, colour: QColor, size_px: int) -> QPixmap:
    """Return icon ``name`` as a square pixmap; raises FileNotFoundError for an unknown one."""
    kept, drawn = f"icon {name} {colour.name()} {size_px}", QPixmap()
    if QPixmapCache.find(kept, drawn):
        return drawn
    source = files("resources").joinpath("icons", f"{name}.svg").read_text(encoding="utf-8")
    renderer = QSvgRenderer(QByteArray(source.replace("currentColor", colour.name()).encode()))
    drawn = QPixmap(size_px, size_px)
    drawn.fill(Qt.GlobalColor.transparent)
    painter = QPainter(drawn)
    renderer.render(painter, QRectF(0, 0, size_px, size_px))
    painter.end()
    QPixmapCache.insert(kept, drawn)
    return drawn

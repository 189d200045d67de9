"""Pictures of a report in the colours of the window."""

from __future__ import annotations

import re

from PySide6.QtCore import QRectF, Qt
from PySide6.QtGui import QImage, QPainter
from PySide6.QtSvg import QSvgRenderer

from backend.experiments.charts import BLUE, FAINT, INK, ORANGE, VIOLET
from widgets.theme import Tokens

USUAL_PX = 220, 220
NAMESPACES = 'xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink"'


def size_of(svg: str) -> tuple[int, int]:
    """Return width and height of a drawing as it says them, px."""
    found = [re.search(rf'<svg [^>]*\b{name}="(\d+)"', svg) for name in ("width", "height")]
    width, height = (None if one is None else int(one[1]) for one in found)
    return (width, height) if width and height else USUAL_PX


def drawn(svg: str, ratio: float, tokens: Tokens) -> QImage:
    """Return a drawing at ``ratio`` device pixels a pixel; callable on any thread."""
    width, height = size_of(svg)
    image = QImage(round(width * ratio), round(height * ratio), QImage.Format.Format_ARGB32)
    image.setDevicePixelRatio(ratio)
    image.fill(Qt.GlobalColor.transparent)
    painter = QPainter(image)
    QSvgRenderer(in_colours(svg, tokens).encode()).render(painter, QRectF(0, 0, width, height))
    painter.end()
    return image


def in_colours(svg: str, tokens: Tokens) -> str:
    """Return a chart in the colours of a theme, with the names that Qt looks for."""
    for own, theirs in (
        (INK, tokens.text),
        (FAINT, tokens.border),
        (BLUE, tokens.axis_x),
        (ORANGE, tokens.axis_y),
        (VIOLET, tokens.axis_z),
    ):
        svg = svg.replace(own, theirs)
    return svg.replace("<svg ", f"<svg {NAMESPACES} ", 1).replace(" href=", " xlink:href=")

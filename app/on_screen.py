"""Where a remembered window may stand: somewhere a hand can take hold of it."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtCore import QRect, QSize
from PySide6.QtGui import QRegion

GRIP = QSize(120, 30)
"""So much of the upper edge has to be on a screen."""


def pulled_back(window: QRect, screens: Sequence[QRect]) -> QRect:
    """Return ``window``; put into the nearest screen where it cannot be taken hold of.

    So is one that is larger than all screens together: STOP stands at its right edge.
    """
    if not screens:
        return window
    upper = QRect(window.left(), window.top(), window.width(), GRIP.height())
    room = QRegion()
    for screen in screens:
        room += screen
    whole = room.boundingRect().size()
    fits = window.width() <= whole.width() and window.height() <= whole.height()
    for screen in screens if fits else ():
        seen = screen.intersected(upper)
        if seen.width() >= min(GRIP.width(), window.width()) and seen.height() >= GRIP.height():
            return window
    nearest = min(screens, key=lambda screen: _away(screen, window))
    width, height = min(window.width(), nearest.width()), min(window.height(), nearest.height())
    x = min(max(window.left(), nearest.left()), nearest.left() + nearest.width() - width)
    y = min(max(window.top(), nearest.top()), nearest.top() + nearest.height() - height)
    return QRect(x, y, width, height)


def _away(screen: QRect, window: QRect) -> int:
    between = screen.center() - window.center()
    return between.manhattanLength()

"""Many straight lines at once, drawn from one block of memory instead of an object made for each.

Making 189 Qt lines anew in every picture took twice as long as drawing them.
"""

from __future__ import annotations

from typing import cast

import numpy as np
from PySide6.QtCore import QLineF
from PySide6.QtGui import QPainter
from shiboken6 import Shiboken

from backend.core.flow import FloatArray

BYTES = 4 * 8
"""A Qt line is four doubles: x1, y1, x2, y2."""


class Strokes:
    """Keeps its lines between pictures; only what they hold changes."""

    def __init__(self) -> None:
        self._memory: FloatArray = np.zeros((0, 4))
        self._lines: list[QLineF] = []

    def take(self, lines: FloatArray) -> None:
        """Hold ``lines`` (n, 4) from now on, in pixels of the painter."""
        if len(lines) > len(self._lines):
            # The lines go first: they lie in the memory.
            self._lines = []
            self._memory = np.zeros((len(lines), 4))
            start = self._memory.ctypes.data
            places = range(start, start + BYTES * len(lines), BYTES)
            self._lines = [cast("QLineF", Shiboken.wrapInstance(at, QLineF)) for at in places]
        self._memory[: len(lines)] = lines

    def draw(self, painter: QPainter, start: int, end: int) -> None:
        """Draw the lines from ``start`` up to but without ``end``."""
        if end > start:
            painter.drawLines(self._lines[start:end])

"""Predicted patches beside the truth: the map of each sample, the true patch as its outline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPen, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from backend.core.flow import FloatArray
from widgets.belief_marks import on_black
from widgets.colour_maps import colours
from widgets.overlay import draw_message
from widgets.theme import Theme, ui_font

GAP = 8
CAPTION_LINES = 2
LEAST_EM, MOST_EM = 4.6, 9.0
"""Side of a tile, in heights of the base font."""


@dataclass(frozen=True, slots=True)
class SampleScene:
    """One sample: face points (N, 2) mm on a lattice of ``pitch_mm``, both patches (N,), words."""

    points_mm: FloatArray
    probability: FloatArray
    truth: NDArray[np.bool_]
    caption: str
    detail: str
    pitch_mm: float = 1.0


class SampleStrip(QWidget):
    """As many samples as there is room for, from the best to the worst."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self.scenes: tuple[SampleScene, ...] = ()
        self._why = "Choose a finished run."
        self.setAccessibleName("Sample predictions beside the truth")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(200, 110)

    def sizeHint(self) -> QSize:
        """Return room for two rows."""
        return QSize(520, 240)

    def show_scenes(self, scenes: Sequence[SampleScene], why: str = "") -> None:
        """Show these samples; ``why`` there are none."""
        self.scenes, self._why = tuple(scenes), why
        words = [f"{scene.caption}, {scene.detail}" for scene in self.shown()]
        self.setAccessibleDescription("; ".join(words) or why)
        self.update()

    def _grid(self) -> tuple[int, int, float]:
        """Return (columns, rows, side) that cover the most; captions need ``LEAST_EM``."""
        em = self.fontMetrics().height()
        best, covered = (1, 1, LEAST_EM * em), 0.0
        for columns in range(1, 9):
            for rows in range(1, 4):
                side = min((self.width() + GAP) / columns, (self.height() + GAP) / rows - 2 * em)
                side = min(side - GAP, MOST_EM * em)
                count = min(columns * rows, len(self.scenes))
                if side >= LEAST_EM * em and count * side**2 > covered:
                    best, covered = (columns, rows, side), count * side**2
        return best

    def shown(self) -> list[SampleScene]:
        """Return what there is room for, evenly from the best to the worst."""
        if not self.scenes:
            return []
        columns, rows, _ = self._grid()
        count = min(columns * rows, len(self.scenes))
        places = np.linspace(0, len(self.scenes) - 1, count).round().astype(int)
        return [self.scenes[k] for k in places.tolist()]

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the tiles."""
        painter = QPainter(self)
        if not self.scenes:
            draw_message(painter, self.rect(), self._theme, "No samples", self._why)
            return
        columns, _, side = self._grid()
        em = self.fontMetrics().height()
        for place, scene in enumerate(self.shown()):
            row, column = divmod(place, columns)
            x, y = column * (side + GAP), row * (side + GAP + CAPTION_LINES * em)
            self._tile(painter, QRectF(x, y, side, side), scene)

    def _tile(self, painter: QPainter, box: QRectF, scene: SampleScene) -> None:
        t = self._theme.tokens
        painter.fillRect(box, t.colour("bg"))
        reach = float(np.abs(scene.points_mm).max()) + scene.pitch_mm
        scale = box.width() / (2 * reach)
        cell = scene.pitch_mm * scale
        painter.setPen(Qt.PenStyle.NoPen)
        rgb = colours(scene.probability, "cividis")
        centres = scene.points_mm * (scale, -scale) + (box.center().x(), box.center().y())
        for (x, y), colour in zip(centres.tolist(), rgb.tolist(), strict=True):
            painter.fillRect(QRectF(x - cell / 2, y - cell / 2, cell + 0.5, cell + 0.5),
                             QColor(*colour))  # fmt: skip
        edges = _edges(scene.points_mm[scene.truth], scene.pitch_mm)
        lines = edges * (scale, -scale) + (box.center().x(), box.center().y())

        def stroke() -> None:
            for (x0, y0), (x1, y1) in lines.tolist():
                painter.drawPolyline(QPolygonF([QPointF(x0, y0), QPointF(x1, y1)]))

        on_black(painter, 1.4, Qt.PenStyle.SolidLine, stroke)
        self._words(painter, box, scene)

    def _words(self, painter: QPainter, box: QRectF, scene: SampleScene) -> None:
        em = self.fontMetrics().height()
        mode = Qt.TextElideMode.ElideRight
        for row, (text, token, size) in enumerate(
            ((scene.caption, "text", 0.88), (scene.detail, "muted", 0.82))
        ):
            painter.setFont(ui_font(self._theme.scale, size, 500 if row == 0 else 400))
            painter.setPen(QPen(self._theme.tokens.colour(token)))
            line = QRectF(box.left(), box.bottom() + 1 + 0.92 * em * row, box.width() + GAP - 2, em)
            shown = painter.fontMetrics().elidedText(text, mode, int(line.width()))
            painter.drawText(line, int(Qt.AlignmentFlag.AlignLeft), shown)


def _edges(points_mm: FloatArray, pitch_mm: float) -> FloatArray:
    """Return (k, 2, 2) the sides of the lattice cells of ``points_mm`` that no two cells share."""
    cells = {(round(x / pitch_mm), round(y / pitch_mm)) for x, y in points_mm.tolist()}
    half = pitch_mm / 2
    found = []
    for i, j in sorted(cells):
        x, y = i * pitch_mm, j * pitch_mm
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            if (i + di, j + dj) in cells:
                continue
            mid = (x + di * half, y + dj * half)
            along = (abs(dj) * half, abs(di) * half)
            found.append(
                ((mid[0] - along[0], mid[1] - along[1]), (mid[0] + along[0], mid[1] + along[1]))
            )
    return np.asarray(found, dtype=np.float64).reshape(-1, 2, 2)

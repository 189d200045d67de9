"""Picture of the scene camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QImage, QPainter, QPen

from touchdown.backend.core import FloatArray, ImageArray
from touchdown.widgets.base import Theme, tr, ui_font
from touchdown.widgets.plots import PictureView, draw_message, draw_rings

OutlineKind = Literal["bottom", "label", "scene"]
# Line colours and styles on photographs, in every theme.
OUTLINE_STYLES: dict[OutlineKind, tuple[str, Qt.PenStyle]] = {
    "bottom": ("#FFFFFF", Qt.PenStyle.SolidLine),
    "label": ("#F0E442", Qt.PenStyle.SolidLine),
    "scene": ("#7CF2FF", Qt.PenStyle.DotLine),
}
NO_PICTURE = "No scene picture"
NO_PICTURE_DETAIL = "The label relies on arm, grasp and annotator alone."
GAP = 4
ROOM = 1.8  # size of the shown part in sizes of the outlines
SHADOW = QColor(0, 0, 0, 150)


@dataclass(frozen=True, slots=True)
class PictureOutline:
    """Outline in a picture; ``points_px`` (n, 2), a row of NaN between two rings."""

    kind: OutlineKind
    points_px: FloatArray


@dataclass(frozen=True, slots=True)
class SceneShot:
    """Picture (h, w, 3) BGR with the outlines to draw on it."""

    image: ImageArray
    outlines: tuple[PictureOutline, ...]


class SceneShotView(PictureView):
    """Pictures side by side, cut to the same part around the outlines of the first."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Pictures of the scene camera", (240, 120), (480, 180))
        self.shots: tuple[SceneShot, ...] = ()
        self._why_empty = NO_PICTURE

    def show_shots(self, shots: Sequence[SceneShot], why: str = NO_PICTURE) -> None:
        """Show pictures of an episode; ``why``: reason if there are none."""
        self.shots, self._why_empty = tuple(shots), why
        kinds = ", ".join(tr(o.kind) for shot in self.shots[:1] for o in shot.outlines)
        self.setAccessibleDescription(
            tr("{} pictures, outlines: {}", len(self.shots), kinds or tr("none"))
        )
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw pictures and outlines."""
        painter.fillRect(self.rect().adjusted(0, 0, 1, 1), self._theme.tokens.colour("bg"))
        if not self.shots:
            text = NO_PICTURE_DETAIL if self._why_empty == NO_PICTURE else ""
            draw_message(painter, self.rect(), self._theme, self._why_empty, text)
            return
        painter.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        width = (self.width() - GAP * (len(self.shots) - 1)) / len(self.shots)
        part = picture_part(self.shots[0], width / max(self.height(), 1))
        for number, shot in enumerate(self.shots):
            place = QRectF(number * (width + GAP), 0, width, self.height())
            self._draw(painter, place, shot, part)

    def _draw(self, painter: QPainter, target: QRectF, shot: SceneShot, part: QRectF) -> None:
        height, width = shot.image.shape[:2]
        image = QImage(shot.image.data, width, height, 3 * width, QImage.Format.Format_BGR888)
        painter.save()
        painter.setClipRect(target)
        painter.drawImage(target, image, part)
        scale, left, top = target.width() / part.width(), target.left(), target.top()
        shift = np.array([left - scale * part.left(), top - scale * part.top()])
        painter.setBrush(Qt.BrushStyle.NoBrush)
        painter.setFont(ui_font(self._theme.scale, 0.85, 500))
        line = painter.fontMetrics().height()
        for row, outline in enumerate(shot.outlines):
            colour, style = OUTLINE_STYLES[outline.kind]
            points = scale * outline.points_px + shift
            painter.setPen(QPen(SHADOW, 3))
            draw_rings(painter, points)
            painter.setPen(QPen(QColor(colour), 1.5, style))
            draw_rings(painter, points)
            at = QPointF(left + 6, top + 4 + (row + 0.8) * line)
            painter.setPen(SHADOW)
            painter.drawText(at + QPointF(1, 1), tr(outline.kind))
            painter.setPen(QColor(colour))
            painter.drawText(at, tr(outline.kind))
        painter.restore()


def picture_part(shot: SceneShot, aspect: float) -> QRectF:
    """Return the part to show, of width over height ``aspect``, inside the picture."""
    height, width = shot.image.shape[:2]
    corners = np.array([[0.0, 0.0], [width, height]])
    points = np.concatenate([o.points_px for o in shot.outlines] or [corners])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    across, down = (ROOM * (high - low)).tolist()
    across = min(max(across, aspect * down), width, aspect * height)
    down = across / aspect
    x, y = ((low + high) / 2).tolist()
    left = min(max(x - across / 2, 0.0), width - across)
    top = min(max(y - down / 2, 0.0), height - down)
    return QRectF(left, top, across, down)

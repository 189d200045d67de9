"""Marks of the offset view. Sources differ by line and letter, points by filling: not by colour."""

from __future__ import annotations

import math

import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QPainter, QPen, QPolygonF

from backend.core.flow import FloatArray
from widgets.belief_marks import plus
from widgets.offset_scene import Ghost, GhostKind, OffsetScene, Point
from widgets.plot_axes import PlotArea
from widgets.theme import Theme, blend, ui_font

LINES: dict[GhostKind, Qt.PenStyle] = {
    "commanded": Qt.PenStyle.DashLine,
    "measured": Qt.PenStyle.DotLine,
    "scene": Qt.PenStyle.DashDotDotLine,
    "model": Qt.PenStyle.DashDotLine,
}
AT: dict[GhostKind, float] = {"commanded": 2.1, "measured": 3.9, "scene": 1.0, "model": -0.6}
"""Where on its outline a source is named (rad)."""
SCALE_BAR_MM = 5.0
THICKEN_PX = 0.3


def draw_scale_bar(painter: QPainter, area: PlotArea, theme: Theme) -> None:
    """Draw a bar of 5 mm at the lower left."""
    length = SCALE_BAR_MM * area.rect.width() / (area.x1 - area.x0)
    left, y = area.rect.left() + 10, area.rect.bottom() - 10
    painter.setPen(QPen(theme.tokens.colour("text"), 2))
    painter.drawLine(QPointF(left, y), QPointF(left + length, y))
    for x in (left, left + length):
        painter.drawLine(QPointF(x, y - 4), QPointF(x, y + 4))
    painter.drawText(QPointF(left, y - 8), f"{SCALE_BAR_MM:g} mm")


def draw_bottom(painter: QPainter, area: PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw the bottom face, filled, with its centre."""
    t = theme.tokens
    painter.setPen(QPen(t.colour("border"), 2))
    painter.setBrush(blend(t.colour("bg"), t.colour("border"), 0.22))
    painter.drawPolygon(_placed(area, scene.bottom, (0.0, 0.0), 0.0))
    painter.setBrush(Qt.BrushStyle.NoBrush)
    painter.setPen(QPen(t.colour("muted"), 1))
    centre = QPointF(area.x(0.0), area.y(0.0))
    for arm in (QPointF(4, 0), QPointF(0, 4)):
        painter.drawLine(centre - arm, centre + arm)


def legend_left(scene: OffsetScene) -> bool:
    """Whether sources are named at the upper left: where the face is not."""
    return scene.offset_mm is not None and scene.offset_mm[0] > 0


def draw_ghosts(painter: QPainter, area: PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw where other sources put the face: outline, uncertainty, and the name of the source."""
    painter.setBrush(Qt.BrushStyle.NoBrush)
    painter.setFont(ui_font(theme.scale, 0.85, 500))
    height = painter.fontMetrics().height()
    for row, ghost in enumerate(scene.ghosts):
        pen = QPen(theme.tokens.colour("muted"), 1)
        pen.setStyle(LINES[ghost.kind])
        painter.setPen(pen)
        outline = _placed(area, scene.face, ghost.offset_mm, scene.yaw_rad)
        # Twice a thin line: one that is wider than 1 px takes ten times as long to be dashed.
        painter.drawPolygon(outline)
        painter.drawPolygon(outline.translated(THICKEN_PX, THICKEN_PX))
        _sigma_circle(painter, area, ghost.offset_mm, ghost.sigma_mm)
        _legend_line(painter, area, ghost, row, height, left=legend_left(scene))
        _letters(painter, area, scene, ghost)


def _letters(painter: QPainter, area: PlotArea, scene: OffsetScene, ghost: Ghost) -> None:
    """Write the source beside its outline, each source at another side of it."""
    turn = AT[ghost.kind]
    radius = float(np.hypot(*scene.face.T).max())
    x = area.x(ghost.offset_mm[0] + radius * math.cos(turn))
    y = area.y(ghost.offset_mm[1] + radius * math.sin(turn))
    outwards = QPointF(9 * math.cos(turn), -9 * math.sin(turn))
    box = QRectF(x - 20, y - 10, 40, 20).translated(outwards)
    painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), ghost.kind[:2].capitalize())


def _legend_line(
    painter: QPainter, area: PlotArea, ghost: Ghost, row: int, height: float, *, left: bool
) -> None:
    """Name line and letters in an upper corner; at the left below the name of the axis."""
    text = f"{ghost.kind[:2].capitalize()}  {ghost.kind}"
    width = painter.fontMetrics().horizontalAdvance(text)
    y = area.rect.top() + 4 + (row + (1.5 if left else 0.5)) * (height + 2)
    at = area.rect.left() + 42 if left else area.rect.right() - 8 - width
    box = QRectF(at, y - height / 2, width, height)
    painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft), text)
    painter.drawLine(QPointF(box.left() - 34, y), QPointF(box.left() - 6, y))


def draw_face(painter: QPainter, area: PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw the face where the label puts it, with all that follows."""
    if scene.offset_mm is None:
        return
    t = theme.tokens
    _points(painter, area, scene.points_mm[~scene.touching], t.colour("muted"), 2.0)
    _points(painter, area, scene.points_mm[scene.touching], t.colour("axis_x"), 4.5)
    painter.setBrush(Qt.BrushStyle.NoBrush)
    if len(scene.hull_mm):
        painter.setPen(QPen(t.colour("good" if scene.margin_mm >= 0 else "bad"), 2))
        painter.drawPolygon(_placed(area, scene.hull_mm, (0.0, 0.0), 0.0))
    painter.setPen(QPen(t.colour("text"), 2))
    painter.drawPolygon(_placed(area, scene.face, scene.offset_mm, scene.yaw_rad))
    painter.setPen(QPen(t.colour("text"), 1))
    _sigma_circle(painter, area, scene.offset_mm, scene.sigma_mm)
    plus(painter, QPointF(area.x(scene.centre_mm[0]), area.y(scene.centre_mm[1])), 8)


def draw_names(painter: QPainter, area: PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Write what bottom and face are, each where the other is not, and the way between them."""
    if scene.names is None or scene.offset_mm is None:
        return
    away = np.array(scene.offset_mm)
    length = float(np.hypot(*away))
    way = away / length if length > 0 else np.array([1.0, 0.0])
    centre = QPointF(area.x(0.0), area.y(0.0))
    face = QPointF(area.x(scene.offset_mm[0]), area.y(scene.offset_mm[1]))
    painter.setPen(QPen(theme.tokens.colour("text"), 1, Qt.PenStyle.DotLine))
    painter.drawLine(centre, face)
    plus(painter, face, 6)
    painter.setPen(theme.tokens.colour("text"))
    painter.setFont(ui_font(theme.scale, 1.0, 600))
    reach = [0.55 * float(np.hypot(*outline.T).max()) for outline in (scene.bottom, scene.face)]
    places = (-reach[0] * way, away + reach[1] * way)
    for (x, y), name in zip(places, scene.names, strict=True):
        box = QRectF(area.x(float(x)) - 80, area.y(float(y)) - 12, 160, 24)
        painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), name)


def _points(
    painter: QPainter, area: PlotArea, points: FloatArray, colour: QColor, size: float
) -> None:
    """Draw squares: round points take seven times as long."""
    pen = QPen(colour, size)
    pen.setCapStyle(Qt.PenCapStyle.SquareCap)
    painter.setPen(pen)
    painter.drawPoints(area.polygon(points[:, 0], points[:, 1]))


def _sigma_circle(painter: QPainter, area: PlotArea, at_mm: Point, sigma_mm: float) -> None:
    if sigma_mm > 0:
        scale = area.rect.width() / (area.x1 - area.x0)
        radius = sigma_mm * scale
        painter.drawEllipse(QPointF(area.x(at_mm[0]), area.y(at_mm[1])), radius, radius)


def _placed(area: PlotArea, outline: FloatArray, at_mm: Point, yaw_rad: float) -> QPolygonF:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x = outline[:, 0] * c - outline[:, 1] * s + at_mm[0]
    y = outline[:, 0] * s + outline[:, 1] * c + at_mm[1]
    return area.polygon(x, y)

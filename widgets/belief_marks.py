"""Marks on the belief map. Each is white on black, so that it is seen on every map colour."""

from __future__ import annotations

import math
from collections.abc import Callable

from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QPainter, QPen, QPolygonF

from backend.core.flow import FloatArray
from widgets.belief_scene import BeliefScene
from widgets.plot_axes import PlotArea
from widgets.theme import Theme, ui_font

WHITE, BLACK = QColor("#FFFFFF"), QColor("#000000")
Draw = Callable[[], None]


def draw_all(
    painter: QPainter, area: PlotArea, scene: BeliefScene, theme: Theme, *, small: bool
) -> None:
    """Draw every mark of the scene; ``small`` leaves out what a thumbnail cannot carry."""
    painter.setBrush(Qt.BrushStyle.NoBrush)
    if scene.face is not None and scene.path and not small:
        _outline(painter, area, scene.face, scene.path[-1], Qt.PenStyle.DotLine, 1.0)
    if scene.truth is not None:
        _outline(painter, area, scene.truth, (0.0, 0.0), Qt.PenStyle.DashLine, 1.6)
    if scene.stability is not None and len(scene.stability.hull_mm):
        _outline(painter, area, scene.stability.hull_mm, (0.0, 0.0), Qt.PenStyle.SolidLine,
                 1.4 if small else 2.0)  # fmt: skip
    if not small:
        _path(painter, area, scene, theme)
    if scene.stability is not None:
        centre = scene.stability.centre_mm
        if all(map(math.isfinite, centre)):
            if scene.step_mm is not None and not small and scene.step_mm != (0.0, 0.0):
                _step(painter, area, centre, scene)
            plus(painter, QPointF(area.x(centre[0]), area.y(centre[1])), 4 if small else 8)


def on_black(painter: QPainter, width: float, style: Qt.PenStyle, draw: Draw) -> None:
    """Stroke twice: black two pixels wider below, white above."""
    for colour, extra in ((BLACK, 2.0), (WHITE, 0.0)):
        pen = QPen(colour, width + extra)
        if style is not Qt.PenStyle.SolidLine and colour is WHITE:
            pen.setStyle(style)
        pen.setJoinStyle(Qt.PenJoinStyle.RoundJoin)
        painter.setPen(pen)
        draw()


def plus(painter: QPainter, at: QPointF, size: float) -> None:
    """Draw the centre of mass: a plus."""

    def stroke() -> None:
        painter.drawLine(at - QPointF(size, 0), at + QPointF(size, 0))
        painter.drawLine(at - QPointF(0, size), at + QPointF(0, size))

    on_black(painter, 2.6, Qt.PenStyle.SolidLine, stroke)


def _outline(
    painter: QPainter,
    area: PlotArea,
    points: FloatArray,
    shift: tuple[float, float],
    style: Qt.PenStyle,
    width: float,
) -> None:
    polygon = QPolygonF(
        [QPointF(area.x(x + shift[0]), area.y(y + shift[1])) for x, y in points.tolist()]
    )
    on_black(painter, width, style, lambda: painter.drawPolygon(polygon))


def _path(painter: QPainter, area: PlotArea, scene: BeliefScene, theme: Theme) -> None:
    points = [QPointF(area.x(x), area.y(y)) for x, y in scene.path]
    on_black(painter, 1.0, Qt.PenStyle.SolidLine, lambda: painter.drawPolyline(QPolygonF(points)))
    painter.setFont(ui_font(theme.scale, 0.8, 600))
    # The newest probe carries the plus of the centre of mass instead of a number.
    for number, point in enumerate(points[:-1], start=1):
        ring = QRectF(point.x() - 8, point.y() - 8, 16, 16)
        painter.setPen(QPen(WHITE, 1.5))
        painter.setBrush(BLACK)
        painter.drawEllipse(ring)
        painter.setPen(WHITE)
        painter.drawText(ring, int(Qt.AlignmentFlag.AlignCenter), str(number))
    painter.setBrush(Qt.BrushStyle.NoBrush)


def _step(
    painter: QPainter, area: PlotArea, start: tuple[float, float], scene: BeliefScene
) -> None:
    step = scene.step_mm or (0.0, 0.0)
    tail = QPointF(area.x(start[0]), area.y(start[1]))
    tip = QPointF(area.x(start[0] + step[0]), area.y(start[1] + step[1]))
    if scene.target_mm is not None and all(map(math.isfinite, scene.target_mm)):
        target = QPointF(area.x(scene.target_mm[0]), area.y(scene.target_mm[1]))
        if scene.clipped:
            on_black(painter, 1.0, Qt.PenStyle.DotLine, lambda: painter.drawLine(tip, target))
        on_black(painter, 1.6, Qt.PenStyle.SolidLine, lambda: painter.drawEllipse(target, 6, 6))
    along = tip - tail
    length = math.hypot(along.x(), along.y())
    if length < 1:
        return
    unit, across = along / length, QPointF(-along.y(), along.x()) / length

    def stroke() -> None:
        painter.drawLine(tail, tip)
        painter.drawLine(tip, tip - unit * 10 + across * 5)
        painter.drawLine(tip, tip - unit * 10 - across * 5)

    on_black(painter, 2.2, Qt.PenStyle.SolidLine, stroke)

"""The belief map: probability of support, hull, centre of mass, planned step and path."""

from __future__ import annotations

import numpy as np
from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QImage, QPainter, QPaintEvent, QPen, QPixmap
from PySide6.QtWidgets import QSizePolicy, QWidget

from backend.core.flow import BeliefMap
from widgets import belief_marks as marks
from widgets.belief_scene import BeliefScene
from widgets.colour_maps import MapName, colours
from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea, nice_step, tick_text, ticks
from widgets.theme import Theme, ui_font


class BeliefView(QWidget):
    """Draws a ``BeliefScene``; redrawn only when the scene, size or theme changes."""

    def __init__(self, theme: Theme, *, thumbnail: bool = False) -> None:
        super().__init__()
        self._theme, self._thumbnail = theme, thumbnail
        self.scene = BeliefScene()
        self.map_name: MapName = "cividis"
        self._drawn: QPixmap | None = None
        self._key: tuple[object, ...] = ()
        self.paints = self.renders = 0
        self.setAccessibleName("Belief map")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(*((40, 40) if thumbnail else (240, 200)))

    def sizeHint(self) -> QSize:
        """Return a square."""
        return QSize(480, 480)

    def show_scene(self, scene: BeliefScene) -> None:
        """Show another scene."""
        self.scene = scene
        self._drawn = None
        self.setAccessibleDescription(describe(scene))
        self.update()

    def show_map(self, name: MapName) -> None:
        """Choose the colour map."""
        self.map_name = name
        self._drawn = None
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Blit the drawing; draw it anew if something changed."""
        self.paints += 1
        key = (self.size().toTuple(), self._theme.tokens.name, self._theme.scale, self.map_name)
        if self._drawn is None or key != self._key:
            self._key = key
            ratio = self.devicePixelRatioF()
            self._drawn = QPixmap(self.size() * ratio)
            self._drawn.setDevicePixelRatio(ratio)
            self._drawn.fill(self._theme.tokens.colour("panel"))
            inner = QPainter(self._drawn)
            inner.setRenderHint(QPainter.RenderHint.Antialiasing)
            try:
                self._draw(inner)
            finally:
                # Qt aborts the process if a picture dies while it is painted.
                inner.end()
            self.renders += 1
        painter = QPainter(self)
        painter.drawPixmap(0, 0, self._drawn)

    def side_px(self, size: QSize) -> float:
        """Return the side of the square that is drawn in a view of this size."""
        left, top, right, bottom = self._margins()
        return max(min(size.width() - left - right, size.height() - top - bottom), 10.0)

    def _margins(self) -> tuple[float, float, float, float]:
        """Return the room of axes and colour bar: left, top, right, bottom."""
        if self._thumbnail:
            return 1.0, 1.0, 1.0, 1.0
        em = self.fontMetrics().height()
        return 2.2 * em, 0.4 * em, 3.4 * em, 1.5 * em

    def area(self) -> PlotArea:
        """Return the square in which the map is drawn."""
        left, top, right, bottom = self._margins()
        side = self.side_px(self.size())
        x = left + (self.width() - left - right - side) / 2
        y = top + (self.height() - top - bottom - side) / 2
        cx, cy, half = self.scene.frame_mm()
        return PlotArea(QRectF(x, y, side, side), cx - half, cx + half, cy - half, cy + half)

    def _draw(self, painter: QPainter) -> None:
        area, t = self.area(), self._theme.tokens
        painter.fillRect(area.rect, t.colour("bg"))
        if not self._thumbnail:
            self._draw_axes(painter, area)
        belief = self.scene.belief
        if belief is None:
            if not self._thumbnail:
                draw_message(painter, area.rect, self._theme, *self.scene.empty)
            return
        painter.save()
        painter.setClipRect(area.rect)
        self._draw_cells(painter, area, belief)
        marks.draw_all(painter, area, self.scene, self._theme, small=self._thumbnail)
        painter.restore()
        if not self._thumbnail:
            self._draw_colour_bar(painter, area)

    def _draw_cells(self, painter: QPainter, area: PlotArea, belief: BeliefMap) -> None:
        ny, nx = belief.log_odds.shape
        rgba = np.zeros((ny, nx, 4), dtype=np.uint8)
        rgba[..., :3] = colours(belief.probability, self.map_name)
        rgba[..., 3] = np.where(belief.covered, 255, 0)
        rgba = np.ascontiguousarray(rgba[::-1])
        image = QImage(rgba.data, nx, ny, 4 * nx, QImage.Format.Format_RGBA8888)
        half = belief.pitch_mm / 2
        x0, y0 = belief.origin_mm[0] - half, belief.origin_mm[1] - half
        x1, y1 = x0 + nx * belief.pitch_mm, y0 + ny * belief.pitch_mm
        target = QRectF(QPointF(area.x(x0), area.y(y1)), QPointF(area.x(x1), area.y(y0)))
        painter.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform, False)
        painter.drawImage(target, image)

    def _draw_axes(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self._theme.tokens, area.rect
        painter.setFont(ui_font(self._theme.scale, 0.85))
        height = painter.fontMetrics().height()
        step = nice_step(area.x1 - area.x0, 6)
        for value in ticks(area.x0, area.x1, 6):
            x, text = area.x(value), tick_text(value, step)
            painter.setPen(QPen(t.colour("grid"), 1))
            painter.drawLine(QPointF(x, rect.top()), QPointF(x, rect.bottom()))
            painter.setPen(t.colour("muted"))
            painter.drawText(QRectF(x - 30, rect.bottom() + 3, 60, height),
                             int(Qt.AlignmentFlag.AlignHCenter), text)  # fmt: skip
        for value in ticks(area.y0, area.y1, 6):
            y, text = area.y(value), tick_text(value, step)
            painter.setPen(QPen(t.colour("grid"), 1))
            painter.drawLine(QPointF(rect.left(), y), QPointF(rect.right(), y))
            painter.setPen(t.colour("muted"))
            box = QRectF(rect.left() - 46, y - height / 2, 40, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignRight), text)
        corner = rect.adjusted(6, 4, -6, -4)
        low, right = Qt.AlignmentFlag.AlignBottom, Qt.AlignmentFlag.AlignRight
        painter.drawText(corner, int(low | right), "x (mm)")
        painter.drawText(corner, int(Qt.AlignmentFlag.AlignLeft), "y (mm)")

    def _draw_colour_bar(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self._theme.tokens, area.rect
        bar = QRectF(rect.right() + 10, rect.top(), 10, rect.height())
        ramp = np.ascontiguousarray(colours(np.linspace(1, 0, 128)[:, None], self.map_name))
        painter.drawImage(bar, QImage(ramp.data, 1, 128, 3, QImage.Format.Format_RGB888))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        height = painter.fontMetrics().height()
        painter.setPen(t.colour("muted"))
        for value in (0.0, 0.25, 0.5, 0.75, 1.0):
            y = bar.bottom() - value * bar.height()
            y_text = min(max(y - height / 2, bar.top() - 3), bar.bottom() - height + 3)
            painter.drawText(QPointF(bar.right() + 5, y_text + painter.fontMetrics().ascent()),
                             f"{value:g}")  # fmt: skip
        y = bar.bottom() - self.scene.delta * bar.height()
        painter.setPen(QPen(QColor("#000000"), 3))
        painter.drawLine(QPointF(bar.left(), y), QPointF(bar.right(), y))
        painter.setPen(QPen(QColor("#FFFFFF"), 1))
        painter.drawLine(QPointF(bar.left(), y), QPointF(bar.right(), y))


def describe(scene: BeliefScene) -> str:
    """Return the scene in one sentence, for screen readers."""
    if scene.belief is None:
        return scene.empty[0]
    text = (
        f"{scene.belief.probes} probes fused, largest support {scene.belief.probability.max():.2f}"
    )
    if scene.stability is not None:
        text += f", {scene.stability.support.value}, margin {scene.stability.margin_mm:.1f} mm"
    return text

"""The grasped face over the bottom face: where it is, what touches, whether it would stand.

Dragging reports where the face is wanted; whoever owns the label answers with another scene.
"""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QMouseEvent, QPainter, QPaintEvent, QPixmap
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets import offset_marks as marks
from widgets.mm_grid import draw_mm_grid
from widgets.offset_scene import OffsetScene, Point, offset_in_words, verdict_in_words
from widgets.overlay import draw_message
from widgets.plot_axes import PlotArea
from widgets.theme import Theme, ui_font

Moved = Callable[[Point], None]


class OffsetView(QWidget):
    """Draws an ``OffsetScene``; what a nudge does not change is drawn once."""

    def __init__(self, theme: Theme, moved: Moved, dropped: Callable[[], None]) -> None:
        super().__init__()
        self._theme, self._moved, self._dropped = theme, moved, dropped
        self.scene: OffsetScene | None = None
        self.editable = True
        self._held_mm: Point | None = None
        self._grasped: PlotArea | None = None
        """The scale at which the face was taken: one that grows meanwhile moves no face."""
        self._reach_mm = 1.0
        self._ground: QPixmap | None = None
        self._behind: QPixmap | None = None
        self._ground_key: tuple[object, ...] = ()
        self._pair: tuple[object, object] | None = None
        """Kept, so that no other outline gets the identity by which the ground is known."""
        self._behind_key: tuple[object, ...] = ()
        self.paints = 0
        self.setAccessibleName("Displacement of the grasped face")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(240, 140)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a square."""
        return QSize(460, 460)

    def show_scene(self, scene: OffsetScene | None) -> None:
        """Show another displacement or another episode."""
        self.scene = scene
        if scene is None:
            self._held_mm = self._grasped = None
            self.setAccessibleDescription("No episode")
        else:
            self._reach_mm = scene.reach_mm
            words = offset_in_words(scene.offset_mm, scene.sigma_mm)
            self.setAccessibleDescription(f"{words}. {verdict_in_words(scene)}.")
        self.update()

    def area(self) -> PlotArea:
        """Return the square that is drawn; needs a scene."""
        em = self.fontMetrics().height()
        left, bottom, edge = 2.4 * em, 1.5 * em, 0.4 * em
        side = max(min(self.width() - left - edge, self.height() - bottom - edge), 60.0)
        x = left + (self.width() - left - edge - side) / 2
        y = edge + (self.height() - bottom - edge - side) / 2
        reach = self._reach_mm
        return PlotArea(QRectF(x, y, side, side), -reach, reach, -reach, reach)

    # -- dragging ---------------------------------------------------------------------------------

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Take hold of the face, or call it to the place that was pressed."""
        scene = self.scene
        if scene is None or not self.editable or event.button() is not Qt.MouseButton.LeftButton:
            return
        self._grasped = self.area()
        at = self._at_mm(event.position())
        offset = scene.offset_mm or at
        self._held_mm = (at[0] - offset[0], at[1] - offset[1])
        if scene.offset_mm is None:
            self._moved(at)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Report where the face was dragged to."""
        if self._held_mm is not None and event.buttons() & Qt.MouseButton.LeftButton:
            at = self._at_mm(event.position())
            self._moved((at[0] - self._held_mm[0], at[1] - self._held_mm[1]))

    def mouseReleaseEvent(self, _event: QMouseEvent) -> None:
        """One drag is one step."""
        if self._held_mm is not None:
            self._held_mm = self._grasped = None
            self._dropped()

    def _at_mm(self, at: QPointF) -> Point:
        area = self._grasped or self.area()
        x = area.x0 + (at.x() - area.rect.left()) / area.rect.width() * (area.x1 - area.x0)
        y = area.y1 - (at.y() - area.rect.top()) / area.rect.height() * (area.y1 - area.y0)
        return x, y

    # -- drawing ----------------------------------------------------------------------------------

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Copy the ground, then draw the face, its points, the hull and the centre of mass."""
        self.paints += 1
        painter = QPainter(self)
        if self.scene is None:
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            draw_message(painter, self.rect(), self._theme, "No episode")
            return
        area = self.area()
        painter.drawPixmap(0, 0, self._background(self.scene, area))
        painter.setClipRect(area.rect)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        marks.draw_face(painter, area, self.scene, self._theme)
        marks.draw_names(painter, area, self.scene, self._theme)

    def _background(self, scene: OffsetScene, area: PlotArea) -> QPixmap:
        """Return the ground with the ghosts: drawn once per episode."""
        side = marks.legend_left(scene)
        key = (self._fitting_ground(scene, area), scene.yaw_rad, scene.ghosts, side)
        if self._behind is None or key != self._behind_key:
            assert self._ground is not None
            self._behind, self._behind_key = QPixmap(self._ground), key
            painter = QPainter(self._behind)
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setClipRect(area.rect)
            try:
                marks.draw_ghosts(painter, area, scene, self._theme)
            finally:
                painter.end()
        return self._behind

    def _fitting_ground(self, scene: OffsetScene, area: PlotArea) -> tuple[object, ...]:
        """Have grid and bottom drawn, once per pair of faces; return what they depend on."""
        key = (self.size().toTuple(), self._theme.tokens.name, self._theme.scale,
               id(scene.bottom), id(scene.face), self._reach_mm)  # fmt: skip
        if self._ground is None or key != self._ground_key:
            ratio = self.devicePixelRatioF()
            self._ground, self._ground_key = QPixmap(self.size() * ratio), key
            self._pair = scene.bottom, scene.face
            self._ground.setDevicePixelRatio(ratio)
            self._ground.fill(self._theme.tokens.colour("panel"))
            painter = QPainter(self._ground)
            painter.setRenderHint(QPainter.RenderHint.Antialiasing)
            painter.setFont(ui_font(self._theme.scale, 0.85))
            try:
                draw_mm_grid(painter, area, self._theme)
                painter.setClipRect(area.rect)
                marks.draw_bottom(painter, area, scene, self._theme)
                marks.draw_scale_bar(painter, area, self._theme)
            finally:
                painter.end()
        return key

"""Offset of the piece over the bottom."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QMarginsF, QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QMouseEvent, QPainter, QPaintEvent, QPen, QPixmap, QResizeEvent
from PySide6.QtWidgets import QCheckBox

from touchdown.backend.core import FloatArray, SupportKind
from touchdown.widgets import plots
from touchdown.widgets.base import Theme, blend, signed, tr, ui_font
from touchdown.widgets.views.belief import draw_plus

GhostKind = Literal["commanded", "measured", "scene", "model"]
Point = tuple[float, float]
# margin; step in which the square grows, so that it does not follow each nudge
EDGE_MM, REACH_STEP_MM = 2.0, 6.0


@dataclass(frozen=True, slots=True)
class Ghost:
    """Face position by another source; ``sigma_mm``: its standard uncertainty, 0 if unknown."""

    kind: GhostKind
    offset_mm: Point
    sigma_mm: float


@dataclass(frozen=True, slots=True)
class OffsetScene:
    """Grasped face over the bottom face in the frame ``O``, mm.

    ``bottom`` and ``face``: (k, 2) outlines about their own centres. ``offset_mm`` is None while
    there is no label; ``points_mm`` (N, 2), ``touching`` (N,), ``hull_mm`` (k, 2), ``centre_mm``,
    ``margin_mm`` and ``support`` follow from it. ``sigma_mm``: of the label. ``names``: of bottom
    and face, drawn into them; None in detailed views.
    """

    bottom: FloatArray
    face: FloatArray
    offset_mm: Point | None = None
    yaw_rad: float = 0.0
    points_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    touching: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    hull_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    centre_mm: Point = (math.nan, math.nan)
    margin_mm: float = math.nan
    support: SupportKind = SupportKind.NO_ESTIMATE
    too_close: bool = False
    sigma_mm: float = 0.0
    ghosts: tuple[Ghost, ...] = ()
    names: tuple[str, str] | None = None

    @property
    def reach_mm(self) -> float:
        """Half width of the square that holds everything drawn.

        Equal for all labels with the centre over the bottom, so that episodes can be compared.
        """
        face = float(np.nanmax(np.hypot(*self.face.T) if self.yaw_rad else np.abs(self.face)))
        usual = float(np.nanmax(np.abs(self.bottom))) + face + EDGE_MM
        placed = [(ghost.offset_mm, ghost.sigma_mm) for ghost in self.ghosts]
        if self.offset_mm is not None:
            placed.append((self.offset_mm, self.sigma_mm))
        far = max((max(map(abs, at)) + max(face, sigma) for at, sigma in placed), default=0.0)
        more = max(far + EDGE_MM - usual, 0.0)
        return usual + REACH_STEP_MM * math.ceil(more / REACH_STEP_MM)


def verdict_text(scene: OffsetScene) -> str:
    """Return the predicted stability with its margin."""
    if scene.offset_mm is None:
        return tr("No displacement yet")
    if scene.support is not SupportKind.AREA:
        return tr("No contact: it would fall") if not scene.touching.any() else (
            tr("Would fall: {}", tr(scene.support.value))
        )  # fmt: skip
    inside = scene.margin_mm >= 0
    distance = tr(
        "centre of mass {:.1f} mm inside the hull" if inside
        else "centre of mass {:.1f} mm outside the hull", abs(scene.margin_mm),
    )  # fmt: skip
    if scene.too_close:
        return tr("Too close to call: {}", distance)
    return tr("Would stand: {}" if inside else "Would fall: {}", distance)


def offset_text(offset_mm: Point | None, sigma_mm: float = 0.0) -> str:
    """Format a displacement as "x +1.50, y +0.25 mm" with its uncertainty."""
    if offset_mm is None:
        return tr("no displacement")
    x, y = (signed(v) for v in offset_mm)
    spread = f" \N{PLUS-MINUS SIGN} {sigma_mm:.2f}" if sigma_mm else ""
    return f"x {x}, y {y} mm{spread}"


# Line style and colour of a source.
GHOST_STYLES: dict[GhostKind, tuple[Qt.PenStyle, str]] = {
    "commanded": (Qt.PenStyle.DashLine, "muted"),
    "measured": (Qt.PenStyle.DotLine, "axis_y"),
    "scene": (Qt.PenStyle.DashDotDotLine, "scene"),
    "model": (Qt.PenStyle.DashDotLine, "axis_z"),
}
SCALE_BARS = 7  # of them fill the width
SAMPLE_PX = 6  # height of the line of a source in the legend
THICKEN_PX = 0.3


def draw_scale_bar(painter: QPainter, area: plots.PlotArea, theme: Theme) -> None:
    """Draw a bar of a round length at the lower left."""
    length_mm = plots.nice_step(area.x1 - area.x0, SCALE_BARS)
    length = length_mm * area.rect.width() / (area.x1 - area.x0)
    left, y = area.rect.left() + 10, area.rect.bottom() - 10
    painter.setPen(QPen(theme.tokens.colour("text"), 2))
    painter.drawLine(QPointF(left, y), QPointF(left + length, y))
    for x in (left, left + length):
        painter.drawLine(QPointF(x, y - 4), QPointF(x, y + 4))
    painter.drawText(QPointF(left, y - 8), f"{length_mm:g} mm")


def draw_bottom(painter: QPainter, area: plots.PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw the bottom face, filled, with its centre."""
    t = theme.tokens
    painter.setPen(QPen(t.colour("border"), 2))
    painter.setBrush(blend(t.colour("bg"), t.colour("border"), 0.22))
    plots.draw_rings(painter, area.points(*scene.bottom.T))
    painter.setBrush(Qt.BrushStyle.NoBrush)
    painter.setPen(QPen(t.colour("muted"), 1))
    centre = area.place(0.0, 0.0)
    for arm in (QPointF(4, 0), QPointF(0, 4)):
        painter.drawLine(centre - arm, centre + arm)


def draw_ghosts(painter: QPainter, area: plots.PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw the face positions of other sources: outline and uncertainty."""
    painter.setBrush(Qt.BrushStyle.NoBrush)
    for ghost in scene.ghosts:
        painter.setPen(ghost_pen(ghost.kind, theme))
        outline = _placed(area, scene.face, ghost.offset_mm, scene.yaw_rad)
        # Two thin lines: Qt takes ten times as long for a dashed line wider than 1 px.
        plots.draw_rings(painter, outline)
        plots.draw_rings(painter, outline + THICKEN_PX)
        _sigma_circle(painter, area, ghost.offset_mm, ghost.sigma_mm)


def ghost_pen(kind: GhostKind, theme: Theme) -> QPen:
    """Return the pen of a source."""
    style, token = GHOST_STYLES[kind]
    return QPen(theme.tokens.colour(token), 1, style)


class SourceBox(QCheckBox):
    """Legend of one source, name and line; shows or hides its outline."""

    def __init__(self, theme: Theme, kind: GhostKind, view: OffsetView) -> None:
        super().__init__(tr(kind), view)
        self._theme, self._kind = theme, kind
        self.setAccessibleName(tr("Show the {} position", tr(kind)))
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setChecked(True)
        self.toggled.connect(view.update)

    def sizeHint(self) -> QSize:
        """Return the usual size and the height of the line."""
        return super().sizeHint() + QSize(0, SAMPLE_PX)

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw the line below the name."""
        super().paintEvent(event)
        painter = QPainter(self)
        painter.setPen(ghost_pen(self._kind, self._theme))
        for y in (self.height() - 3, self.height() - 2):
            painter.drawLine(0, y, self.width(), y)


def draw_face(painter: QPainter, area: plots.PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Draw the face at its label, with contact points, hull and centre of mass."""
    if scene.offset_mm is None:
        return
    t = theme.tokens
    _points(painter, area, scene.points_mm[~scene.touching], t.colour("muted"), 2.0)
    _points(painter, area, scene.points_mm[scene.touching], t.colour("axis_x"), 4.5)
    painter.setBrush(Qt.BrushStyle.NoBrush)
    if len(scene.hull_mm):
        painter.setPen(QPen(t.colour("good" if scene.margin_mm >= 0 else "bad"), 2))
        painter.drawPolygon(area.polygon(*scene.hull_mm.T))
    painter.setPen(QPen(t.colour("text"), 2))
    plots.draw_rings(painter, _placed(area, scene.face, scene.offset_mm, scene.yaw_rad))
    painter.setPen(QPen(t.colour("text"), 1))
    _sigma_circle(painter, area, scene.offset_mm, scene.sigma_mm)
    draw_plus(painter, area.place(*scene.centre_mm), 8)


def draw_names(painter: QPainter, area: plots.PlotArea, scene: OffsetScene, theme: Theme) -> None:
    """Label bottom and face away from each other and draw the line between the centres."""
    if scene.names is None or scene.offset_mm is None:
        return
    away = np.array(scene.offset_mm)
    length = float(np.hypot(*away))
    way = away / length if length > 0 else np.array([1.0, 0.0])
    centre, face = area.place(0.0, 0.0), area.place(*scene.offset_mm)
    painter.setPen(QPen(theme.tokens.colour("text"), 1, Qt.PenStyle.DotLine))
    painter.drawLine(centre, face)
    draw_plus(painter, face, 6)
    painter.setPen(theme.tokens.colour("text"))
    painter.setFont(ui_font(theme.scale, 1.0, 600))
    reach = [
        0.55 * float(np.nanmax(np.hypot(*outline.T))) for outline in (scene.bottom, scene.face)
    ]
    places = (-reach[0] * way, away + reach[1] * way)
    for (x, y), name in zip(places, scene.names, strict=True):
        box = QRectF(area.x(float(x)) - 80, area.y(float(y)) - 12, 160, 24)
        painter.drawText(box, int(Qt.AlignmentFlag.AlignCenter), name)


def _points(
    painter: QPainter, area: plots.PlotArea, points: FloatArray, colour: QColor, size: float
) -> None:
    """Draw points as squares; round ones take seven times as long."""
    pen = QPen(colour, size)
    pen.setCapStyle(Qt.PenCapStyle.SquareCap)
    painter.setPen(pen)
    painter.drawPoints(area.polygon(*points.T))


def _sigma_circle(painter: QPainter, area: plots.PlotArea, at_mm: Point, sigma_mm: float) -> None:
    if sigma_mm > 0:
        radius = sigma_mm * area.rect.width() / (area.x1 - area.x0)
        painter.drawEllipse(area.place(*at_mm), radius, radius)


def _placed(area: plots.PlotArea, outline: FloatArray, at_mm: Point, yaw_rad: float) -> FloatArray:
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    x = outline[:, 0] * c - outline[:, 1] * s + at_mm[0]
    y = outline[:, 0] * s + outline[:, 1] * c + at_mm[1]
    return area.points(x, y)


Moved = Callable[[Point], None]


class OffsetView(plots.PictureView):
    """View of an ``OffsetScene`` with a draggable face; the background is cached."""

    def __init__(self, theme: Theme, moved: Moved, dropped: Callable[[], None]) -> None:
        super().__init__(theme, "Displacement of the grasped face", (240, 140), (460, 460))
        self._moved, self._dropped = moved, dropped
        self.scene: OffsetScene | None = None
        self.editable = True
        self._held_mm: Point | None = None
        self._grasped: plots.PlotArea | None = None  # at the start of a drag; the scale can change
        self._reach_mm, self._label_at = 1.0, QRectF()  # place of the label in the legend
        self._ground = plots.PictureCache(self, theme)
        self._behind: QPixmap | None = None
        # Keeps the outlines alive, whose ids are part of the key.
        self._pair: tuple[object, object] | None = None
        self._behind_key: tuple[object, ...] = ()
        self.legend = {kind: SourceBox(theme, kind, self) for kind in GHOST_STYLES}

    def show_scene(self, scene: OffsetScene | None) -> None:
        """Show another displacement or episode."""
        self.scene = scene
        if scene is None:
            self._held_mm = self._grasped = None
            self.setAccessibleDescription(tr("No episode"))
        else:
            self._reach_mm = scene.reach_mm
            words = offset_text(scene.offset_mm, scene.sigma_mm)
            self.setAccessibleDescription(f"{words}. {verdict_text(scene)}.")
        self._place_legend()
        self.update()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Keep the legend beside the square."""
        self._place_legend()

    def _place_legend(self) -> None:
        """List the sources right of the square, where they cover no outline."""
        kinds = {ghost.kind for ghost in self.scene.ghosts} if self.scene else set()
        em, width = self.fontMetrics().height(), self._legend_px()
        x, y = self.area().rect.right() + 0.4 * em, self.area().rect.top()
        for kind, box in self.legend.items():
            box.setVisible(kind in kinds)
            box.setGeometry(round(x), round(y), width, box.sizeHint().height())
            y += box.height() * (kind in kinds)
        self._label_at = QRectF(x, y, width, em)

    def _legend_px(self) -> int:
        """Return the width of the legend, 0 in pictures that name bottom and face."""
        named = self.scene is None or self.scene.names is not None
        return 0 if named else max(box.sizeHint().width() for box in self.legend.values())

    def area(self) -> plots.PlotArea:
        """Return the drawn square with its visible part."""
        em = self.fontMetrics().height()
        margins = QMarginsF(2.4 * em, 0.4 * em, 0.4 * em + self._legend_px(), 1.5 * em)
        reach = self._reach_mm
        square = plots.centred_square(self.size(), margins, 60.0)
        return self.zoom.of(plots.PlotArea(square, -reach, reach, -reach, reach))

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Start to drag the face; without a label, put it at the pressed place."""
        super().mousePressEvent(event)
        scene, left = self.scene, event.button() is Qt.MouseButton.LeftButton
        if self._grip is not None or scene is None or not self.editable or not left:
            return
        self._grasped = self.area()
        at = self._grasped.at(event.position())
        offset = scene.offset_mm or at
        self._held_mm = (at[0] - offset[0], at[1] - offset[1])
        if scene.offset_mm is None:
            self._moved(at)

    def mouseMoveEvent(self, event: QMouseEvent) -> None:
        """Report the dragged position."""
        super().mouseMoveEvent(event)
        held_mm, grasped = self._held_mm, self._grasped
        if held_mm and grasped and event.buttons() & Qt.MouseButton.LeftButton:
            at = grasped.at(event.position())
            self._moved((at[0] - held_mm[0], at[1] - held_mm[1]))

    def mouseReleaseEvent(self, event: QMouseEvent) -> None:
        """End the drag, which is one undo step."""
        super().mouseReleaseEvent(event)
        if self._held_mm is not None:
            self._held_mm = self._grasped = None
            self._dropped()

    def paint(self, painter: QPainter) -> None:
        """Draw the cached background, then face, points, hull and centre of mass."""
        if self.scene is None:
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            plots.draw_message(painter, self.rect(), self._theme, "No episode")
            return
        area = self.area()
        painter.drawPixmap(0, 0, self._background(self.scene, area))
        painter.setClipRect(area.rect)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        draw_face(painter, area, self.scene, self._theme)
        draw_names(painter, area, self.scene, self._theme)
        if self.scene.ghosts and self.scene.offset_mm is not None:
            painter.setClipping(False)
            painter.setPen(QPen(self._theme.tokens.colour("text"), 2))
            box, below = self._label_at, QPointF(0, SAMPLE_PX - 2)
            painter.drawText(box.adjusted(1.3 * box.height(), 0, 0, 0), 0, tr("label"))
            painter.drawLine(box.bottomLeft() + below, box.bottomRight() + below)

    def _background(self, scene: OffsetScene, area: plots.PlotArea) -> QPixmap:
        """Return the background with the ghosts; rendered once per episode."""
        ground = self._ground.picture(
            lambda painter: self._draw_ground(painter, scene, area),
            id(scene.bottom), id(scene.face), self._reach_mm, self.zoom,
        )  # fmt: skip
        self._pair = scene.bottom, scene.face
        shown = tuple(ghost for ghost in scene.ghosts if self.legend[ghost.kind].isChecked())
        key = (ground.cacheKey(), scene.yaw_rad, shown)
        if self._behind is None or key != self._behind_key:
            self._behind, self._behind_key = QPixmap(ground), key
            with QPainter(self._behind) as painter:
                painter.setRenderHint(QPainter.RenderHint.Antialiasing)
                painter.setClipRect(area.rect)
                draw_ghosts(painter, area, replace(scene, ghosts=shown), self._theme)
        return self._behind

    def _draw_ground(self, painter: QPainter, scene: OffsetScene, area: plots.PlotArea) -> None:
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(ui_font(self._theme.scale, 0.85))
        plots.draw_mm_grid(painter, area, self._theme)
        painter.setClipRect(area.rect)
        draw_bottom(painter, area, scene, self._theme)
        draw_scale_bar(painter, area, self._theme)

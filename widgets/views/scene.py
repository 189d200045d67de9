"""Bench from the side and from above."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product

import cv2
import numpy as np
from PySide6.QtCore import QRectF
from PySide6.QtGui import QFontMetrics, QPainter, QPen

from touchdown.backend.core import FloatArray, rotation_from_quaternion
from touchdown.widgets.base import Theme, blend, tr, ui_font
from touchdown.widgets.plots import PictureView, PlotArea, draw_message, draw_rings, polygon_of
from touchdown.widgets.views.belief import draw_arrow
from touchdown.widgets.views.offset import draw_scale_bar

Quaternion = tuple[float, float, float, float]
Axes = tuple[int, int]  # shown to the right and up
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
USUAL_SPAN_MM = (-55.0, 55.0)
FINGER_MM, FINGER_WIDTH_MM = 5.0, 25.0  # thickness along y and width along x
PAD_MM, PALM_MM = (-7.0, 22.0), (22.0, 32.0)  # heights over the grasp pivot
HAND_STEP_MM, TOP_MM = 20.0, 120.0  # the height of the view follows the hand in steps, to a limit
SIDE, ABOVE = (0, 2), (0, 1)
GAP_PX, TEXT_PX = 6, 110  # between the halves; least height with texts
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True)
class SideBody:
    """Body on the bench. ``x_mm``, ``y_mm``, ``z_mm``: centre of its lower face.

    ``face_mm``: half width of the lower face, ``top_mm``: half width above it. ``turn``: rotation
    about that centre, as a quaternion w x y z.
    ``profile_mm``: points (x, height above the nominal one) of an upper face that is not flat, from
    left to right. ``face``: (k, 2) outline of the face, rings separated by rows of NaN.
    """

    name: str
    face_mm: float
    top_mm: float
    height_mm: float
    x_mm: float
    z_mm: float
    turn: Quaternion = UPRIGHT
    profile_mm: tuple[tuple[float, float], ...] = ()
    y_mm: float = 0.0
    face: FloatArray | None = field(default=None, compare=False)

    def outlines_mm(self) -> tuple[FloatArray, ...]:
        """Return the outlines of upper part and foot (k, 2), seen along y."""
        if self.profile_mm:
            top = [(x, 0.0, self.height_mm + rise) for x, rise in reversed(self.profile_mm)]
            ring = np.array([(-self.face_mm, 0.0, 0.0), (self.face_mm, 0.0, 0.0), *top])
            return (ring @ rotation_from_quaternion(self.turn)[[0, 2]].T + (self.x_mm, self.z_mm),)
        if self.top_mm == self.face_mm:
            return (self._seen(self.face_mm, 0.0, self.height_mm),)
        foot = min(0.2 * self.height_mm, 6.0)
        return (self._seen(self.top_mm, foot, self.height_mm), self._seen(self.face_mm, 0.0, foot))

    def plan_mm(self) -> tuple[FloatArray, ...]:
        """Return the outlines of upper part and lower face (k, 2), seen from above."""
        place = np.array([self.x_mm, self.y_mm])
        upper = _hull(self.top_mm, 0.0, self.height_mm, self.turn, ABOVE) + place
        if self.face is None:
            return (upper,)
        face = self.face @ rotation_from_quaternion(self.turn)[:2, :2].T + place
        return (face,) if self.top_mm == self.face_mm else (upper, face)

    def _seen(self, radius_mm: float, low_mm: float, high_mm: float) -> FloatArray:
        place = np.array([self.x_mm, self.z_mm])
        return place + _hull(radius_mm, low_mm, high_mm, self.turn, SIDE)


@lru_cache(maxsize=64)
def _hull(radius: float, low: float, high: float, turn: Quaternion, axes: Axes) -> FloatArray:
    """Return the outline of a rotated cylinder about the origin; cached, as most motion is
    translation.
    """
    ring = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1) * radius
    points = np.concatenate([np.column_stack([ring, np.full(len(ring), z)]) for z in (low, high)])
    return _outer(points @ rotation_from_quaternion(turn)[list(axes)].T)


def _outer(points: FloatArray) -> FloatArray:
    """Return the convex hull (k, 2) of points (n, 2)."""
    hull = cv2.convexHull(points.astype(np.float32))
    return np.asarray(hull.reshape(-1, 2), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class SideScene:
    """Bottoms from the table up, piece, hand, and the shown span in x.

    ``hand_mm``: grasp pivot. ``jaws_mm``: half opening along y. ``hand_turn``: rotation about the
    pivot. ``table_mm``: height of the table. ``next_mm``: where the face goes next.
    """

    bottoms: tuple[SideBody, ...] = ()
    piece: SideBody | None = None
    hand_mm: tuple[float, ...] | None = None
    jaws_mm: float = 0.0
    table_mm: float = 0.0
    caption: str = ""
    span_mm: tuple[float, float] = USUAL_SPAN_MM
    hand_turn: Quaternion = UPRIGHT
    next_mm: tuple[float, float] | None = None

    @property
    def top_mm(self) -> float:
        """Height of the view above the last bottom."""
        piece = 30.0 if self.piece is None else self.piece.height_mm + 18.0
        hand = 0.0 if self.hand_mm is None else self.hand_mm[2] + PALM_MM[1]
        return max(piece, min(HAND_STEP_MM * math.ceil(hand / HAND_STEP_MM), TOP_MM))

    def hand_parts_mm(self, axes: Axes) -> tuple[FloatArray, ...]:
        """Return the outlines (k, 2) of palm and fingers; none without a hand."""
        if self.hand_mm is None:
            return ()
        inner, outer, wide = self.jaws_mm, self.jaws_mm + FINGER_MM, FINGER_WIDTH_MM / 2
        turn = rotation_from_quaternion(self.hand_turn)
        spans = ((-outer, outer), PALM_MM), ((-outer, -inner), PAD_MM), ((inner, outer), PAD_MM)
        corners = (np.array([*product((-wide, wide), y, z)]) for y, z in spans)
        return tuple(_outer((box @ turn.T + self.hand_mm)[:, axes]) for box in corners)


class SideView(PictureView):
    """View of a ``SideScene``, from the side and from above; an equal scene is not drawn again."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Bench from the side and from above", (120, 59), (280, 180))
        self.scene = SideScene()

    def show_scene(self, scene: SideScene) -> None:
        """Show another scene."""
        if scene != self.scene:
            self.scene = scene
            self.setAccessibleDescription(scene.caption)
            self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw both halves: table, bottoms, piece, hand, next step."""
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t, scene = self._theme.tokens, self.scene
        painter.fillRect(self.rect().adjusted(0, 0, 1, 1), t.colour("bg"))
        if not scene.bottoms:
            draw_message(painter, self.rect(), self._theme, "No bench yet")
            return
        painter.setFont(ui_font(self._theme.scale, 0.85))
        side, above = self.halves()
        floor = QRectF(side.rect)
        floor.setTop(side.y(scene.table_mm))
        painter.fillRect(floor, t.colour("hairline"))
        for area, axes, text in ((side, SIDE, scene.caption), (above, ABOVE, tr("from above"))):
            painter.setClipRect(area.rect)
            self._draw_scene(painter, area, axes)
            if top := self._caption_px():
                painter.setClipping(False)
                painter.setPen(t.colour("muted"))
                line = QRectF(area.rect.x() + 8, 4, area.rect.width() - 8, top - 4)
                painter.drawText(line, 0, text)
                draw_scale_bar(painter, area, self._theme)

    def halves(self) -> tuple[PlotArea, PlotArea]:
        """Return the areas from the side (x, z) and from above (x, y), to one scale."""
        (low, high), floor = self.scene.span_mm, self.scene.table_mm - 3.0
        top = self._caption_px()
        width, height = (self.width() - GAP_PX) / 2, float(self.height() - top)
        scale = min(width / (high - low), height / (self.scene.top_mm - floor))
        across, up = width / scale, height / scale
        x = (low + high - across) / 2, (low + high + across) / 2
        beside = QRectF(width + GAP_PX, top, width, height)
        return (PlotArea(QRectF(0, top, width, height), *x, floor, floor + up),
                PlotArea(beside, *x, -up / 2, up / 2))  # fmt: skip

    def _caption_px(self) -> int:
        """Return the height of the line above the picture; 0 in a low view, which has no texts."""
        metrics = QFontMetrics(ui_font(self._theme.scale, 0.85))
        return metrics.height() + 4 if self.height() > TEXT_PX else 0

    def _draw_scene(self, painter: QPainter, area: PlotArea, axes: Axes) -> None:
        t, scene = self._theme.tokens, self.scene
        fills = [t.colour("border"), blend(t.colour("bg"), t.colour("axis_x"), 0.7)]
        fills[1].setAlpha(255 if axes == SIDE else 150)
        painter.setPen(QPen(t.colour("text"), 1))
        for body in (*scene.bottoms, scene.piece):
            painter.setBrush(fills[body is scene.piece])
            if body is not None:
                for outline in body.outlines_mm() if axes == SIDE else body.plan_mm():
                    draw_rings(painter, area.points(*outline.T))
        # The fingers are beside the piece along y: from the side the near one covers it.
        fill = t.colour("raised")
        fill.setAlpha(120)
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(fill)
        for part in scene.hand_parts_mm(axes):
            painter.drawPolygon(polygon_of(area.points(*part.T)))
        if scene.next_mm is not None and scene.piece is not None:
            piece, (x, y) = scene.piece, scene.next_mm
            middle = piece.z_mm + 0.5 * piece.height_mm
            start, end = (middle, middle) if axes == SIDE else (piece.y_mm, y)
            draw_arrow(painter, area.place(piece.x_mm, start), area.place(x, end))

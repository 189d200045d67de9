"""Bench from the side."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPen, QPolygonF

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import DrawnView, Theme, blend, ui_font
from touchdown.widgets.plots import draw_message

Quaternion = tuple[float, float, float, float]
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
USUAL_SPAN_MM = (-55.0, 55.0)
FINGER_MM = 5.0
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)


@dataclass(frozen=True, slots=True)
class SideBody:
    """Body seen along y. ``x_mm``, ``z_mm``: centre of its lower face.

    ``face_mm``: half width of the lower face, ``top_mm``: half width above it. ``turn``: rotation
    about that centre, as a quaternion w x y z.
    ``profile_mm``: points (x, height above the nominal one) of an upper face that is not flat, from
    left to right.
    """

    name: str
    face_mm: float
    top_mm: float
    height_mm: float
    x_mm: float
    z_mm: float
    turn: Quaternion = UPRIGHT
    profile_mm: tuple[tuple[float, float], ...] = ()

    def outlines_mm(self) -> tuple[FloatArray, ...]:
        """Return the outlines of upper part and foot (k, 2)."""
        if self.profile_mm:
            top = [(x, 0.0, self.height_mm + rise) for x, rise in reversed(self.profile_mm)]
            ring = np.array([(-self.face_mm, 0.0, 0.0), (self.face_mm, 0.0, 0.0), *top])
            return (ring @ rotation(self.turn)[[0, 2]].T + (self.x_mm, self.z_mm),)
        if self.top_mm == self.face_mm:
            return (self._seen(self.face_mm, 0.0, self.height_mm),)
        foot = min(0.2 * self.height_mm, 6.0)
        return (self._seen(self.top_mm, foot, self.height_mm), self._seen(self.face_mm, 0.0, foot))

    def _seen(self, radius_mm: float, low_mm: float, high_mm: float) -> FloatArray:
        place = np.array([self.x_mm, self.z_mm])
        return place + _hull(radius_mm, low_mm, high_mm, self.turn)


@lru_cache(maxsize=64)
def _hull(radius_mm: float, low_mm: float, high_mm: float, turn: Quaternion) -> FloatArray:
    """Return the outline of a rotated cylinder about the origin; cached, as most motion is
    translation.
    """
    ring = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1) * radius_mm
    points = np.concatenate(
        [np.column_stack([ring, np.full(len(ring), z)]) for z in (low_mm, high_mm)]
    )
    hull = cv2.convexHull((points @ rotation(turn)[[0, 2]].T).astype(np.float32))
    return np.asarray(hull.reshape(-1, 2), dtype=np.float64)


def rotation(turn: Quaternion) -> FloatArray:
    """Return the (3, 3) rotation matrix of a unit quaternion w x y z."""
    w, x, y, z = turn
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


@dataclass(frozen=True, slots=True)
class SideScene:
    """Bottoms from the table up, piece, hand, and the shown span in x.

    ``hand_mm``: grasp pivot (x, z). ``jaws_mm``: half opening. ``hand_turn``: rotation about the
    pivot. ``table_mm``: height of the table.
    """

    bottoms: tuple[SideBody, ...] = ()
    piece: SideBody | None = None
    hand_mm: tuple[float, float] | None = None
    jaws_mm: float = 0.0
    table_mm: float = 0.0
    caption: str = ""
    span_mm: tuple[float, float] = USUAL_SPAN_MM
    hand_turn: Quaternion = UPRIGHT

    def fingers_mm(self) -> tuple[FloatArray, ...]:
        """Return the (4, 2) outlines of both fingers; none without a hand."""
        if self.hand_mm is None:
            return ()
        seen = rotation(self.hand_turn)[[0, 2]]
        boxes = []
        for side in (-1.0, 1.0):
            inner, outer = side * self.jaws_mm, side * (self.jaws_mm + FINGER_MM)
            corners = [(inner, -7.0), (outer, -7.0), (outer, 22.0), (inner, 22.0)]
            box = np.array([(x, 0.0, z) for x, z in corners])
            boxes.append(box @ seen.T + self.hand_mm)
        return tuple(boxes)


class SideView(DrawnView):
    """View of a ``SideScene``; an equal scene is not drawn again."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "Side view of the bench", (120, 90), (280, 180))
        self.scene = SideScene()
        self.paints = 0

    def show_scene(self, scene: SideScene) -> None:
        """Show another scene."""
        if scene != self.scene:
            self.scene = scene
            self.setAccessibleDescription(scene.caption)
            self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw table, bottoms, piece and jaws."""
        self.paints += 1
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        t = self._theme.tokens
        painter.fillRect(self.rect(), t.colour("bg"))
        if not self.scene.bottoms:
            draw_message(painter, self.rect(), self._theme, "Nothing stacked yet",
                         "Piece and bottom appear with the first run.")  # fmt: skip
            return
        place = self._placing()
        table = place(0.0, self.scene.table_mm).y()
        floor = QRectF(0, table, self.width(), self.height() - table)
        painter.fillRect(floor, t.colour("hairline"))
        grey, blue = t.colour("border"), blend(t.colour("bg"), t.colour("axis_x"), 0.7)
        for body in self.scene.bottoms:
            _draw_body(painter, place, body, grey, t.colour("text"))
        if self.scene.piece is not None:
            _draw_body(painter, place, self.scene.piece, blue, t.colour("text"))
        self._draw_jaws(painter, place)
        painter.setPen(t.colour("muted"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        box = QRectF(self.rect()).adjusted(8, 4, -8, -4)
        painter.drawText(box, int(Qt.AlignmentFlag.AlignTop | Qt.AlignmentFlag.AlignLeft),
                         self.scene.caption)  # fmt: skip

    def _placing(self) -> _ViewTransform:
        scene = self.scene
        top = scene.piece.height_mm + 14 if scene.piece is not None else 30.0
        low, high = scene.span_mm
        scale = min((self.height() - 8) / (top + 4 - scene.table_mm), self.width() / (high - low))
        x_px = self.width() / 2 - 0.5 * (low + high) * scale
        return _ViewTransform(x_px, self.height() - 6 - (3 - scene.table_mm) * scale, scale)

    def _draw_jaws(self, painter: QPainter, place: _ViewTransform) -> None:
        t = self._theme.tokens
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour("raised"))
        for finger in self.scene.fingers_mm():
            painter.drawPolygon(QPolygonF([place(x, z) for x, z in finger.tolist()]))


@dataclass(frozen=True, slots=True)
class _ViewTransform:
    """Maps bench mm (x right, z up) to pixels."""

    x_px: float
    z_px: float
    scale: float

    def __call__(self, x_mm: float, z_mm: float) -> QPointF:
        return QPointF(self.x_px + x_mm * self.scale, self.z_px - z_mm * self.scale)


def _draw_body(
    painter: QPainter, place: _ViewTransform, body: SideBody, fill: QColor, ink: QColor
) -> None:
    painter.setPen(QPen(ink, 1))
    painter.setBrush(fill)
    for outline in body.outlines_mm():
        painter.drawPolygon(QPolygonF([place(x, z) for x, z in outline.tolist()]))

"""The bench from the side, to scale: fingers, piece, bottom; and the fall, if there is one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPen, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from widgets.overlay import draw_message
from widgets.theme import Theme, blend, ui_font


@dataclass(frozen=True, slots=True)
class SideBody:
    """A body seen along y. ``x_mm, z_mm``: centre of its bottom face; ``tilt_rad`` about it.

    ``face_mm``: half width of the bottom face, ``top_mm``: half width above it.
    """

    name: str
    face_mm: float
    top_mm: float
    height_mm: float
    x_mm: float
    z_mm: float
    tilt_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class SideScene:
    """Bottoms from the table up, the piece, the grip height, and the jaws' half opening."""

    bottoms: tuple[SideBody, ...] = ()
    piece: SideBody | None = None
    grip_mm: float = 0.0
    jaws_mm: float | None = None
    caption: str = ""


class SideView(QWidget):
    """Draws a ``SideScene``; the same scene again costs nothing."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self.scene = SideScene()
        self.paints = 0
        self.setAccessibleName("Side view of the bench")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Expanding)
        self.setMinimumSize(120, 90)
        self.setAttribute(Qt.WidgetAttribute.WA_OpaquePaintEvent)

    def sizeHint(self) -> QSize:
        """Return a landscape format."""
        return QSize(280, 180)

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
            draw_message(painter, self.rect(), self._theme, "Nothing on the table")
            return
        place = self._placing()
        table = place(0.0, -sum(b.height_mm for b in self.scene.bottoms)).y()
        painter.fillRect(
            QRectF(0, table, self.width(), self.height() - table), t.colour("hairline")
        )
        grey, blue = t.colour("border"), t.colour("axis_x")
        for body in self.scene.bottoms:
            _draw_body(painter, place, body, grey, t.colour("text"))
        if self.scene.piece is not None:
            fill = blend(t.colour("bg"), blue, 0.7)
            _draw_body(painter, place, self.scene.piece, fill, t.colour("text"))
            self._draw_jaws(painter, place)
        painter.setPen(t.colour("muted"))
        painter.setFont(ui_font(self._theme.scale, 0.85))
        box = QRectF(self.rect()).adjusted(8, 4, -8, -4)
        painter.drawText(box, int(Qt.AlignmentFlag.AlignTop | Qt.AlignmentFlag.AlignLeft),
                         self.scene.caption)  # fmt: skip

    def _placing(self) -> _Place:
        depth = sum(b.height_mm for b in self.scene.bottoms)
        top = self.scene.piece.height_mm + 14 if self.scene.piece is not None else 30.0
        scale = min((self.height() - 8) / (depth + top + 4), self.width() / 110.0)
        return _Place(self.width() / 2, self.height() - 6 - (depth + 3) * scale, scale)

    def _draw_jaws(self, painter: QPainter, place: _Place) -> None:
        scene, t = self.scene, self._theme.tokens
        if scene.jaws_mm is None or scene.piece is None:
            return
        painter.setPen(QPen(t.colour("border"), 1))
        painter.setBrush(t.colour("raised"))
        height = scene.piece.height_mm + 12
        low = scene.piece.z_mm + max(scene.grip_mm - 7, 0)
        for side in (-1, 1):
            inner = scene.piece.x_mm + side * scene.jaws_mm
            outer = inner + side * 5
            painter.drawRoundedRect(
                QRectF(place(inner, low), place(outer, scene.piece.z_mm + height)).normalized(),
                2,
                2,
            )


@dataclass(frozen=True, slots=True)
class _Place:
    """Maps bench mm (x right, z up) to pixels."""

    x_px: float
    z_px: float
    scale: float

    def __call__(self, x_mm: float, z_mm: float) -> QPointF:
        return QPointF(self.x_px + x_mm * self.scale, self.z_px - z_mm * self.scale)


def _draw_body(painter: QPainter, place: _Place, body: SideBody, fill: QColor, ink: QColor) -> None:
    foot = min(0.2 * body.height_mm, 6.0)
    outline = ((-body.face_mm, 0.0), (body.face_mm, 0.0), (body.face_mm, foot),
               (body.top_mm, foot), (body.top_mm, body.height_mm), (-body.top_mm, body.height_mm),
               (-body.top_mm, foot), (-body.face_mm, foot))  # fmt: skip
    cos, sin = math.cos(body.tilt_rad), math.sin(body.tilt_rad)
    corners = [
        place(body.x_mm + cos * x + sin * z, body.z_mm - sin * x + cos * z) for x, z in outline
    ]
    painter.setPen(QPen(ink, 1))
    painter.setBrush(fill)
    painter.drawPolygon(QPolygonF(corners))

"""Belief map over the piece and its support."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from PySide6.QtCore import QMarginsF, QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QFontMetrics, QImage, QPainter, QPaintEvent, QPen, QResizeEvent
from PySide6.QtWidgets import QSizePolicy, QWidget

from touchdown.backend.core import BeliefMap, FloatArray, Stability
from touchdown.widgets.base import MapName, Theme, map_colours, tr, ui_font
from touchdown.widgets.plots import (
    PictureCache,
    PictureView,
    PlotArea,
    centred_square,
    draw_message,
    draw_mm_grid,
    draw_rings,
)

ENTRIES = (
    ("plus", "centre of mass"),
    ("line", "hull of the contact, p > 0.9"),
    ("dots", "face"),
    ("arrow", "step"),
    ("ring", "target"),
)
TRUTH = ("dashes", "true overlap")
HULL = "Hull: convex outline of sure contact. With its centre of mass inside, the piece stands."
WEIGHED = ("halo", "2 \N{GREEK SMALL LETTER SIGMA} of the weighing")


class BeliefLegend(QWidget):
    """Legend of marks that wraps to the width."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._more: tuple[tuple[str, str], ...] = ()
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)
        self.setAccessibleName(tr("Legend of the belief map"))
        self.setToolTip(tr(HULL))

    def show_truth(self, shown: bool, *, weighed: bool = False) -> None:
        """Show or hide the entries of the true overlap and of a weighed centre of mass."""
        more = (TRUTH,) * shown + (WEIGHED,) * weighed
        if more != self._more:
            self._more = more
            self.updateGeometry()
            self.update()

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Adapt the number of rows to the width."""
        self.updateGeometry()

    def sizeHint(self) -> QSize:
        """Return the rows needed at the present width."""
        rows = 1 + max((row for _, _, _, row in self._places()), default=0)
        return QSize(300, rows * self._line())

    def minimumSizeHint(self) -> QSize:
        """Return the same as the size hint."""
        return self.sizeHint()

    def _line(self) -> int:
        return self.fontMetrics().height() + 2

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the entries row by row."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(ui_font(self._theme.scale, 0.88))
        line = self._line()
        for kind, text, x, row in self._places():
            y = row * line
            painter.setPen(QPen(self._theme.tokens.colour("text"), 1.6))
            _mark(painter, kind, QPointF(x + 9, y + line / 2))
            painter.setPen(self._theme.tokens.colour("muted"))
            box = QRectF(x + 22, y, self.width(), line)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignVCenter), text)

    def _places(self) -> list[tuple[str, str, float, int]]:
        """Return (mark, text, x, row) per entry."""
        metrics = QFontMetrics(ui_font(self._theme.scale, 0.88))
        x, row, places = 0.0, 0, []
        for kind, text in ((kind, tr(text)) for kind, text in (*ENTRIES, *self._more)):
            width = 22 + metrics.horizontalAdvance(text) + 12
            if x > 0 and x + width - 12 > self.width():
                x, row = 0.0, row + 1
            places.append((kind, text, x, row))
            x += width
        return places


def _mark(painter: QPainter, kind: str, at: QPointF) -> None:
    left, right = at - QPointF(8, 0), at + QPointF(8, 0)
    pen = painter.pen()
    if kind == "plus":
        painter.drawLine(at - QPointF(5, 0), at + QPointF(5, 0))
        painter.drawLine(at - QPointF(0, 5), at + QPointF(0, 5))
    elif kind in ("ring", "halo"):
        pen.setStyle(Qt.PenStyle.SolidLine if kind == "ring" else Qt.PenStyle.DotLine)
        painter.setPen(pen)
        painter.drawEllipse(at, 5, 5)
    elif kind in OUTLINES:
        _stroke(painter, kind, lambda: painter.drawLine(left, right))
    else:
        painter.drawLine(left, right)
        painter.drawLine(right, right + QPointF(-5, -4))
        painter.drawLine(right, right + QPointF(-5, 4))


LEAST_HALF_MM = 10.0
NO_PROBE = "No probe in this trial yet", "The first press fills the map."


@dataclass(frozen=True, slots=True)
class BeliefScene:
    """Content of a belief map in the frame ``O``, mm.

    ``path``: face centres of the probes so far, oldest first. ``face``: (k, 2) outline of the piece
    around its face centre. ``truth``: (k, 2) outline of the true overlap, set only after the trial
    on a simulated bench. Both may have several rings, separated by rows of NaN.
    ``com_sigma_mm``: standard uncertainty of a weighed centre of mass along x and y. ``empty``:
    title and detail shown without a map.
    """

    belief: BeliefMap | None = None
    stability: Stability | None = None
    path: tuple[tuple[float, float], ...] = ()
    step_mm: tuple[float, float] | None = None
    target_mm: tuple[float, float] | None = None
    clipped: bool = False
    face: FloatArray | None = None
    truth: FloatArray | None = None
    com_sigma_mm: tuple[float, float] | None = None
    delta: float = 0.9
    empty: tuple[str, str] = NO_PROBE

    def frame_mm(self) -> tuple[float, float, float]:
        """Return centre x, y and half width of the square around the path and the covered cells."""
        points = [np.array(self.path).reshape(-1, 2)]
        if self.belief is not None:
            points.append(self.belief.cell_centres_mm()[self.belief.covered])
        shown = np.concatenate(points)
        if len(shown) == 0:
            return 0.0, 0.0, LEAST_HALF_MM
        low, high = shown.min(axis=0), shown.max(axis=0)
        centre = (low + high) / 2
        half = max(LEAST_HALF_MM, float((high - low).max()) / 2 + 2.0)
        return float(centre[0]), float(centre[1]), half


WHITE, BLACK = QColor("#FFFFFF"), QColor("#000000")
Draw = Callable[[], None]


def draw_marks(
    painter: QPainter, area: PlotArea, scene: BeliefScene, theme: Theme, *, small: bool
) -> None:
    """Draw all marks; ``small`` omits those too fine for a thumbnail."""
    painter.setBrush(Qt.BrushStyle.NoBrush)
    if scene.face is not None and scene.path and not small:
        _outline(painter, area, scene.face + scene.path[-1], "dots")
    if scene.truth is not None:
        _outline(painter, area, scene.truth, "dashes")
    if scene.stability is not None and len(scene.stability.hull_mm):
        _outline(painter, area, scene.stability.hull_mm, "line", 1.4 if small else None)
    if not small:
        _path(painter, area, scene, theme)
    if scene.stability is not None:
        centre = scene.stability.centre_mm
        if all(map(math.isfinite, centre)):
            if scene.step_mm is not None and not small and scene.step_mm != (0.0, 0.0):
                _step(painter, area, centre, scene)
            if scene.com_sigma_mm is not None and not small:
                (x, y), (x_sigma, y_sigma) = centre, scene.com_sigma_mm
                box = QRectF(area.place(x - 2 * x_sigma, y + 2 * y_sigma),
                             area.place(x + 2 * x_sigma, y - 2 * y_sigma))  # fmt: skip
                stroke_on_black(painter, 1.2, Qt.PenStyle.DotLine, lambda: painter.drawEllipse(box))
            draw_plus(painter, area.place(*centre), 4 if small else 8)


# Width, style and colour of the outlines on a map.
OUTLINES = {
    "line": (2.0, Qt.PenStyle.SolidLine, WHITE),
    "dots": (1.0, Qt.PenStyle.DotLine, WHITE),
    "dashes": (2.0, Qt.PenStyle.DashLine, QColor("#FF8AE2")),
}


def stroke_on_black(
    painter: QPainter, width: float, style: Qt.PenStyle, draw: Draw, colour: QColor = WHITE
) -> None:
    """Stroke twice: black two pixels wider below, ``colour`` above."""
    for ink, extra in ((BLACK, 2.0), (colour, 0.0)):
        pen = QPen(ink, width + extra)
        if style is not Qt.PenStyle.SolidLine and not extra:
            pen.setStyle(style)
        pen.setJoinStyle(Qt.PenJoinStyle.RoundJoin)
        painter.setPen(pen)
        draw()


def draw_plus(painter: QPainter, at: QPointF, size: float) -> None:
    """Draw a plus, the mark of the centre of mass."""

    def stroke() -> None:
        painter.drawLine(at - QPointF(size, 0), at + QPointF(size, 0))
        painter.drawLine(at - QPointF(0, size), at + QPointF(0, size))

    stroke_on_black(painter, 2.6, Qt.PenStyle.SolidLine, stroke)


def _outline(
    painter: QPainter, area: PlotArea, points: FloatArray, kind: str, width: float | None = None
) -> None:
    placed = area.points(*points.T)
    _stroke(painter, kind, lambda: draw_rings(painter, placed), width)


def _stroke(painter: QPainter, kind: str, draw: Draw, width: float | None = None) -> None:
    usual, style, colour = OUTLINES[kind]
    stroke_on_black(painter, width or usual, style, draw, colour)


def _path(painter: QPainter, area: PlotArea, scene: BeliefScene, theme: Theme) -> None:
    points = [area.place(x, y) for x, y in scene.path]
    stroke_on_black(painter, 1.0, Qt.PenStyle.SolidLine, lambda: painter.drawPolyline(points))
    painter.setFont(ui_font(theme.scale, 0.8, 600))
    # The newest probe is marked by the plus of the centre of mass, not by a number.
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
    tail, tip = area.place(*start), area.place(start[0] + step[0], start[1] + step[1])
    solid, dots = Qt.PenStyle.SolidLine, Qt.PenStyle.DotLine
    if scene.target_mm is not None and all(map(math.isfinite, scene.target_mm)):
        target = area.place(*scene.target_mm)
        if scene.clipped:
            stroke_on_black(painter, 1.0, dots, lambda: painter.drawLine(tip, target))
        stroke_on_black(painter, 1.6, solid, lambda: painter.drawEllipse(target, 6, 6))
    draw_arrow(painter, tail, tip)


def draw_arrow(painter: QPainter, tail: QPointF, tip: QPointF) -> None:
    """Draw the arrow of a step."""
    along = tip - tail
    length = math.hypot(along.x(), along.y())
    if length < 1:
        return
    unit, across = along / length, QPointF(-along.y(), along.x()) / length

    def stroke() -> None:
        painter.drawLine(tail, tip)
        painter.drawLine(tip, tip - unit * 10 + across * 5)
        painter.drawLine(tip, tip - unit * 10 - across * 5)

    stroke_on_black(painter, 2.2, Qt.PenStyle.SolidLine, stroke)


class BeliefView(PictureView):
    """View of a ``BeliefScene``; rendered again only if the scene, size or theme changes."""

    def __init__(self, theme: Theme, *, thumbnail: bool = False) -> None:
        least_px = (40, 40) if thumbnail else (240, 200)
        super().__init__(theme, "Belief map", least_px, (480, 480), opaque=False)
        self._thumbnail = thumbnail
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus if thumbnail else Qt.FocusPolicy.TabFocus)
        self.scene = BeliefScene()
        self.map_name: MapName = "cividis"
        self._drawn = PictureCache(self, theme)
        self.renders = 0

    def show_scene(self, scene: BeliefScene) -> None:
        """Show another scene."""
        self.scene = scene
        self._drawn.clear()
        self.setAccessibleDescription(describe_scene(scene))
        self.update()

    def show_map(self, name: MapName) -> None:
        """Choose the colour map."""
        self.map_name = name
        self._drawn.clear()
        self.update()

    def paint(self, painter: QPainter) -> None:
        """Draw the cached picture, rendered again if needed."""
        painter.drawPixmap(0, 0, self._drawn.picture(self._draw, self.zoom))

    def square(self, size: QSize) -> QRectF:
        """Return the drawn square in a view of this size, beside axes and colour bar."""
        em = self.fontMetrics().height()
        margins = QMarginsF(2.2 * em, 0.4 * em, 3.4 * em, 1.5 * em)
        return centred_square(size, QMarginsF(1, 1, 1, 1) if self._thumbnail else margins, 10.0)

    def area(self) -> PlotArea:
        """Return the drawn square with the visible part of its frame."""
        cx, cy, half = self.scene.frame_mm()
        square = self.square(self.size())
        return self.zoom.of(PlotArea(square, cx - half, cx + half, cy - half, cy + half))

    def reading(self, x: float, y: float) -> str:
        """Return the place and the probability of its cell."""
        belief, text = self.scene.belief, super().reading(x, y)
        if belief is not None:
            far = np.abs(belief.cell_centres_mm() - (x, y)).max(axis=-1)
            here = belief.covered & (far <= belief.pitch_mm / 2)
            text += "".join(f"; p {p:.2f}" for p in belief.probability[here][:1])
        return text

    def _draw(self, painter: QPainter) -> None:
        self.renders += 1
        area = self.area()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        belief = self.scene.belief
        if belief is None:
            painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
            if not self._thumbnail:
                draw_message(painter, self.rect(), self._theme, *self.scene.empty)
            return
        if self._thumbnail:
            painter.fillRect(area.rect, self._theme.tokens.colour("bg"))
        else:
            painter.setFont(ui_font(self._theme.scale, 0.85))
            draw_mm_grid(painter, area, self._theme)
        painter.save()
        painter.setClipRect(area.rect)
        self._draw_cells(painter, area, belief)
        draw_marks(painter, area, self.scene, self._theme, small=self._thumbnail)
        painter.restore()
        if not self._thumbnail:
            self._draw_colour_bar(painter, area)

    def _draw_cells(self, painter: QPainter, area: PlotArea, belief: BeliefMap) -> None:
        ny, nx = belief.log_odds.shape
        rgba = np.zeros((ny, nx, 4), dtype=np.uint8)
        rgba[..., :3] = map_colours(belief.probability, self.map_name)
        rgba[..., 3] = np.where(belief.covered, 255, 0)
        rgba = np.ascontiguousarray(rgba[::-1])
        image = QImage(rgba.data, nx, ny, 4 * nx, QImage.Format.Format_RGBA8888)
        half = belief.pitch_mm / 2
        x0, y0 = belief.origin_mm[0] - half, belief.origin_mm[1] - half
        x1, y1 = x0 + nx * belief.pitch_mm, y0 + ny * belief.pitch_mm
        target = QRectF(area.place(x0, y1), area.place(x1, y0))
        painter.setRenderHint(QPainter.RenderHint.SmoothPixmapTransform, False)
        painter.drawImage(target, image)

    def _draw_colour_bar(self, painter: QPainter, area: PlotArea) -> None:
        t, rect = self._theme.tokens, area.rect
        bar = QRectF(rect.right() + 10, rect.top(), 10, rect.height())
        ramp = np.ascontiguousarray(map_colours(np.linspace(1, 0, 128)[:, None], self.map_name))
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
        for colour, width in ((BLACK, 3), (WHITE, 1)):
            painter.setPen(QPen(colour, width))
            painter.drawLine(QPointF(bar.left(), y), QPointF(bar.right(), y))


def describe_scene(scene: BeliefScene) -> str:
    """Return the scene in one sentence, for screen readers."""
    if scene.belief is None:
        return tr(scene.empty[0])
    largest = scene.belief.probability.max()
    text = tr("{} probes fused, largest support {:.2f}", scene.belief.probes, largest)
    if scene.stability is not None:
        text += f", {tr(scene.stability.support.value)}, "
        text += tr("margin {:.1f} mm", scene.stability.margin_mm)
    return text

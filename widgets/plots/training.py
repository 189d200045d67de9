"""Plots of a training, and of signals over time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QFontMetrics, QPainter, QPen, QPolygonF

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import Theme, draw_elided_line, map_colours, tr, true_minus, ui_font
from touchdown.widgets.plots import axes
from touchdown.widgets.plots.pictures import PictureView
from touchdown.widgets.views import stroke_on_black

LEAST_EPOCHS = 4
WIDEST_ENDING = "valid. 0.000"  # reserved width right of the curves, so that the plots align
# Colours of the compared runs A, B, C; each line also carries its letter.
RUN_COLOURS = ("axis_x", "axis_z", "axis_y")
Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class CurveLine:
    """One curve: name at its right end, points (x ascending), colour token, style."""

    name: str
    points: Points
    token: str
    dashed: bool = False


class _TrainingPlot(PictureView):
    """Axes and lines; small enough to be drawn without a cache."""

    unit, empty, usual_px = "", "No epoch yet", (280, 170)

    def __init__(self, theme: Theme, name: str) -> None:
        super().__init__(theme, name, (130, 96), self.usual_px, opaque=False)
        self.name = tr(name)
        self.setToolTip(self.name)
        self.lines: tuple[CurveLine, ...] = ()

    def _show(self, lines: Sequence[CurveLine], words: Iterable[str]) -> None:
        self.lines = tuple(lines)
        self.setAccessibleDescription(", ".join(words) or tr(self.empty))
        self.update()

    def _area(self, x: tuple[float, float], y: tuple[float, float], right: float) -> axes.PlotArea:
        em = self.fontMetrics().height()
        top = 1.6 * em
        width, height = self.width() - 2.6 * em - right, self.height() - top - 1.5 * em
        rect = QRectF(2.6 * em, top, max(width, 20), max(height, 20))
        return self.zoom.of(axes.PlotArea(rect, *x, *y))

    def _beside(self, endings: Iterable[str] = ()) -> float:
        metrics = QFontMetrics(ui_font(self._theme.scale, 0.82, 500))
        return 12.0 + max(metrics.horizontalAdvance(text) for text in (WIDEST_ENDING, *endings))

    def _draw_empty(self, painter: QPainter) -> None:
        painter.fillRect(self.rect(), self._theme.tokens.colour("bg"))
        axes.draw_message(painter, self.rect(), self._theme, self.name, self.empty)

    def _draw_axes(self, painter: QPainter, area: axes.PlotArea, *, whole: bool) -> None:
        t, rect = self._theme.tokens, area.rect
        painter.fillRect(rect, t.colour("bg"))
        painter.setFont(ui_font(self._theme.scale, 0.82))
        height = painter.fontMetrics().height()
        rows = max(2, int(rect.height() / (1.7 * height)))
        step = axes.nice_step(area.y1 - area.y0, rows)
        grid = axes.GridPainter(painter, area, t)
        for value in axes.ticks(area.y0, area.y1, rows):
            grid.row(value, axes.tick_text(value, step))
        count = max(2, int(rect.width() / (1.8 * height)))
        step = axes.nice_step(area.x1 - area.x0, count)
        step = max(step, 1.0) if whole else step
        for value in axes.ticks(area.x0, area.x1, count):
            if not whole or value == round(value):
                grid.column(value, axes.tick_text(value, step), line="")
        painter.setFont(ui_font(self._theme.scale, 0.85, 500))
        head = QRectF(rect.left(), 0, self.width() - rect.left(), rect.top() - 3)
        align = Qt.AlignmentFlag.AlignBottom | Qt.AlignmentFlag.AlignLeft
        elide, room = Qt.TextElideMode.ElideRight, int(head.width())
        title = painter.fontMetrics().elidedText(self.name, elide, room)
        painter.drawText(head, int(align), title)

    def _draw_line(self, painter: QPainter, area: axes.PlotArea, line: CurveLine) -> None:
        pen = QPen(self._theme.tokens.colour(line.token), 1.6)
        if line.dashed:
            pen.setStyle(Qt.PenStyle.DashLine)
        painter.setPen(pen)
        painter.setClipRect(area.rect.adjusted(-3, -3, 3, 3))
        points = [QPointF(area.x(x), area.y(y)) for x, y in line.points if math.isfinite(y)]
        if len(points) == 1:
            painter.drawEllipse(points[0], 2.5, 2.5)
        painter.drawPolyline(QPolygonF(points))
        painter.setClipping(False)


class CurvePlot(_TrainingPlot):
    """Values over epochs. The best epoch is marked; ``percent``: values up to 100."""

    over_epochs = True

    def __init__(self, theme: Theme, name: str, *, percent: bool = False) -> None:
        super().__init__(theme, name)
        self._top, self._digits = (100.0, 1) if percent else (math.inf, 3)
        self.best = self.epochs = 0

    def show_lines(self, lines: Sequence[CurveLine], epochs: int, best: int = 0) -> None:
        """Show curves up to ``epochs``; ``best``: epoch to mark, 0 for none."""
        self.epochs, self.best = epochs, best
        self._show(lines, (self._ending(one) for one in lines if one.points))

    def area(self) -> axes.PlotArea:
        """Return the area of the curves, in epochs and values."""
        values = [y for one in self.lines for _, y in one.points if math.isfinite(y)]
        low, high = (min(values), max(values)) if values else (0.0, 1.0)
        gap = max(0.08 * (high - low), 10.0 ** (1 - self._digits))
        low, high = max(low - gap, 0.0), min(high + gap, self._top)
        room = self._beside(self._ending(one) for one in self.lines if one.points)
        return self._area((1.0, float(max(self.epochs, LEAST_EPOCHS))), (low, high), room)

    def paint(self, painter: QPainter) -> None:
        """Draw axes, curves, and the names at their ends."""
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        area = self.area()
        drawn = [one for one in self.lines if one.points]
        if not drawn:
            self._draw_empty(painter)
            return
        self._draw_axes(painter, area, whole=self.over_epochs)
        if self.best or not self.over_epochs:
            painter.setPen(QPen(self._theme.tokens.colour("muted"), 1, Qt.PenStyle.DotLine))
            x = area.x(self.best)
            painter.drawLine(QPointF(x, area.rect.top()), QPointF(x, area.rect.bottom()))
        for one in drawn:
            self._draw_line(painter, area, one)
        painter.setFont(ui_font(self._theme.scale, 0.82, 500))
        height = painter.fontMetrics().height()
        wanted = [area.y(one.points[-1][1]) for one in drawn]
        places = axes.spread_labels(wanted, height, area.rect.top(), area.rect.bottom())
        for one, y in zip(drawn, places, strict=True):
            painter.setPen(self._theme.tokens.colour(one.token))
            box = QRectF(area.rect.right() + 5, y - height / 2, self.width(), height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft), self._ending(one))

    def _ending(self, line: CurveLine) -> str:
        return true_minus(f"{line.name} {line.points[-1][1]:.{self._digits}f}".strip())


class SignalPlot(CurvePlot):
    """Signals over time; the instant 0 is marked."""

    over_epochs, empty, usual_px = False, "No press yet", (200, 120)

    def area(self) -> axes.PlotArea:
        """Return the area of the curves, in seconds and values."""
        points = np.array([p for one in self.lines for p in one.points]).reshape(-1, 2)
        if not len(points):
            return super().area()
        (x0, y0), (x1, y1) = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
        gap = max(0.08 * (y1 - y0), 0.01)
        room = self._beside(self._ending(one) for one in self.lines)
        return self._area((x0, max(x1, x0 + 0.1)), (y0 - gap, y1 + gap), room)


class ReliabilityPlot(_TrainingPlot):
    """Share of points in contact over predicted probability; calibrated ones lie on the line."""

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme, "True over predicted contact")
        self.setToolTip(tr("Share of points in contact over the predicted probability of contact"))

    def show_lines(self, lines: Sequence[CurveLine]) -> None:
        """Show one line per run: (mean predicted probability, share in contact)."""
        self._show(lines, (one.name for one in lines))

    def paint(self, painter: QPainter) -> None:
        """Draw the diagonal and the bins."""
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        if not any(one.points for one in self.lines):
            self._draw_empty(painter)
            return
        area = self._area((0.0, 1.0), (0.0, 1.0), 14.0)
        self._draw_axes(painter, area, whole=False)
        painter.setPen(QPen(self._theme.tokens.colour("muted"), 1, Qt.PenStyle.DotLine))
        painter.drawLine(area.rect.bottomLeft(), area.rect.topRight())
        painter.setFont(ui_font(self._theme.scale, 0.82, 500))
        metrics, left = painter.fontMetrics(), area.rect.adjusted(6, 2, 0, 0)
        wide = any(metrics.horizontalAdvance(one.name) > left.width() for one in self.lines)
        for row, one in enumerate(self.lines):
            self._draw_line(painter, area, one)
            painter.setBrush(self._theme.tokens.colour(one.token))
            for x, y in one.points:
                painter.drawEllipse(QPointF(area.x(x), area.y(y)), 2.2, 2.2)
            painter.setBrush(Qt.BrushStyle.NoBrush)
            box = left.adjusted(0, row * metrics.height() * (2 if wide else 1), 0, 0)
            wrap = Qt.TextFlag.TextWordWrap
            painter.drawText(box, int(Qt.AlignmentFlag.AlignLeft | wrap), one.name)


GAP = 8
CAPTION_LINES = 2
LEAST_EM, MOST_EM = 4.6, 9.0  # side of a tile in heights of the base font


@dataclass(frozen=True, slots=True)
class SampleScene:
    """One sample: face points (N, 2) mm on a lattice of ``pitch_mm``, patches (N,), texts."""

    points_mm: FloatArray
    probability: FloatArray
    truth: NDArray[np.bool_]
    caption: str
    detail: str
    pitch_mm: float = 1.0


class SampleStrip(PictureView):
    """Tiles of samples from best to worst, as many as fit."""

    def __init__(self, theme: Theme) -> None:
        name = "Sample predictions beside the truth"
        super().__init__(theme, name, (200, 110), (520, 240), opaque=False)
        self.scenes: tuple[SampleScene, ...] = ()
        self._why = "Choose a finished run."

    def show_scenes(self, scenes: Sequence[SampleScene], why: str = "") -> None:
        """Show these samples; ``why`` is shown if there are none."""
        self.scenes, self._why = tuple(scenes), why
        words = [f"{scene.caption}, {scene.detail}" for scene in self.shown()]
        self.setAccessibleDescription("; ".join(words) or tr(why))
        self.update()

    def _grid(self) -> tuple[int, int, float]:
        """Return (columns, rows, side) of the largest covered area; side at least ``LEAST_EM``."""
        em = self.fontMetrics().height()
        best, covered = (1, 1, LEAST_EM * em), 0.0
        for columns in range(1, 9):
            for rows in range(1, 4):
                side = min((self.width() + GAP) / columns, (self.height() + GAP) / rows - 2 * em)
                side = min(side - GAP, MOST_EM * em)
                count = min(columns * rows, len(self.scenes))
                if side >= LEAST_EM * em and count * side**2 > covered:
                    best, covered = (columns, rows, side), count * side**2
        return best

    def shown(self) -> list[SampleScene]:
        """Return the samples that fit, evenly from best to worst."""
        if not self.scenes:
            return []
        columns, rows, _ = self._grid()
        count = min(columns * rows, len(self.scenes))
        places = np.linspace(0, len(self.scenes) - 1, count).round().astype(int)
        return [self.scenes[k] for k in places.tolist()]

    def paint(self, painter: QPainter) -> None:
        """Draw the tiles."""
        if not self.scenes:
            axes.draw_message(painter, self.rect(), self._theme, "No samples", self._why)
            return
        columns, _, side = self._grid()
        em = self.fontMetrics().height()
        for place, scene in enumerate(self.shown()):
            row, column = divmod(place, columns)
            x, y = column * (side + GAP), row * (side + GAP + CAPTION_LINES * em)
            self._draw_tile(painter, QRectF(x, y, side, side), scene)

    def _draw_tile(self, painter: QPainter, box: QRectF, scene: SampleScene) -> None:
        t = self._theme.tokens
        painter.fillRect(box, t.colour("bg"))
        reach = float(np.abs(scene.points_mm).max()) + scene.pitch_mm
        scale = box.width() / (2 * reach)
        cell = scene.pitch_mm * scale
        painter.setPen(Qt.PenStyle.NoPen)
        rgb = map_colours(scene.probability, "cividis")
        centres = scene.points_mm * (scale, -scale) + (box.center().x(), box.center().y())
        for (x, y), colour in zip(centres.tolist(), rgb.tolist(), strict=True):
            painter.fillRect(QRectF(x - cell / 2, y - cell / 2, cell + 0.5, cell + 0.5),
                             QColor(*colour))  # fmt: skip
        edges = _edges(scene.points_mm[scene.truth], scene.pitch_mm)
        lines = edges * (scale, -scale) + (box.center().x(), box.center().y())

        def stroke() -> None:
            for (x0, y0), (x1, y1) in lines.tolist():
                painter.drawPolyline(QPolygonF([QPointF(x0, y0), QPointF(x1, y1)]))

        stroke_on_black(painter, 1.4, Qt.PenStyle.SolidLine, stroke)
        self._words(painter, box, scene)

    def _words(self, painter: QPainter, box: QRectF, scene: SampleScene) -> None:
        em = self.fontMetrics().height()
        line = QRectF(box.left(), box.bottom() + 1, box.width() + GAP - 2, em)
        for text, token, size, weight in (
            (scene.caption, "text", 0.88, 500), (scene.detail, "muted", 0.82, 400)
        ):  # fmt: skip
            painter.setFont(ui_font(self._theme.scale, size, weight))
            draw_elided_line(painter, line, text, self._theme.tokens.colour(token))
            line.translate(0, 0.92 * em)


def _edges(points_mm: FloatArray, pitch_mm: float) -> FloatArray:
    """Return (k, 2, 2) the outer sides of the lattice cells of ``points_mm``."""
    cells = {(round(x / pitch_mm), round(y / pitch_mm)) for x, y in points_mm.tolist()}
    ends = [
        (i + (di + s * dj) / 2, j + (dj + s * di) / 2)
        for i, j in sorted(cells)
        for di, dj in ((1, 0), (-1, 0), (0, 1), (0, -1))
        if (i + di, j + dj) not in cells
        for s in (-1, 1)
    ]
    return pitch_mm * np.reshape(np.asarray(ends, dtype=np.float64), (-1, 2, 2))

"""Distribution of displacements."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PySide6.QtCore import QMarginsF, QPointF, QRectF, Qt
from PySide6.QtGui import QColor, QMouseEvent, QPainter, QPen

from touchdown.backend.core import FloatArray
from touchdown.widgets.base import MapName, Theme, Tokens, map_colours, tr, ui_font
from touchdown.widgets.plots import axes
from touchdown.widgets.plots.pictures import PictureView

NEAR_PX = 12.0  # a click farther than this from every dot selects none
DOT_PX = 7.0
# Part of a colour map with a contrast of 3 : 1 at least on a dark and on a light ground.
ON_DARK, ON_LIGHT = (0.42, 1.0), (0.0, 0.58)


@dataclass(frozen=True, slots=True)
class BinCounts:
    """Histogram: ``counts`` and ``possible`` (ny, nx); bin (0, 0) is centred at ``first_mm``."""

    counts: NDArray[np.intp]
    possible: NDArray[np.bool_]
    first_mm: tuple[float, float]
    bin_mm: float


@dataclass(frozen=True, slots=True)
class DistributionScene:
    """Displacements over the contour of a bottom, coloured by a value or counted in bins.

    ``bottom`` (k, 2): contour; ``points_mm`` (n, 2): displacements; ``values`` (n,): their values.
    ``refused`` (n,): no observation. ``flagged`` (n,). ``chosen``: index of a dot or -1.
    ``reach_mm``: half width of the drawn square. With ``bins`` the counts are drawn instead of the
    values. ``title``: meaning of the colours, with unit.
    """

    bottom: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    points_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    values: FloatArray = field(default_factory=lambda: np.zeros(0))
    refused: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    flagged: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    chosen: int = -1
    reach_mm: float = 20.0
    bins: BinCounts | None = None
    title: str = ""

    @property
    def span(self) -> tuple[float, float]:
        """Lowest and highest value of the colour scale; never of zero length."""
        if self.bins is not None:
            return 0.0, float(max(self.bins.counts.max(initial=0), 1))
        known = self.values[np.isfinite(self.values) & ~self.refused]
        if not len(known):
            return 0.0, 1.0
        low, high = float(known.min()), float(known.max())
        return (low, high) if high > low else (low - 0.5, high + 0.5)


class DistributionView(PictureView):
    """Plot of a ``DistributionScene``; ``choose`` gets the index of the clicked dot."""

    def __init__(self, theme: Theme, name: str, choose: Callable[[int], None]) -> None:
        # Nearly a square; the colour bar takes room at the right.
        super().__init__(theme, name, (190, 180), (320, 280))
        self._choose = choose
        self.scene = DistributionScene()
        self._map: MapName = "cividis"
        self._cache = axes.PictureCache(self, theme)

    def show_scene(self, scene: DistributionScene) -> None:
        """Show another scene."""
        self.scene = scene
        low, high = scene.span
        said = tr(
            "{} displacements, {} {:.3g} to {:.3g}", len(scene.points_mm), scene.title, low, high
        )
        self.setAccessibleDescription(said)
        self.update()

    def area(self) -> axes.PlotArea:
        """Return the drawn square."""
        em = self.fontMetrics().height()
        margins = QMarginsF(2.2 * em, 0.9 * em, 3.6 * em, 1.4 * em)
        reach = self.scene.reach_mm
        square = axes.centred_square(self.size(), margins, 40.0)
        return self.zoom.of(axes.PlotArea(square, -reach, reach, -reach, reach))

    def mousePressEvent(self, event: QMouseEvent) -> None:
        """Select the nearest dot."""
        super().mousePressEvent(event)
        points = self.scene.points_mm
        if event.button() is not Qt.MouseButton.LeftButton or not len(points):
            return
        area, at = self.area(), event.position()
        x, y = area.columns(points[:, 0]), area.rows(points[:, 1])
        away = np.hypot(x - at.x(), y - at.y())
        nearest = int(np.argmin(away))
        if away[nearest] <= NEAR_PX:
            self._choose(nearest)

    def paint(self, painter: QPainter) -> None:
        """Draw the cached picture; render it again if the scene, part, size or theme changed."""
        if not len(self.scene.bottom):
            painter.fillRect(self.rect(), self._theme.tokens.colour("panel"))
            axes.draw_message(
                painter, self.rect(), self._theme, "Nothing yet", "No pair is chosen."
            )
            return
        painter.drawPixmap(0, 0, self._cache.picture(self._draw, id(self.scene), self.zoom))

    def _draw(self, painter: QPainter) -> None:
        area = self.area()
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        painter.setFont(ui_font(self._theme.scale, 0.8))
        count = 6 if area.rect.width() > 260 else 4
        axes.draw_mm_grid(painter, area, self._theme, count, outside=True)
        painter.save()
        painter.setClipRect(area.rect)
        if self.scene.bins is not None:
            self._draw_bins(painter, area, self.scene.bins)
        painter.setBrush(Qt.BrushStyle.NoBrush)
        painter.setPen(QPen(self._theme.tokens.colour("text"), 2))
        outline = self.scene.bottom
        axes.draw_rings(painter, area.points(outline[:, 0], outline[:, 1]))
        if self.scene.bins is None:
            self._draw_dots(painter, area)
        self._draw_chosen(painter, area)
        painter.restore()
        self._draw_scale(painter, area)

    def _draw_bins(self, painter: QPainter, area: axes.PlotArea, bins: BinCounts) -> None:
        shades = legible_colours(bins.counts / self.scene.span[1], self._map, self._theme.tokens)
        hole = QPen(self._theme.tokens.colour("border"), 1, Qt.PenStyle.DotLine)
        (x_mm, y_mm), size = bins.first_mm, bins.bin_mm
        for row, column in np.argwhere(bins.possible | (bins.counts > 0)).tolist():
            left, right = (area.x(x_mm + (column + side) * size) for side in (-0.5, 0.5))
            bottom, top = (area.y(y_mm + (row + side) * size) for side in (-0.5, 0.5))
            box = QRectF(QPointF(left + 0.5, top + 0.5), QPointF(right - 0.5, bottom - 0.5))
            if bins.counts[row, column]:
                painter.fillRect(box, QColor(*shades[row, column].tolist()))
            else:
                painter.setPen(hole)
                painter.drawRect(box)

    def _draw_dots(self, painter: QPainter, area: axes.PlotArea) -> None:
        scene, t = self.scene, self._theme.tokens
        low, high = scene.span
        shades = legible_colours((scene.values - low) / (high - low), self._map, t)
        x, y = area.columns(scene.points_mm[:, 0]), area.rows(scene.points_mm[:, 1])
        rim = QPen(t.colour("border"), 1)
        for k in range(len(x)):
            at = QPointF(x[k], y[k])
            if scene.refused[k]:
                painter.setPen(QPen(t.colour("bad"), 1.6))
                for arm in (QPointF(3, 3), QPointF(3, -3)):
                    painter.drawLine(at - arm, at + arm)
                continue
            painter.setPen(rim)
            painter.setBrush(QColor(*shades[k].tolist()))
            painter.drawEllipse(at, DOT_PX / 2, DOT_PX / 2)
            if scene.flagged[k]:
                painter.setBrush(Qt.BrushStyle.NoBrush)
                painter.setPen(QPen(t.colour("text"), 1.4))
                painter.drawRect(QRectF(at.x() - 6, at.y() - 6, 12, 12))

    def _draw_chosen(self, painter: QPainter, area: axes.PlotArea) -> None:
        if not 0 <= self.scene.chosen < len(self.scene.points_mm):
            return
        x, y = self.scene.points_mm[self.scene.chosen].tolist()
        painter.setBrush(Qt.BrushStyle.NoBrush)
        for colour, width in (("bg", 4.0), ("focus", 2.0)):
            painter.setPen(QPen(self._theme.tokens.colour(colour), width))
            painter.drawEllipse(QPointF(area.x(x), area.y(y)), 9, 9)

    def _draw_scale(self, painter: QPainter, area: axes.PlotArea) -> None:
        t, (low, high) = self._theme.tokens, self.scene.span
        bar = QRectF(area.rect.right() + 10, area.rect.top(), 10, area.rect.height())
        ramp = legible_colours(np.linspace(1.0, 0.0, int(bar.height())), self._map, t)
        for k, shade in enumerate(ramp.tolist()):
            painter.fillRect(QRectF(bar.left(), bar.top() + k, 10, 1.5), QColor(*shade))
        painter.setPen(QPen(t.colour("border"), 1))
        painter.drawRect(bar)
        whole = self.scene.bins is not None
        step = max(axes.nice_step(high - low, 4), 1.0 if whole else 0.0)
        scale, height = axes.PlotArea(bar, 0, 1, low, high), painter.fontMetrics().height()
        painter.setPen(t.colour("muted"))
        for value in axes.ticks(low, high, 4):
            if self.scene.bins is not None and value != round(value):
                continue
            box = QRectF(bar.right() + 4, scale.y(value) - height / 2, 60, height)
            painter.drawText(box, int(Qt.AlignmentFlag.AlignVCenter), axes.tick_text(value, step))


def legible_colours(share: FloatArray, name: MapName, tokens: Tokens) -> NDArray[np.uint8]:
    """Map shares in 0..1 to colours that are seen on the ground of the theme."""
    low, high = ON_DARK if tokens.colour("bg").lightness() < 128 else ON_LIGHT
    return map_colours(low + (high - low) * share, name)


def reach_of(bottom: FloatArray, points_mm: FloatArray) -> float:
    """Return the half width, a multiple of 5 mm, that holds the contour and all points."""
    finite = points_mm[np.isfinite(points_mm).all(axis=1)]
    largest = float(np.nanmax(np.abs(np.concatenate([bottom, finite])), initial=0.0))
    return 5.0 * math.ceil((largest + 1.0) / 5.0)

"""Small belief maps of the probes of a trial."""

from __future__ import annotations

import math
from collections.abc import Callable

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QKeyEvent, QMouseEvent, QPainter, QPaintEvent, QPen, QResizeEvent
from PySide6.QtWidgets import QBoxLayout, QScrollArea, QSizePolicy, QWidget

from touchdown.backend.core import Stability
from touchdown.widgets import base
from touchdown.widgets.plots import draw_message
from touchdown.widgets.views.belief import BeliefLegend, BeliefScene, BeliefView, describe_scene
from touchdown.widgets.views.decision import signed_mm

SIDE_PX = 62
NO_PROBES = ("No finished probe yet", "Each probe adds a map; click one to view it again.")


class Thumbnail(QWidget):
    """Map and caption of one probe."""

    def __init__(self, theme: base.Theme, index: int, on_click: Callable[[int], None]) -> None:
        super().__init__()
        self._theme, self.index, self._on_click = theme, index, on_click
        self.chosen = False
        self.view = BeliefView(theme, thumbnail=True)
        self.view.setFixedSize(SIDE_PX, SIDE_PX)
        self.view.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.caption = base.label("", "small")
        self.caption.setAlignment(Qt.AlignmentFlag.AlignHCenter)
        column = base.vbox(parent=self, margins=(5, 4, 5, 2), spacing=1)
        column.addWidget(self.view, 0, Qt.AlignmentFlag.AlignHCenter)
        column.addWidget(self.caption, 0, Qt.AlignmentFlag.AlignHCenter)
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setCursor(Qt.CursorShape.PointingHandCursor)

    def show_chosen(self, chosen: bool) -> None:
        """Highlight the probe shown large."""
        self.chosen = chosen
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the frame of a selected or focused probe."""
        if self.chosen or self.hasFocus():
            painter = QPainter(self)
            token = "focus" if self.hasFocus() else "text"
            painter.setPen(QPen(self._theme.tokens.colour(token), 2))
            painter.drawRoundedRect(QRectF(self.rect()).adjusted(1, 1, -1, -1), 4, 4)

    def mousePressEvent(self, _event: QMouseEvent) -> None:
        """Select this probe."""
        self._on_click(self.index)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Select this probe with Return."""
        if event.key() in base.ENTER:
            self._on_click(self.index)
        else:
            super().keyPressEvent(event)


class ProbeStrip(QWidget):
    """Row of thumbnails, or column if upright; scrolls to the newest."""

    def __init__(self, theme: base.Theme, on_choose: Callable[[int], None]) -> None:
        super().__init__()
        self._theme, self._on_choose = theme, on_choose
        self.thumbnails: list[Thumbnail] = []
        self._lines, self.upright = 1, False
        self._map: base.MapName = "cividis"
        self._empty = NO_PROBES
        self._inner = QWidget()
        self._row = QBoxLayout(QBoxLayout.Direction.LeftToRight, self._inner)
        self._row.setContentsMargins(0, 0, 0, 0)
        self._row.setSpacing(2)
        self._row.addStretch(1)
        self._scroll = QScrollArea()
        self._scroll.setWidget(self._inner)
        self._scroll.setWidgetResizable(True)
        self._scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._scroll.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        base.vbox(self._scroll, parent=self, margins=(0, 0, 0, 0))
        for bar in (self._scroll.verticalScrollBar(), self._scroll.horizontalScrollBar()):
            bar.rangeChanged.connect(lambda _low, high, bar=bar: bar.setValue(high))
        self._scroll.hide()
        self.setAccessibleName(base.tr("Probes of this trial"))
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def row_px(self) -> int:
        """Return the height of a row with its scroll bar."""
        return SIDE_PX + self._lines * self.fontMetrics().height() + 20

    def column_px(self) -> int:
        """Return the width of a column with its scroll bar."""
        return self.fontMetrics().horizontalAdvance("10: \N{ALMOST EQUAL TO}+10.0 mm") + 24

    def sizeHint(self) -> QSize:
        """Return the size of one row or column."""
        return QSize(self.column_px(), 300) if self.upright else QSize(300, self.row_px())

    def minimumSizeHint(self) -> QSize:
        """Return a short length; the strip scrolls."""
        return QSize(self.column_px(), 120) if self.upright else QSize(120, self.row_px())

    def show_upright(self, upright: bool) -> None:
        """Arrange the thumbnails as a column or a row."""
        self.upright = upright
        direction, policy = QBoxLayout.Direction, QSizePolicy.Policy
        self._row.setDirection(direction.TopToBottom if upright else direction.LeftToRight)
        along, across = policy.Expanding, policy.Fixed
        self.setSizePolicy(*((across, along) if upright else (along, across)))
        off, needed = Qt.ScrollBarPolicy.ScrollBarAlwaysOff, Qt.ScrollBarPolicy.ScrollBarAsNeeded
        self._scroll.setVerticalScrollBarPolicy(needed if upright else off)
        self._scroll.setHorizontalScrollBarPolicy(off if upright else needed)
        self.updateGeometry()

    def show_map(self, name: base.MapName) -> None:
        """Set the colour map of all thumbnails."""
        self._map = name
        for thumbnail in self.thumbnails:
            thumbnail.view.show_map(name)

    def show_probes(
        self, probes: list[tuple[BeliefScene, str]], chosen: int, empty: tuple[str, str] = NO_PROBES
    ) -> None:
        """Show these probes with one selected; ``empty``: title and detail if there are none."""
        self._empty = empty
        while len(self.thumbnails) > len(probes):
            gone = self.thumbnails.pop()
            self._row.removeWidget(gone)
            gone.hide()
            gone.deleteLater()
        while len(self.thumbnails) < len(probes):
            fresh = Thumbnail(self._theme, len(self.thumbnails), self._on_choose)
            fresh.view.show_map(self._map)
            self.thumbnails.append(fresh)
            self._row.insertWidget(len(self.thumbnails) - 1, fresh)
        for thumbnail, (scene, caption) in zip(self.thumbnails, probes, strict=True):
            if thumbnail.view.scene is not scene:
                thumbnail.view.show_scene(scene)
                thumbnail.caption.setText(caption)
                thumbnail.setAccessibleName(
                    base.tr("Probe {}: {}", thumbnail.index + 1, describe_scene(scene))
                )
                said = caption.replace("\n", ", ")
                thumbnail.setToolTip(
                    base.tr("Probe {} (estimated margin). Click to view it again.", said)
                )
            thumbnail.show_chosen(thumbnail.index == chosen)
        lines = max((caption.count("\n") + 1 for _, caption in probes), default=1)
        if lines != self._lines:
            self._lines = lines
            self.updateGeometry()
        self._scroll.setVisible(bool(probes))

    def mark(self, chosen: int) -> None:
        """Select another probe."""
        for thumbnail in self.thumbnails:
            thumbnail.show_chosen(thumbnail.index == chosen)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the text of an empty strip."""
        if not self.thumbnails:
            draw_message(QPainter(self), self.rect(), self._theme, *self._empty)


def caption_of(probe: int, stability: Stability | None) -> str:
    """Return the caption of a thumbnail, with the margin marked as an estimate."""
    if stability is None:
        return f"{probe}"
    margin = signed_mm(stability.margin_mm)
    about = "\N{ALMOST EQUAL TO}" if math.isfinite(stability.margin_mm) else ""
    return f"{probe}: {about}{margin}"


GAIN = 1.15  # growth of the map by which a column of thumbnails is preferred to a row


class MapAndStrip(QWidget):
    """Belief map with its legend and the strip of probes below or beside it."""

    def __init__(self, view: BeliefView, legend: BeliefLegend, strip: ProbeStrip) -> None:
        super().__init__()
        self._view, self._legend, self._strip, self._line = view, legend, strip, base.rule()
        self._views = base.vbox((view, 1), legend, spacing=6)
        self._box = QBoxLayout(QBoxLayout.Direction.TopToBottom, self)
        self._box.setContentsMargins(0, 0, 0, 0)
        self._box.setSpacing(6)
        base.add_items(self._box, (self._views, 1), self._line, strip)

    @property
    def beside(self) -> bool:
        """True while the strip is beside the map."""
        return self._box.direction() is QBoxLayout.Direction.LeftToRight

    def minimumSizeHint(self) -> QSize:
        """Return the minimum of the arrangement with the strip below."""
        legend = self._legend.minimumSizeHint().height()
        high = self._view.minimumHeight() + legend + self._strip.row_px() + 20
        return QSize(max(self._strip.column_px() + 120, self._view.minimumWidth()), high)

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Move the strip to the side that leaves the larger map."""
        width, high = self.width(), self.height() - self._legend.sizeHint().height() - 6
        below = self._view.square(QSize(width, high - self._strip.row_px() - 14))
        aside = self._view.square(QSize(width - self._strip.column_px() - 6, high))
        self._put_strip(beside=aside.width() >= GAIN * below.width())

    def _put_strip(self, *, beside: bool) -> None:
        if beside != self.beside:
            direction = QBoxLayout.Direction
            self._box.setDirection(direction.LeftToRight if beside else direction.TopToBottom)
            self._line.setVisible(not beside)
            self._strip.show_upright(beside)


class BeliefPanel(base.Panel):
    """Belief map with a choice of colour map, which the ``strip`` of small maps follows."""

    def __init__(self, theme: base.Theme, title: str, strip: ProbeStrip | None = None) -> None:
        super().__init__(title)
        self.view, self.legend, self._strip = BeliefView(theme), BeliefLegend(theme), strip
        if strip is None:
            base.add_items(self.column, (self.view, 1), self.legend)
        else:
            self.column.addWidget(MapAndStrip(self.view, self.legend, strip), 1)
        self.maps = base.compact_combo_box(list(base.MAPS), "Colour map of the belief")
        self.maps.currentIndexChanged.connect(self._choose)
        self.header.addWidget(self.maps)

    def _choose(self, index: int) -> None:
        for view in (self.view, self._strip):
            if view is not None:
                view.show_map(base.MAPS[index])

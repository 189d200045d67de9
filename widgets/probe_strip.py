"""The probes of a trial as small belief maps; a click looks back."""

from __future__ import annotations

import math
from collections.abc import Callable

from PySide6.QtCore import QRectF, QSize, Qt
from PySide6.QtGui import QKeyEvent, QMouseEvent, QPainter, QPaintEvent, QPen
from PySide6.QtWidgets import QBoxLayout, QScrollArea, QSizePolicy, QVBoxLayout, QWidget

from backend.core.flow import Stability
from widgets.belief_scene import BeliefScene
from widgets.belief_view import BeliefView, describe
from widgets.colour_maps import MapName
from widgets.decision_panel import signed_mm
from widgets.overlay import draw_message
from widgets.panel import label
from widgets.theme import Theme

SIDE_PX = 62
NO_PROBES = ("No probes yet", "Each press adds a small map; click one to look back.")


class Thumbnail(QWidget):
    """One probe: map and one line of text."""

    def __init__(self, theme: Theme, index: int, on_click: Callable[[int], None]) -> None:
        super().__init__()
        self._theme, self.index, self._on_click = theme, index, on_click
        self.chosen = False
        self.view = BeliefView(theme, thumbnail=True)
        self.view.setFixedSize(SIDE_PX, SIDE_PX)
        self.view.setAttribute(Qt.WidgetAttribute.WA_TransparentForMouseEvents)
        self.caption = label("", "small")
        self.caption.setAlignment(Qt.AlignmentFlag.AlignHCenter)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 4, 4, 2)
        column.setSpacing(1)
        column.addWidget(self.view, 0, Qt.AlignmentFlag.AlignHCenter)
        column.addWidget(self.caption, 0, Qt.AlignmentFlag.AlignHCenter)
        self.setFocusPolicy(Qt.FocusPolicy.TabFocus)
        self.setCursor(Qt.CursorShape.PointingHandCursor)

    def show_probe(self, scene: BeliefScene, caption: str) -> None:
        """Show the state after this probe."""
        self.view.show_scene(scene)
        self.caption.setText(caption)
        self.setAccessibleName(f"Probe {self.index + 1}: {describe(scene)}")
        said = caption.replace("\n", ", ")
        self.setToolTip(f"Probe {said} (estimated margin). Click to look back.")

    def show_chosen(self, chosen: bool) -> None:
        """Mark this as the one shown large."""
        self.chosen = chosen
        self.update()

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Draw the frame of the chosen or focused one."""
        if self.chosen or self.hasFocus():
            painter = QPainter(self)
            token = "focus" if self.hasFocus() else "text"
            painter.setPen(QPen(self._theme.tokens.colour(token), 2))
            painter.drawRoundedRect(QRectF(self.rect()).adjusted(1, 1, -1, -1), 4, 4)

    def mousePressEvent(self, _event: QMouseEvent) -> None:
        """Choose this probe."""
        self._on_click(self.index)

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Choose this probe by Return."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            self._on_click(self.index)
        else:
            super().keyPressEvent(event)


class ProbeStrip(QWidget):
    """A row of thumbnails, or a column while upright, scrolled to the newest."""

    def __init__(self, theme: Theme, on_choose: Callable[[int], None]) -> None:
        super().__init__()
        self._theme, self._on_choose = theme, on_choose
        self.thumbnails: list[Thumbnail] = []
        self._lines, self.upright = 1, False
        self._map: MapName = "cividis"
        self._empty = NO_PROBES
        self._inner = QWidget()
        self._row = QBoxLayout(QBoxLayout.Direction.LeftToRight, self._inner)
        self._row.setContentsMargins(0, 0, 0, 0)
        self._row.setSpacing(4)
        self._row.addStretch(1)
        self._scroll = QScrollArea()
        self._scroll.setWidget(self._inner)
        self._scroll.setWidgetResizable(True)
        self._scroll.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._scroll.setVerticalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(self._scroll)
        self._scroll.hide()
        self.setAccessibleName("Probes of this trial")
        self.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Fixed)

    def row_px(self) -> int:
        """Return the height of a row and its scroll bar."""
        return SIDE_PX + self._lines * self.fontMetrics().height() + 20

    def column_px(self) -> int:
        """Return the width of a column and its scroll bar: the longest usual caption."""
        return self.fontMetrics().horizontalAdvance("10: est. +10.0 mm") + 16

    def sizeHint(self) -> QSize:
        """Return room for one row or column and its scroll bar."""
        return QSize(self.column_px(), 300) if self.upright else QSize(300, self.row_px())

    def minimumSizeHint(self) -> QSize:
        """Return little along the thumbnails: the strip scrolls."""
        return QSize(self.column_px(), 120) if self.upright else QSize(120, self.row_px())

    def show_upright(self, upright: bool) -> None:
        """Stand the thumbnails below each other, or in a row."""
        self.upright = upright
        direction, policy = QBoxLayout.Direction, QSizePolicy.Policy
        self._row.setDirection(direction.TopToBottom if upright else direction.LeftToRight)
        along, across = policy.Expanding, policy.Fixed
        self.setSizePolicy(*((across, along) if upright else (along, across)))
        off, needed = Qt.ScrollBarPolicy.ScrollBarAlwaysOff, Qt.ScrollBarPolicy.ScrollBarAsNeeded
        self._scroll.setVerticalScrollBarPolicy(needed if upright else off)
        self._scroll.setHorizontalScrollBarPolicy(off if upright else needed)
        self.updateGeometry()

    def show_map(self, name: MapName) -> None:
        """Choose the colour map of all thumbnails."""
        self._map = name
        for thumbnail in self.thumbnails:
            thumbnail.view.show_map(name)

    def show_probes(
        self,
        probes: list[tuple[BeliefScene, str]],
        chosen: int,
        empty: tuple[str, str] = NO_PROBES,
    ) -> None:
        """Show these probes and mark one; without any, say ``empty``: what is so, and why."""
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
                thumbnail.show_probe(scene, caption)
            thumbnail.show_chosen(thumbnail.index == chosen)
        lines = max((caption.count("\n") + 1 for _, caption in probes), default=1)
        if lines != self._lines:
            self._lines = lines
            self.updateGeometry()
        self._scroll.setVisible(bool(probes))
        scroll = self._scroll
        bar = scroll.verticalScrollBar() if self.upright else scroll.horizontalScrollBar()
        if chosen == len(probes) - 1:
            bar.setValue(bar.maximum())

    def mark(self, chosen: int) -> None:
        """Mark another probe."""
        for thumbnail in self.thumbnails:
            thumbnail.show_chosen(thumbnail.index == chosen)

    def paintEvent(self, _event: QPaintEvent) -> None:
        """Say that there is no probe yet."""
        if not self.thumbnails:
            draw_message(QPainter(self), self.rect(), self._theme, *self._empty)


def caption_of(probe: int, stability: Stability | None) -> str:
    """Return the line below a thumbnail; it says that its margin is the estimate, not the truth."""
    if stability is None:
        return f"{probe}"
    mark = "est. " if math.isfinite(stability.margin_mm) else ""
    return f"{probe}: {mark}{signed_mm(stability.margin_mm)}"

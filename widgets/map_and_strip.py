"""The belief map with its probes as small maps: below it, or beside it where that leaves it more.

The map is square. In a wide and low place a row below would take the height that it needs.
"""

from __future__ import annotations

from PySide6.QtCore import QSize
from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QBoxLayout, QVBoxLayout, QWidget

from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.panel import rule
from widgets.probe_strip import ProbeStrip

GAIN = 1.15
"""The small maps go beside the map where it grows at least so many times by it."""


class MapAndStrip(QWidget):
    """The legend stays below the map."""

    def __init__(self, view: BeliefView, legend: BeliefLegend, strip: ProbeStrip) -> None:
        super().__init__()
        self._view, self._legend, self._strip, self._line = view, legend, strip, rule()
        self._views = QVBoxLayout()
        self._views.setSpacing(6)
        self._views.addWidget(view, 1)
        self._views.addWidget(legend)
        self._box = QBoxLayout(QBoxLayout.Direction.TopToBottom, self)
        self._box.setContentsMargins(0, 0, 0, 0)
        self._box.setSpacing(6)
        self._box.addLayout(self._views, 1)
        self._box.addWidget(self._line)
        self._box.addWidget(strip)

    @property
    def beside(self) -> bool:
        """Whether the small maps stand beside the map now."""
        return self._box.direction() is QBoxLayout.Direction.LeftToRight

    def minimumSizeHint(self) -> QSize:
        """Return room for the arrangement below: what is asked for does not follow the room."""
        legend = self._legend.minimumSizeHint().height()
        high = self._view.minimumHeight() + legend + self._strip.row_px() + 20
        return QSize(self._strip.column_px() + 120, high)

    def resizeEvent(self, _event: QResizeEvent) -> None:
        """Stand the small maps where they leave the map more room."""
        width, high = self.width(), self.height() - self._legend.sizeHint().height() - 6
        below = self._view.side_px(QSize(width, high - self._strip.row_px() - 14))
        aside = self._view.side_px(QSize(width - self._strip.column_px() - 6, high))
        self._stand(aside >= GAIN * below)

    def _stand(self, beside: bool) -> None:
        if beside == self.beside:
            return
        direction = QBoxLayout.Direction
        self._box.setDirection(direction.LeftToRight if beside else direction.TopToBottom)
        self._line.setVisible(not beside)
        self._strip.show_upright(beside)

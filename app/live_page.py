"""What the pages with live views have in common: fingers, force and moment."""

from __future__ import annotations

from PySide6.QtGui import QResizeEvent
from PySide6.QtWidgets import QHBoxLayout, QSizePolicy, QVBoxLayout, QWidget

from backend.core.flow import FINGERS, Finger
from widgets.columns import Columns
from widgets.force_traces import TracePlot
from widgets.freshness import Age
from widgets.panel import Panel
from widgets.tactile_view import TactileView
from widgets.theme import Theme

TACTILE_SHARE = 0.45
"""The fingers take at most this share of the page's height; the traces need the rest."""
Part = QWidget | QHBoxLayout


class LivePage(QWidget):
    """Makes the live views; the page itself says where they stand."""

    columns: Columns

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self.setObjectName("frame")
        self._theme = theme
        self.tactile: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.force = TracePlot(theme, "Force", "F", "N", 10.0)
        self.moment = TracePlot(theme, "Moment", "T", "N\N{MIDDLE DOT}m", 0.2)

    def show_silent(self, why: str) -> None:
        """Say in the live views why nothing is shown yet."""
        for view in self.tactile.values():
            view.show_age(Age.NEVER, 0.0, why)
        for plot in (self.force, self.moment):
            plot.show_age(Age.NEVER, 0.0, why)

    def heightForWidth(self, _width: int) -> int:
        """Ask for no more than the least height: the views share what there is."""
        return self.minimumHeight()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Leave room for the traces."""
        super().resizeEvent(event)
        self._leave_room()

    def stand_in(self, columns: Columns, traces: str) -> None:
        """Fill the page with its columns; ``traces``: title of the panel below the fingers."""
        self.columns, self._traces = columns, traces
        columns.arranged.connect(self._leave_room)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 8, 10, 8)
        row.addWidget(columns)

    def _leave_room(self) -> None:
        share = 1.0 if self.columns.hides(self._traces) else TACTILE_SHARE
        for view in self.tactile.values():
            view.limit_height(round(share * self.height()))


def no_higher(panel: Panel) -> None:
    """Let a panel be as high as its views and no higher."""
    panel.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)


def column(*parts: tuple[Part, int]) -> QWidget:
    """Return a column of (view, stretch), one below the other."""
    holder = QWidget()
    layout = QVBoxLayout(holder)
    layout.setContentsMargins(0, 0, 0, 0)
    layout.setSpacing(8)
    for part, stretch in parts:
        if isinstance(part, QWidget):
            layout.addWidget(part, stretch)
        else:
            layout.addLayout(part, stretch)
    # Takes what is over once the views that stretch are left out.
    layout.addStretch(0)
    return holder

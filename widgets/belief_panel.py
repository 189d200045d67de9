"""The belief map with its legend and the choice of its colours."""

from __future__ import annotations

from collections.abc import Sequence

from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.colour_maps import MAPS
from widgets.header_tools import chooser
from widgets.panel import Panel
from widgets.theme import Theme


class BeliefPanel(Panel):
    """``also``: further views that follow the choice of the colour map."""

    def __init__(self, theme: Theme, title: str, also: Sequence[BeliefView] = ()) -> None:
        super().__init__(title)
        self.view, self.legend, self._also = BeliefView(theme), BeliefLegend(theme), also
        self.column.addWidget(self.view, 1)
        self.column.addWidget(self.legend)
        self.maps = chooser(list(MAPS), "Colour map of the belief")
        self.maps.currentIndexChanged.connect(self._choose)
        self.header.addWidget(self.maps)

    def _choose(self, index: int) -> None:
        for view in (self.view, *self._also):
            view.show_map(MAPS[index])

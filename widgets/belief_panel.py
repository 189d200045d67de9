"""The belief map with its legend and the choice of its colours."""

from __future__ import annotations

from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.colour_maps import MAPS
from widgets.header_tools import chooser
from widgets.map_and_strip import MapAndStrip
from widgets.panel import Panel
from widgets.probe_strip import ProbeStrip
from widgets.theme import Theme


class BeliefPanel(Panel):
    """``strip``: the probes as small maps, which follow the choice of the colour map."""

    def __init__(self, theme: Theme, title: str, strip: ProbeStrip | None = None) -> None:
        super().__init__(title)
        self.view, self.legend, self._strip = BeliefView(theme), BeliefLegend(theme), strip
        if strip is None:
            self.column.addWidget(self.view, 1)
            self.column.addWidget(self.legend)
        else:
            self.column.addWidget(MapAndStrip(self.view, self.legend, strip), 1)
        self.maps = chooser(list(MAPS), "Colour map of the belief")
        self.maps.currentIndexChanged.connect(self._choose)
        self.header.addWidget(self.maps)

    def _choose(self, index: int) -> None:
        for view in (self.view, self._strip):
            if view is not None:
                view.show_map(MAPS[index])

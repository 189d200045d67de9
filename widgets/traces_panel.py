"""Force and moment, one above the other, with the button that fits their ranges."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtWidgets import QWidget

from widgets.force_traces import TracePlot
from widgets.header_tools import tool
from widgets.panel import Panel


class TracesPanel(Panel):
    """``tools`` stand in the header before *Fit*."""

    def __init__(
        self, title: str, force: TracePlot, moment: TracePlot, tools: Sequence[QWidget] = ()
    ) -> None:
        super().__init__(title)
        self._plots = force, moment
        self.column.setSpacing(2)
        for plot in self._plots:
            self.column.addWidget(plot, 1)
        fit = tool("Fit", "Set both ranges to what is shown now (Ctrl+F)")
        fit.clicked.connect(self.fit)
        for widget in (*tools, fit):
            self.header.addWidget(widget)

    def fit(self) -> None:
        """Fit the ranges of both plots."""
        for plot in self._plots:
            plot.fit()

"""Page of the train workspace."""

from __future__ import annotations

from collections.abc import Iterator

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QSizePolicy

from touchdown.app.shell import WorkspacePage, column_of
from touchdown.widgets import base
from touchdown.widgets.forms import TrainingFormPanel
from touchdown.widgets.lists import FigureTable, TrainingTable
from touchdown.widgets.plots import CurvePlot, ReliabilityPlot, SampleStrip

FIGURES = "IoU / right, %"  # head of the figures per bottom: mean IoU, share of points right


class TrainPage(WorkspacePage):
    """Training runs on one dataset. The page is complete after ``build`` has finished."""

    runs_chosen = Signal(object)  # tuple of run identifiers

    def __init__(self, theme: base.Theme) -> None:
        super().__init__(theme)
        self.form = TrainingFormPanel(theme)

    def build(self) -> Iterator[None]:
        """Create the other widgets of the page, a few milliseconds per step."""
        theme = self._theme
        self.split = FigureTable(theme, "Episodes per bottom", ("bottom", "train", "held out"))
        self.leaks = base.ScrollingNote("What the split leaks")
        self.loss = CurvePlot(theme, "Loss per epoch (nats a point)")
        self.iou = CurvePlot(theme, "IoU per epoch (%)", percent=True)
        self.accuracy = CurvePlot(theme, "Points right per epoch (%)", percent=True)
        self.reliability = ReliabilityPlot(theme)
        self.samples = SampleStrip(theme)
        yield
        self.runs = TrainingTable(theme, self.runs_chosen.emit)
        self.differences = FigureTable(theme, "What differs", ("setting", "A"))
        self.figures = FigureTable(theme, "Figures per bottom", (FIGURES, "A"))
        self.split.empty = "No episode that counts yet"
        self.figures.empty = "Choose a finished training: its figures per bottom are shown here"
        self.differences.empty = "Choose up to three trainings (Ctrl+click): what differs"
        self.in_use, self.autonomy = base.label("", "", wrap=True), base.ScrollingNote("Next step")
        self.step = base.push_button("Train as advised", role="primary")
        self.promote = base.push_button("Promote")
        tip = "Use the previous model again (Ctrl+Shift+P)"
        self.roll_back = base.push_button("Roll back", tip)
        for button in (self.promote, self.roll_back):
            # Disabled until the model in use is known.
            button.setEnabled(False)
        yield
        self._arrange()

    def fit_to_theme(self) -> None:
        """Apply the sizes and icons of the theme."""
        self._left.least_px = round(20 * self.em)

    def show_busy(self, busy: bool) -> None:
        """Show that data are being read."""
        self.runs_panel.detail.setText(base.tr("reading \N{HORIZONTAL ELLIPSIS}" if busy else ""))

    def _arrange(self) -> None:
        self.split_panel = base.Panel("Split", self.split)
        held_out = base.label("Held out", "muted"), self.form.held_out
        base.add_items(self.split_panel.header, *held_out)
        base.add_items(self.split_panel.column, self.leaks, self.form.divide)
        self._left = column_of((self.form, 0), (self.split_panel, 1))
        # Its wrapped text can get more height than it needs.
        column = self._left.layout()
        assert column is not None
        column.setAlignment(self.form, Qt.AlignmentFlag.AlignTop)
        self.samples_panel = base.Panel("Held-out probes, true patch outlined")
        self.samples_panel.detail.setText(base.tr("yellow: contact"))
        tip = "Predicted probability of contact: blue 0, yellow 1"
        self.samples_panel.detail.setToolTip(base.tr(tip))
        self.samples_panel.column.addWidget(self.samples, 1)
        middle = column_of((self._curves(), 3), (self.samples_panel, 2))
        self.runs_panel = base.Panel("Trainings", self.runs)
        buttons = base.hbox((self.step, 1), (self.promote, 1), (self.roll_back, 1))
        self.runs_panel.column.insertWidget(1, self.in_use)
        base.add_items(self.runs_panel.column, self.autonomy, buttons)
        self.comparison = base.Panel("Comparison")
        # As high as its rows; the longer table below takes the rest.
        self.figures.setSizePolicy(QSizePolicy.Policy.Expanding, QSizePolicy.Policy.Preferred)
        base.add_items(self.comparison.column, self.figures, (self.differences, 1))
        right = column_of((self.runs_panel, 4), (self.comparison, 5))
        self.columns = base.Columns(
            ((self._left, 5), (middle, 9), (right, 8)),
            {
                "Split": self.split_panel,
                "Curves": self.curves_panel,
                "Held-out probes": self.samples_panel,
                "Trainings": self.runs_panel,
                "Comparison": self.comparison,
            },
        )
        self.fill(self.columns)
        self.fit_to_theme()

    def _curves(self) -> base.Panel:
        self.curves_panel = base.Panel("Curves")
        for pair in ((self.loss, self.reliability), (self.iou, self.accuracy)):
            line = base.hbox(*((plot, 1) for plot in pair), spacing=10)
            self.curves_panel.column.addLayout(line, 1)
        return self.curves_panel

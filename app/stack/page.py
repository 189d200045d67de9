"""Page of the stack workspace."""

from __future__ import annotations

from PySide6.QtCore import QEvent, Signal
from PySide6.QtWidgets import QSizePolicy, QVBoxLayout

from touchdown.app.shell import LivePage, column_of, limit_height
from touchdown.backend.core import FINGERS
from touchdown.widgets import views
from touchdown.widgets.base import Columns, Panel, Theme, flat_button, hbox, tr
from touchdown.widgets.forms import RunPanel
from touchdown.widgets.plots import TracesPanel

TRACES, SIDE = "Force and moment", "Bench from the side"  # SIDE: as recorded in layouts
BELIEF_PX, GAPS_PX = 140, 32  # least height of the map; gaps around and in a column


class StackPage(LivePage):
    """The views of one stacking run."""

    probe_chosen = Signal(int)

    def __init__(self, theme: Theme) -> None:
        super().__init__(theme)
        self.captions = {f: Panel(tr("Tactile {}", f[0].upper()), self.tactile[f]) for f in FINGERS}
        self.traces_panel = TracesPanel("Force and moment at the wrist", self.force, self.moment)
        self.decision = views.DecisionPanel()
        self.trial = views.TrialPanel(theme)
        self.strip = views.ProbeStrip(theme, self.probe_chosen.emit)
        self.belief_panel = views.BeliefPanel(theme, "Belief map", self.strip)
        self.belief, self.legend = self.belief_panel.view, self.belief_panel.legend
        self.belief.setMinimumHeight(BELIEF_PX)
        self.run = RunPanel(theme)
        self.score = views.ScorePanel(theme)
        self.add_piece = flat_button("Add piece", "Add a piece from a CAD file")
        self.run.header.addWidget(self.add_piece)
        self.bookmark = flat_button("Bookmark", "Note on this moment of the run (B)")
        self.traces_panel.header.addWidget(self.bookmark)
        self.compare = flat_button("Compare", "Compare the strategies on the same seed (Ctrl+D)")
        self.score.header.addWidget(self.compare)
        self.side = views.SideView(theme)
        self.side_panel = Panel("Bench to scale", self.side)
        self._arrange()

    def fit_to_theme(self) -> None:
        """Set the widths of the controls for the size of the text."""
        self._right.least_px = round(16.5 * self.em)

    def show_waiting(self, result: str, why: str) -> None:
        """Show why there are no data yet."""
        self.show_silent(why)
        self.decision.show_text(views.DecisionText(result, "", "", why))

    def show_trial(self, look: views.TrialPrompt | None) -> None:
        """Show a question to the operator; its picture replaces the belief map."""
        self.trial.show_look(look)
        if look is not None and look.yes:
            self.decision.show_text(views.DecisionText("Your turn", "", "", f"{tr(look.title)}."))
        pictured = look is not None and look.scene is not None
        high = QSizePolicy.Policy.Expanding if pictured else QSizePolicy.Policy.Fixed
        self.trial.setSizePolicy(QSizePolicy.Policy.Preferred, high)
        self.belief_panel.setVisible(not pictured and not self.columns.hides("Belief map"))

    def event(self, event: QEvent) -> bool:
        """Arrange the column again after form or score have become higher or lower."""
        if event.type() is QEvent.Type.LayoutRequest:
            self._leave_room()
        return super().event(event)

    def _leave_room(self) -> None:
        """Hide the side view where the controls need its room."""
        super()._leave_room()
        score_px = self.score.heightForWidth(self.score.width())
        least_px = sum(part.minimumSizeHint().height() for part in (self.run, self.side_panel))
        least_px += GAPS_PX + (0 if self.columns.hides("Trials") else score_px)
        room = self.seen_px >= least_px
        self.side_panel.setVisible(room and not self.columns.hides(SIDE))
        # Without the side view the trials fill the column.
        layout = self._right.layout()
        assert isinstance(layout, QVBoxLayout)
        fills = int(self.side_panel.isHidden())
        if layout.stretch(layout.indexOf(self.score)) != fills:  # it asks for a layout each time
            layout.setStretchFactor(self.score, fills)

    def _arrange(self) -> None:
        for panel in self.captions.values():
            limit_height(panel)
        fingers = hbox(*((panel, 1) for panel in self.captions.values()), spacing=8)
        feel = column_of((fingers, 0), (self.traces_panel, 1))
        believe = column_of((self.decision, 0), (self.trial, 1), (self.belief_panel, 2))
        self._right = column_of((self.run, 0), (self.score, 0), (self.side_panel, 1))
        left, right = self.captions.values()
        columns = (feel, 10), (believe, 9), (self._right, 5)
        panels = {
            "Tactile L": left, "Tactile R": right, TRACES: self.traces_panel,
            "Belief map": self.belief_panel, "Trials": self.score, SIDE: self.side_panel,
        }  # fmt: skip
        self.stand_in(Columns(columns, panels, controls_last=True), TRACES)
        self.fit_to_theme()

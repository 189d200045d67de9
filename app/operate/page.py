"""Page of the operate workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from PySide6.QtCore import Signal

from touchdown.app.shell import LivePage, column_of, limit_height
from touchdown.backend.core import FINGERS
from touchdown.widgets.base import (
    CaptionedView,
    Columns,
    Panel,
    compact_combo_box,
    flat_button,
    hbox,
)
from touchdown.widgets.forms import GripperPanel, JogPad, JogUnit, ProbePanel, ScenePanel
from touchdown.widgets.plots import SPANS_S, TracesPanel
from touchdown.widgets.views import LOOKS, BeliefPanel, SideView

TRACES, BENCH = "Force and moment", "Bench to scale"
LEAST_PX = 150, 133  # heights of belief map and bench, which all fit into 1280x720


class OperatePage(LivePage):
    """Live views on the left, belief and probe in the middle, manual control on the right.

    The page is complete after ``build`` has finished.
    """

    span_chosen = Signal(float)
    scene_chosen = Signal(str, str)

    def build(
        self, paces: Sequence[JogUnit], phases: Sequence[str], renew: Callable[[str], bool]
    ) -> Iterator[None]:
        """Create the widgets of the page, a few milliseconds per step."""
        theme = self._theme
        self.jog = JogPad(paces, renew)
        self.gripper = GripperPanel()
        self.probe = ProbePanel(theme, phases)
        self.scene = ScenePanel(self.scene_chosen.emit)
        yield
        self.captions = {f: CaptionedView(f.capitalize(), self.tactile[f]) for f in FINGERS}
        self.belief_panel = BeliefPanel(theme, "Contact patch")
        self.side = SideView(theme)
        self.side_panel = Panel(BENCH, self.side)
        self.belief, self.legend = self.belief_panel.view, self.belief_panel.legend
        self.maps = self.belief_panel.maps
        for view, least_px in zip((self.belief, self.side), LEAST_PX, strict=True):
            view.setMinimumHeight(least_px)
        self.looks = compact_combo_box([text for _, text in LOOKS], "What the tactile views show")
        self.baseline = flat_button("Baseline", "Take a new tactile reference, in air (B)")
        self.span = compact_combo_box([f"{span:.0f} s" for span in SPANS_S], "Length of the traces")
        self.zero = flat_button("Zero", "Zero force and moment here, in air (Z)")
        self.pause = flat_button("Pause", "Freeze the traces; recording continues", checkable=True)
        self.traces_panel = TracesPanel(
            TRACES, self.force, self.moment, (self.span, self.zero, self.pause)
        )
        self._arrange()
        self.span.currentIndexChanged.connect(lambda at: self.span_chosen.emit(SPANS_S[at]))
        self.looks.currentIndexChanged.connect(self._choose_look)

    def fit_to_theme(self) -> None:
        """Set the widths of the controls for the size of the text."""
        self._right.least_px = round(20.5 * self.em)

    def show_waiting(self, why: str) -> None:
        """Show why there are no live data yet."""
        self.show_silent(why)
        self.jog.show_ready(False, why)
        self.gripper.show_ready(False)
        self.scene.show_ready(False)
        self.probe.show_buttons(probe=False, cancel=False, why=why)

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        self.tactile_panel = self._tactile_panel()
        feel = column_of((self.tactile_panel, 0), (self.traces_panel, 1))
        middle = column_of((self.belief_panel, 5), (self.side_panel, 4), (self.probe, 0))
        self._right = column_of((self.jog, 1), (self.gripper, 0), (self.scene, 0))
        columns = (feel, 10), (middle, 7), (self._right, 6)
        panels = {
            "Tactile": self.tactile_panel, TRACES: self.traces_panel, "Belief": self.belief_panel,
            BENCH: self.side_panel, "Probe": self.probe, "Jog": self.jog, "Gripper": self.gripper,
        }  # fmt: skip
        self.stand_in(Columns(columns, panels, controls_last=True), TRACES)
        self.fit_to_theme()

    def _tactile_panel(self) -> Panel:
        panel = Panel("Tactile")
        limit_height(panel)
        panel.header.addWidget(self.looks)
        panel.header.addWidget(self.baseline)
        fingers = ((caption, 1) for caption in self.captions.values())
        panel.column.addLayout(hbox(*fingers, spacing=18))
        return panel

    def _choose_look(self, index: int) -> None:
        for view in self.tactile.values():
            view.show_look(LOOKS[index][0])

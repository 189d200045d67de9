"""Page of the operate workspace."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from PySide6.QtGui import QFontMetrics
from PySide6.QtWidgets import QHBoxLayout

from touchdown.app.shell import LivePage, column_of, limit_height
from touchdown.backend.core import FINGERS
from touchdown.widgets.base import (
    CaptionedView,
    Columns,
    Panel,
    Theme,
    compact_combo_box,
    flat_button,
    ui_font,
)
from touchdown.widgets.forms import (
    GripperPanel,
    JogIntents,
    JogPad,
    JogUnit,
    ProbePanel,
    ScenePanel,
)
from touchdown.widgets.plots import SPANS_S, TracesPanel
from touchdown.widgets.views import LOOKS, BeliefPanel

TRACES = "Force and moment"


@dataclass(frozen=True, slots=True)
class OperateIntents:
    """What the operator can ask for on this page."""

    jog: JogIntents
    grip: Callable[[], None]
    open: Callable[[], None]
    probe: Callable[[], None]
    cancel: Callable[[], None]
    zero: Callable[[], None]
    baseline: Callable[[], None]
    span: Callable[[float], None]
    pause: Callable[[bool], None]
    set_scene: Callable[[str, str], None]


class OperatePage(LivePage):
    """Live views on the left, belief and probe in the middle, the hand on the right.

    It is whole only once ``build`` has come to its end.
    """

    def __init__(self, theme: Theme, intents: OperateIntents) -> None:
        super().__init__(theme)
        self._intents = intents

    def build(self, paces: Sequence[JogUnit], phases: Sequence[str]) -> Iterator[None]:
        """Make what stands on the page, in pieces of some ms."""
        theme, intents = self._theme, self._intents
        self.jog = JogPad(paces, intents.jog)
        self.gripper = GripperPanel(intents.grip, intents.open)
        self.probe = ProbePanel(theme, phases, intents.probe, intents.cancel)
        self.scene = ScenePanel(intents.set_scene)
        yield
        titles = {"left": "Left", "right": "Right"}
        self.captions = {f: CaptionedView(titles[f], self.tactile[f]) for f in FINGERS}
        self.belief_panel = BeliefPanel(theme, "Belief of the last run")
        self.belief, self.legend = self.belief_panel.view, self.belief_panel.legend
        self.maps = self.belief_panel.maps
        self.looks = compact_combo_box([text for _, text in LOOKS], "What the tactile views show")
        self.baseline = flat_button("Baseline", "Take the tactile reference anew, in air (B)")
        self.span = compact_combo_box([f"{span:.0f} s" for span in SPANS_S], "Length of the traces")
        self.zero = flat_button("Zero", "Zero force and moment here, in air (Z)")
        self.pause = flat_button(
            "Pause", "Hold the traces still; recording goes on", checkable=True
        )
        self.traces_panel = TracesPanel(
            TRACES, self.force, self.moment, (self.span, self.zero, self.pause)
        )
        self.fit = self.traces_panel.fit
        self._arrange()
        self._wire()

    def fit_to_theme(self) -> None:
        """Give the controls the width that their text needs."""
        em = QFontMetrics(ui_font(self._theme.scale)).height()
        self._right.setMinimumWidth(round(20.5 * em))

    def show_waiting(self, why: str) -> None:
        """Say why nothing is shown yet."""
        self.show_silent(why)
        self.jog.show_ready(False, why)
        self.gripper.show_ready(False)
        self.scene.show_ready(False)
        self.probe.show_buttons(probe=False, cancel=False, why=why)

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        self.tactile_panel = self._tactile_panel()
        feel = column_of((self.tactile_panel, 0), (self.traces_panel, 1))
        middle = column_of((self.belief_panel, 1), (self.probe, 0))
        self._right = column_of((self.jog, 1), (self.gripper, 0), (self.scene, 0))
        self.stand_in(
            Columns(
                ((feel, 10), (middle, 7), (self._right, 6)),
                {
                    "Tactile": self.tactile_panel,
                    TRACES: self.traces_panel,
                    "Belief": self.belief_panel,
                    "Probe": self.probe,
                    "Jog": self.jog,
                    "Gripper": self.gripper,
                },
                controls_last=True,
            ),
            TRACES,
        )
        self.fit_to_theme()

    def _tactile_panel(self) -> Panel:
        panel = Panel("Tactile")
        limit_height(panel)
        panel.header.addWidget(self.looks)
        panel.header.addWidget(self.baseline)
        fingers = QHBoxLayout()
        fingers.setSpacing(18)
        for caption in self.captions.values():
            fingers.addWidget(caption, 1)
        panel.column.addLayout(fingers)
        return panel

    def _wire(self) -> None:
        self.zero.clicked.connect(self._intents.zero)
        self.baseline.clicked.connect(self._intents.baseline)
        self.pause.toggled.connect(self._intents.pause)
        self.span.currentIndexChanged.connect(self._choose_span)
        self.looks.currentIndexChanged.connect(self._choose_look)

    def _choose_span(self, index: int) -> None:
        self._intents.span(SPANS_S[index])

    def _choose_look(self, index: int) -> None:
        for view in self.tactile.values():
            view.show_look(LOOKS[index][0])

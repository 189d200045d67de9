"""Where everything of the Operate workspace stands: feel, believe and probe, move by hand."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from PySide6.QtGui import QFontMetrics, QResizeEvent
from PySide6.QtWidgets import QComboBox, QHBoxLayout, QToolButton, QVBoxLayout, QWidget

from backend.core.flow import FINGERS, Finger
from widgets.belief_legend import BeliefLegend
from widgets.belief_view import BeliefView
from widgets.colour_maps import MAPS
from widgets.force_traces import SPANS_S, TracePlot
from widgets.freshness import Age
from widgets.gripper_panel import GripperPanel
from widgets.jog_pad import JogPad
from widgets.panel import Captioned, Panel
from widgets.probe_panel import ProbePanel
from widgets.scene_panel import ScenePanel
from widgets.tactile_view import LOOKS, TactileView
from widgets.theme import Theme, ui_font

TACTILE_SHARE = 0.45


@dataclass(frozen=True, slots=True)
class OperateIntents:
    """What the operator can ask for on this page."""

    renew: Callable[[str], bool]
    ended: Callable[[str], None]
    step: Callable[[str], None]
    arm_keys: Callable[[bool], None]
    grip: Callable[[], None]
    open: Callable[[], None]
    probe: Callable[[], None]
    cancel: Callable[[], None]
    zero: Callable[[], None]
    baseline: Callable[[], None]
    span: Callable[[float], None]
    pause: Callable[[bool], None]
    set_scene: Callable[[str, str], None]


class OperatePage(QWidget):
    """Live views on the left, belief and probe in the middle, the hand on the right."""

    def __init__(
        self,
        theme: Theme,
        intents: OperateIntents,
        steps_mm: Sequence[float],
        phases: Sequence[str],
    ) -> None:
        super().__init__()
        self.setObjectName("frame")
        self._theme, self._intents = theme, intents
        titles = {"left": "Left", "right": "Right"}
        self.tactile: dict[Finger, TactileView] = {f: TactileView(theme, f) for f in FINGERS}
        self.captions = {f: Captioned(titles[f], self.tactile[f]) for f in FINGERS}
        self.force = TracePlot(theme, "Force", "F", "N", 10.0)
        self.moment = TracePlot(theme, "Moment", "T", "N\N{MIDDLE DOT}m", 0.2)
        self.belief = BeliefView(theme)
        self.legend = BeliefLegend(theme)
        self.belief_panel = Panel("Belief of the last run", self.belief)
        self.belief_panel.column.addWidget(self.legend)
        self.jog = JogPad(steps_mm, intents.renew, intents.ended, intents.step, intents.arm_keys)
        self.gripper = GripperPanel(intents.grip, intents.open)
        self.probe = ProbePanel(theme, phases, intents.probe, intents.cancel)
        self.scene = ScenePanel(intents.set_scene)
        self.looks = _chooser([text for _, text in LOOKS], "What the tactile views show")
        self.maps = _chooser(list(MAPS), "Colour map of the belief")
        self.span = _chooser([f"{span:.0f} s" for span in SPANS_S], "Length of the traces")
        self.pause = _tool("Pause", "Hold the traces still; recording goes on", checkable=True)
        self._arrange()
        self._wire()

    def fit(self) -> None:
        """Fit the ranges of both plots."""
        self.force.fit()
        self.moment.fit()

    def fit_to_theme(self) -> None:
        """Give the controls the width that their text needs."""
        em = QFontMetrics(ui_font(self._theme.scale)).height()
        self._right.setMinimumWidth(round(20.5 * em))

    def show_waiting(self, why: str) -> None:
        """Say why nothing is shown yet."""
        for view in self.tactile.values():
            view.show_age(Age.NEVER, 0.0, why)
        for plot in (self.force, self.moment):
            plot.show_age(Age.NEVER, 0.0, why)
        self.jog.show_ready(False, why)
        self.gripper.show_ready(False)
        self.scene.show_ready(False)
        self.probe.show_buttons(probe=False, cancel=False, why=why)

    def heightForWidth(self, _width: int) -> int:
        """Ask for no more than the least height: the views share what there is."""
        return self.minimumHeight()

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Leave room for the traces."""
        super().resizeEvent(event)
        for view in self.tactile.values():
            view.limit_height(round(TACTILE_SHARE * self.height()))

    # -- inside -----------------------------------------------------------------------------------

    def _arrange(self) -> None:
        self.belief_panel.header.addWidget(self.maps)
        feel, middle, right = QVBoxLayout(), QVBoxLayout(), QVBoxLayout()
        for column in (feel, middle, right):
            column.setSpacing(8)
        feel.addWidget(self._tactile_panel())
        feel.addWidget(self._traces_panel(), 1)
        middle.addWidget(self.belief_panel, 1)
        middle.addWidget(self.probe)
        right.addWidget(self.jog, 1)
        right.addWidget(self.gripper)
        right.addWidget(self.scene)
        right.setContentsMargins(0, 0, 0, 0)
        self._right = QWidget()
        self._right.setLayout(right)
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 8, 10, 8)
        row.setSpacing(8)
        row.addLayout(feel, 10)
        row.addLayout(middle, 7)
        row.addWidget(self._right, 6)
        self.fit_to_theme()

    def _tactile_panel(self) -> Panel:
        panel = Panel("Tactile")
        self.baseline = _tool("Baseline", "Take the tactile reference anew, in air (B)")
        panel.header.addWidget(self.looks)
        panel.header.addWidget(self.baseline)
        fingers = QHBoxLayout()
        fingers.setSpacing(18)
        for caption in self.captions.values():
            fingers.addWidget(caption, 1)
        panel.column.addLayout(fingers)
        return panel

    def _traces_panel(self) -> Panel:
        panel = Panel("Force and moment")
        panel.column.setSpacing(2)
        panel.column.addWidget(self.force, 1)
        panel.column.addWidget(self.moment, 1)
        self.zero = _tool("Zero", "Zero force and moment here, in air (Z)")
        fit = _tool("Fit", "Set both ranges to what is shown now (Ctrl+F)")
        fit.clicked.connect(self.fit)
        for widget in (self.span, self.zero, self.pause, fit):
            panel.header.addWidget(widget)
        return panel

    def _wire(self) -> None:
        self.zero.clicked.connect(self._intents.zero)
        self.baseline.clicked.connect(self._intents.baseline)
        self.pause.toggled.connect(self._intents.pause)
        self.span.currentIndexChanged.connect(self._choose_span)
        self.looks.currentIndexChanged.connect(self._choose_look)
        self.maps.currentIndexChanged.connect(self._choose_map)

    def _choose_span(self, index: int) -> None:
        self._intents.span(SPANS_S[index])

    def _choose_look(self, index: int) -> None:
        for view in self.tactile.values():
            view.show_look(LOOKS[index][0])

    def _choose_map(self, index: int) -> None:
        self.belief.show_map(MAPS[index])


def _chooser(texts: Sequence[str], name: str) -> QComboBox:
    made = QComboBox()
    made.addItems(list(texts))
    made.setProperty("role", "compact")
    made.setAccessibleName(name)
    made.setToolTip(name)
    return made


def _tool(text: str, tip: str, *, checkable: bool = False) -> QToolButton:
    made = QToolButton()
    made.setText(text)
    made.setProperty("role", "plain")
    made.setToolTip(tip)
    made.setAccessibleName(tip)
    made.setCheckable(checkable)
    return made

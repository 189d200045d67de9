"""How far a press goes and how fast: steps and speed of a jog, in mm or in degrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from PySide6.QtCore import QSignalBlocker, Qt
from PySide6.QtWidgets import (
    QButtonGroup,
    QDoubleSpinBox,
    QHBoxLayout,
    QPushButton,
    QSlider,
    QVBoxLayout,
    QWidget,
)

from widgets.number_inset import inset
from widgets.panel import label


@dataclass(frozen=True, slots=True)
class Pace:
    """Unit of a way, its steps, and slowest, fastest and usual speed in that unit per second."""

    unit: str
    spoken: str
    steps: tuple[float, ...]
    speeds: tuple[float, float, float]


class JogPace(QWidget):
    """Hold-to-run or one of the steps, and the speed. Each pace keeps its own speed."""

    def __init__(self, paces: Sequence[Pace]) -> None:
        """``paces``: the first is shown; the steps of the others are among its own."""
        super().__init__()
        self._paces = tuple(paces)
        self._pace = self._paces[0]
        self._kept = {pace.unit: pace.speeds[2] for pace in self._paces}
        self.steps = self._step_buttons()
        self._unit = label(self._pace.unit, "muted")
        self.speed, self._slider = QDoubleSpinBox(), QSlider(Qt.Orientation.Horizontal)
        self._wire_speed()
        self._arrange()
        self.show_pace(0)

    @property
    def step(self) -> float | None:
        """The chosen step in the present unit, None while pads are held."""
        at = self._chosen()
        return None if at == 0 else float(self.steps[at].text())

    def show_pace(self, at: int) -> None:
        """Show steps and speed of another pace."""
        pace = self._pace = self._paces[at]
        for button, step in zip(self.steps[1:], self._paces[0].steps, strict=True):
            button.setVisible(step in pace.steps)
            button.setAccessibleName(f"Step of {button.text()} {pace.spoken}")
            button.setToolTip(f"{button.accessibleName()} ([ and ])")
        if self.steps[self._chosen()].isHidden():
            self.next_step(1)
        self._unit.setText(pace.unit)
        slowest, fastest, _ = pace.speeds
        with QSignalBlocker(self.speed), QSignalBlocker(self._slider):
            self.speed.setRange(slowest, fastest)
            self.speed.setSuffix(f" {pace.unit}/s")
            self._slider.setRange(int(slowest), int(fastest))
            self.speed.setValue(self._kept[pace.unit])
            self._slider.setValue(round(self._kept[pace.unit]))

    def next_step(self, by: int) -> None:
        """Choose the next longer or shorter step; before the shortest is hold-to-run."""
        at = self._chosen() + by
        while 0 < at < len(self.steps) - 1 and self.steps[at].isHidden():
            at += by
        self.steps[min(max(at, 0), len(self.steps) - 1)].setChecked(True)

    # -- inside -----------------------------------------------------------------------------------

    def _chosen(self) -> int:
        return next((i for i, button in enumerate(self.steps) if button.isChecked()), 0)

    def _step_buttons(self) -> list[QPushButton]:
        group, made = QButtonGroup(self), []
        for text in ("Hold", *(f"{step:g}" for step in self._paces[0].steps)):
            button = QPushButton(text)
            button.setProperty("role", "choice")
            button.setCheckable(True)
            group.addButton(button)
            made.append(button)
        made[0].setChecked(True)
        made[0].setAccessibleName("Hold to run")
        made[0].setToolTip("Hold to run ([ and ])")
        return made

    def _wire_speed(self) -> None:
        self.speed.setDecimals(0)
        inset(self.speed)
        for widget in (self.speed, self._slider):
            widget.setAccessibleName("Jog speed")
            widget.setToolTip("Near the surface and in contact it is 2 mm/s at most")
        self.speed.valueChanged.connect(self._follow_spin)
        self._slider.valueChanged.connect(self._follow_slider)

    def _follow_spin(self, value: float) -> None:
        self._kept[self._pace.unit] = value
        self._slider.setValue(round(value))

    def _follow_slider(self, value: int) -> None:
        self.speed.setValue(value)

    def _arrange(self) -> None:
        steps, speed = QHBoxLayout(), QHBoxLayout()
        steps.setSpacing(4)
        for button in self.steps:
            steps.addWidget(button, 1)
        steps.addWidget(self._unit)
        buddy = label("Speed", "muted")
        buddy.setBuddy(self.speed)
        speed.addWidget(buddy)
        speed.addWidget(self._slider, 1)
        speed.addWidget(self.speed)
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(6)
        column.addLayout(steps)
        column.addLayout(speed)

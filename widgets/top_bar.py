"""State, modes, devices and STOP: never hidden, floated or covered."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QColor, QResizeEvent
from PySide6.QtWidgets import (
    QFrame,
    QHBoxLayout,
    QPushButton,
    QSizePolicy,
    QSpinBox,
    QVBoxLayout,
    QWidget,
)

from widgets.device_chip import DeviceChip
from widgets.icons import fit_icon, icon
from widgets.panel import label
from widgets.servo_button import ServoButton
from widgets.state_pill import StatePill
from widgets.theme import Theme

MARGIN, GAP, CHIP_GAP = 8, 8, 4
OVERRIDE_PAD_PX = 20
"""Frame and padding of the override beside its figures."""
OVERRIDE = (10, 100)
"""Percent, least and most."""
USUAL_MODE = "Robot: Program"
CHIPS = (
    ("arm", "Arm"),
    ("gripper", "Gripper"),
    ("force_torque", "F/T"),
    ("tactile_left", "Tactile L"),
    ("tactile_right", "Tactile R"),
)


class TopBar(QFrame):
    """One row, or two where there is little room; ``on_stop`` is called on the press."""

    def __init__(self, theme: Theme, on_stop: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "bar")
        self.pill = StatePill(theme)
        self._robot = label("Robot: unknown", "small")
        self._safety = label("Safety: unknown", "small")
        self.chips = {key: DeviceChip(theme, name) for key, name in CHIPS}
        self.override = QSpinBox()
        self.override.setRange(*OVERRIDE)
        self.override.setValue(OVERRIDE[1])
        self.override.setSingleStep(10)
        self.override.setSuffix(" %")
        self.override.setKeyboardTracking(False)
        self.override.setAccessibleName("Speed override")
        self.override.setToolTip(
            "OVRD: share of the speed of every move in air, by hand and in runs. "
            "A press keeps its own speed."
        )
        self.override.setProperty("role", "compact")
        self._override_title = label("OVRD", "small")
        self._override_title.setBuddy(self.override)
        self.servo = ServoButton()
        self._servo_title = label("Servo", "small")
        self._servo_title.setBuddy(self.servo)
        self._estop_title = label("HW E-stop", "small")
        self._estop = label("unknown", "small")
        self.stop = QPushButton("STOP motion (software)")
        self.stop.setProperty("role", "stop")
        self.stop.setIcon(icon("stop", QColor("#FFFFFF")))
        self.stop.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.stop.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Preferred)
        self.stop.setAccessibleName("STOP motion, software stop")
        self.stop.setToolTip(
            "Stops arm and gripper at once and ends the run; the grip is kept. F12 anywhere, "
            "Space while something moves. This is not the robot's emergency stop."
        )
        self.stop.pressed.connect(on_stop)
        self._least_px = 0
        self._arrange()

    def _arrange(self) -> None:
        column = QVBoxLayout(self)
        column.setContentsMargins(MARGIN, 7, MARGIN, 7)
        column.setSpacing(6)
        row = self._row = QHBoxLayout()
        row.setSpacing(GAP)
        row.addWidget(self.pill)
        row.addLayout(_two(self._robot, self._safety))
        row.addStretch(1)
        row.addLayout(_two(self._estop_title, self._estop))
        row.addWidget(self.stop)
        column.addLayout(row)
        self._devices = QWidget()
        chips = QHBoxLayout(self._devices)
        chips.setContentsMargins(0, 0, 0, 0)
        chips.setSpacing(CHIP_GAP)
        for chip in self.chips.values():
            chips.addWidget(chip)
        chips.addSpacing(GAP - CHIP_GAP)
        chips.addLayout(_two(self._override_title, self.override))
        chips.addSpacing(GAP - CHIP_GAP)
        chips.addLayout(_two(self._servo_title, self.servo))
        row.insertWidget(2, self._devices)
        self._second = QHBoxLayout()
        column.addLayout(self._second)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def minimumSizeHint(self) -> QSize:
        """Return the width without the chips: those go to a second row where there is no room."""
        return QSize(self._least_px, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Show as much of the chips as there is room for."""
        super().resizeEvent(event)
        self.fit()

    def fit(self) -> None:
        """Whole chips, else names only, else whole chips on a row of their own."""
        chips, room = tuple(self.chips.values()), self.width()
        fit_icon(self.stop)
        # Room for the usual words, so that the chips do not jump when the arm starts.
        self._robot.setMinimumWidth(self._robot.fontMetrics().horizontalAdvance(USUAL_MODE))
        figures = self.override.fontMetrics().horizontalAdvance("100 %")
        self.override.setFixedWidth(figures + OVERRIDE_PAD_PX)
        for short in (False, True):
            for chip in chips:
                chip.show_short(short)
            one_row = self._needed(chips) <= room
            if one_row:
                break
        else:
            for chip in chips:
                chip.show_short(False)
        if one_row and self._second.count():
            self._second.removeWidget(self._devices)
            self._second.takeAt(0)
            self._row.insertWidget(2, self._devices)
        elif not one_row and not self._second.count():
            self._row.removeWidget(self._devices)
            self._second.addWidget(self._devices)
            self._second.addStretch(1)
        self._least_px = self._needed(())
        self.updateGeometry()

    def _needed(self, chips: tuple[DeviceChip, ...]) -> int:
        modes = max(self._robot.sizeHint().width(), self._safety.sizeHint().width())
        estop = max(self._estop_title.sizeHint().width(), self._estop.sizeHint().width())
        fixed = self.pill.sizeHint().width() + modes + estop + self.stop.sizeHint().width()
        if chips:
            override = (self._override_title.sizeHint().width(), self.override.width())
            fixed += GAP + max(override)
            fixed += GAP + max(self._servo_title.sizeHint().width(), self.servo.sizeHint().width())
        return fixed + sum(c.sizeHint().width() + CHIP_GAP for c in chips) + 5 * GAP + 2 * MARGIN

    def show_modes(self, robot: str, safety: str) -> None:
        """Show both status words of the arm."""
        texts = (f"Robot: {robot}", f"Safety: {safety}")
        if texts != (self._robot.text(), self._safety.text()):
            self._robot.setText(texts[0])
            self._safety.setText(texts[1])
            self.fit()

    def show_hardware_stop(self, text: str) -> None:
        """Show what the controller says of the hardware emergency stop; unknown is unknown."""
        if text == self._estop.text():
            return
        self._estop.setText(text)
        self._estop.setAccessibleName(f"Hardware emergency stop: {text}")
        self.fit()


def _two(upper: QWidget, lower: QWidget) -> QVBoxLayout:
    column = QVBoxLayout()
    column.setSpacing(0)
    column.addStretch(1)
    column.addWidget(upper)
    column.addWidget(lower)
    column.addStretch(1)
    return column

"""State, modes, devices and STOP: never hidden, floated or covered."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QSize, Qt
from PySide6.QtGui import QColor
from PySide6.QtWidgets import QFrame, QHBoxLayout, QPushButton, QSizePolicy, QVBoxLayout

from widgets.device_chip import DeviceChip
from widgets.icons import icon
from widgets.panel import label
from widgets.state_pill import StatePill
from widgets.theme import Theme

CHIPS = (
    ("arm", "Arm"),
    ("gripper", "Gripper"),
    ("force_torque", "F/T"),
    ("tactile_left", "Tactile L"),
    ("tactile_right", "Tactile R"),
)


class TopBar(QFrame):
    """One row of 52 px. ``on_stop`` is called on the press, not on the release."""

    def __init__(self, theme: Theme, on_stop: Callable[[], None]) -> None:
        super().__init__()
        self.setProperty("role", "bar")
        self.pill = StatePill(theme)
        self._robot = label("Robot: unknown", "small")
        self._safety = label("Safety: unknown", "small")
        self.chips = {key: DeviceChip(theme, name) for key, name in CHIPS}
        self._estop = label("unknown", "small")
        self.stop = QPushButton("STOP motion (software)")
        self.stop.setProperty("role", "stop")
        self.stop.setIcon(icon("stop", QColor("#FFFFFF")))
        self.stop.setIconSize(QSize(16, 16))
        self.stop.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.stop.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Preferred)
        self.stop.setAccessibleName("STOP motion, software stop")
        self.stop.setToolTip(
            "Stops arm and gripper at once and ends the run; the grip is kept. F12 anywhere, "
            "Space while something moves. This is not the robot's emergency stop."
        )
        self.stop.pressed.connect(on_stop)
        self._arrange()

    def _arrange(self) -> None:
        row = QHBoxLayout(self)
        row.setContentsMargins(10, 7, 10, 7)
        row.setSpacing(10)
        row.addWidget(self.pill)
        row.addLayout(_two(self._robot, self._safety))
        chips = QHBoxLayout()
        chips.setSpacing(6)
        for chip in self.chips.values():
            chips.addWidget(chip)
        row.addLayout(chips)
        row.addStretch(1)
        title = label("HW E-stop", "small")
        row.addLayout(_two(title, self._estop))
        row.addWidget(self.stop)
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)

    def show_modes(self, robot: str, safety: str) -> None:
        """Show both status words of the arm."""
        self._robot.setText(f"Robot: {robot}")
        self._safety.setText(f"Safety: {safety}")

    def show_hardware_stop(self, text: str) -> None:
        """Show what the controller says of the hardware emergency stop; unknown is unknown."""
        self._estop.setText(text)
        self._estop.setAccessibleName(f"Hardware emergency stop: {text}")


def _two(upper: QFrame, lower: QFrame) -> QVBoxLayout:
    column = QVBoxLayout()
    column.setSpacing(0)
    column.addStretch(1)
    column.addWidget(upper)
    column.addWidget(lower)
    column.addStretch(1)
    return column

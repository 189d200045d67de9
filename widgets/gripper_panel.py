"""The gripper: width, force, state in words; grip and open."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtWidgets import QDoubleSpinBox, QHBoxLayout, QPushButton

from widgets.number_inset import inset
from widgets.panel import Panel, label

USUAL_N, LEAST_N, MOST_N = 10.0, 1.0, 40.0


class GripperPanel(Panel):
    """Shows what the gripper says; asks for grip and open."""

    def __init__(self, on_grip: Callable[[], None], on_open: Callable[[], None]) -> None:
        super().__init__("Gripper")
        self.figures = label("No data yet")
        self.force = QDoubleSpinBox()
        self.force.setRange(LEAST_N, MOST_N)
        self.force.setDecimals(1)
        self.force.setValue(USUAL_N)
        self.force.setSuffix(" N")
        inset(self.force)
        self.force.setAccessibleName("Grip force per finger")
        self.force.setToolTip("Force per finger for the next grip")
        self.grip, self.open = QPushButton("Grip"), QPushButton("Open")
        for button, tip, slot in (
            (self.grip, "Close on the piece with this force (G)", on_grip),
            (self.open, "Open the jaws; asks first while a piece is held (Shift+G)", on_open),
        ):
            button.setAccessibleName(f"{button.text()} the gripper")
            button.setToolTip(tip)
            button.clicked.connect(slot)
        row = QHBoxLayout()
        buddy = label("Force", "muted")
        buddy.setBuddy(self.force)
        row.addWidget(buddy)
        row.addWidget(self.force, 1)
        row.addWidget(self.grip, 1)
        row.addWidget(self.open, 1)
        self.column.addWidget(self.figures)
        self.column.addLayout(row)

    def show_status(self, width_mm: float, force_n: float, *, holding: bool, moving: bool) -> None:
        """Show width, force per finger and the state."""
        word = "moving" if moving else "holding a piece" if holding else "empty"
        text = f"{width_mm:.1f} mm   {force_n:.1f} N   {word}"
        if text != self.figures.text():
            self.figures.setText(text)

    def show_ready(self, ready: bool) -> None:
        """Switch the buttons."""
        for button in (self.grip, self.open):
            if button.isEnabled() != ready:
                button.setEnabled(ready)

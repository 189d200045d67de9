"""Switches the motors: off at a press, on only after it was held for a second."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QPushButton

HELD_MS = 1000
ON_TIP = "The motors are on. A press switches them off: whatever moves ends."
OFF_TIP = "The motors are off. Hold for 1 s to switch them on."


class ServoButton(QPushButton):
    """``ordered`` is called with what is wanted."""

    def __init__(self) -> None:
        super().__init__("\N{EN DASH}")
        self.setProperty("role", "compact")
        self.ordered: Callable[[bool], None] = _nothing
        self._on: bool | None = None
        self._held = QTimer(self)
        self._held.setSingleShot(True)
        self._held.setInterval(HELD_MS)
        self._held.timeout.connect(self._switch_on)
        self.pressed.connect(self._press)
        self.released.connect(self._held.stop)
        self.show_state(None)
        self.setAccessibleName("Servo: unknown")

    def show_state(self, on: bool | None, *, busy: bool = False) -> None:
        """Show on, off, or that nobody knows."""
        word = "\N{EN DASH}" if on is None else "..." if busy else "on" if on else "off"
        self._on = on
        if self.text() != word or self.isEnabled() == (on is None or busy):
            self.setText(word)
            self.setEnabled(on is not None and not busy)
            self.setToolTip("" if on is None else ON_TIP if on else OFF_TIP)
            self.setAccessibleName(f"Servo: {'unknown' if on is None else word}")
            self.setAccessibleDescription(self.toolTip())

    def _press(self) -> None:
        if self._on:
            self.ordered(False)
        else:
            self._held.start()

    def _switch_on(self) -> None:
        if self.isDown() and self._on is False:
            self.ordered(True)


def _nothing(_on: bool) -> None:
    """Nobody listens yet."""

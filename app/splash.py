"""Splash of the start. Imports nothing slow."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QPixmap
from PySide6.QtWidgets import QApplication, QSplashScreen

WIDTH, HEIGHT = 420, 140
GROUND, TEXT = "#1B2026", "#FFFFFF"


class Splash(QSplashScreen):
    """Small window that says what the start is doing."""

    def __init__(self) -> None:
        ground = QPixmap(WIDTH, HEIGHT)
        ground.fill(QColor(GROUND))
        super().__init__(ground)
        self.setAccessibleName("Touchdown is starting")

    def tell(self, what: str) -> None:
        """Show what is going on, at once."""
        self.show()
        self.showMessage(f"Touchdown\n\n{what} \N{HORIZONTAL ELLIPSIS}",
                         Qt.AlignmentFlag.AlignCenter.value, QColor(TEXT))  # fmt: skip
        QApplication.processEvents()

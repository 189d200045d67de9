"""Splash of the start. Imports nothing slow."""

from __future__ import annotations

from PySide6.QtCore import QDeadlineTimer, QEvent, Qt
from PySide6.QtGui import QColor, QPixmap
from PySide6.QtWidgets import QApplication, QSplashScreen, QWidget

WIDTH, HEIGHT = 420, 140
EXPOSED_MS = 300  # longest wait for the window system to show the splash
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
        limit = QDeadlineTimer(EXPOSED_MS)
        while not (self.windowHandle().isExposed() or limit.hasExpired()):
            QApplication.processEvents()
        QApplication.processEvents()

    def event(self, event: QEvent) -> bool:
        """Leave out the wait of QSplashScreen, always 1 s: it is mapped after its show event."""
        shown = event.type() == QEvent.Type.Show
        return QWidget.event(self, event) if shown else super().event(event)

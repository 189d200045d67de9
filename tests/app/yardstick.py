"""How slow this computer is now, beside the one for which 50 ms were promised.

Processor time does not count what else goes on, but a slower processor, or one whose caches others
use, needs more of it for the same work. So a promise in processor time is held against known work
of the same kind, done beside what is measured: making and laying out widgets, and plain Python.
"""

from __future__ import annotations

import time

from PySide6.QtWidgets import QGridLayout, QLabel, QPushButton, QWidget

ROWS, STEPS = 30, 20_000
USUAL_S = 0.0055  # of the work below, on the computer of docs/measured.md with nothing else running


class Yardstick:
    """Known work of the window's thread, measured now and again beside what is to be judged."""

    def __init__(self) -> None:
        self.best_s = float("inf")

    def measure(self, times: int = 1) -> None:
        """Do the work so often, on the thread of the window."""
        for _ in range(times):
            begun_s = time.thread_time()
            widget = _form()
            _count()
            self.best_s = min(self.best_s, time.thread_time() - begun_s)
            widget.deleteLater()

    def allowed_s(self, promised_s: float) -> float:
        """Return ``promised_s``, and more of it on a computer that is slower than the usual one.

        The best of all measurements counts: a moment in which others took the caches excuses
        nothing. A quicker computer is held to the promise itself.
        """
        return promised_s * max(1.0, self.best_s / USUAL_S)


def _form() -> QWidget:
    widget = QWidget()
    grid = QGridLayout(widget)
    for row in range(ROWS):
        grid.addWidget(QLabel(f"row {row}"), row, 0)
        grid.addWidget(QPushButton(f"button {row}"), row, 1)
    widget.ensurePolished()
    grid.activate()
    return widget


def _count() -> int:
    found: dict[int, int] = {}
    for step in range(STEPS):
        found[step % 997] = found.get(step % 997, 0) + 3 * step
    return len(found)

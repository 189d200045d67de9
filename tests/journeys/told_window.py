"""Child of the day by real keys: the window as its command opens it, on a bench that can hurry.

A line on standard input is answered by one on standard output, in JSON: ``look`` tells where every
control is on the screen and what it says; after ``hurry`` the bench takes the same course as fast
as it computes, after ``real`` in real time again. Nothing can be pressed from here.
"""

import json
import sys

from PySide6.QtCore import QPoint, QSocketNotifier
from PySide6.QtWidgets import (
    QAbstractButton,
    QAbstractSpinBox,
    QApplication,
    QLabel,
    QLineEdit,
    QProgressBar,
    QWidget,
)

from tests.backend.bench.brisk import brisk_method
from touchdown.app import start
from touchdown.app.__main__ import main as command_line

SPEED = {"look": None, "real": 1.0, "hurry": 1000.0}
INSIDE_PX = 12
SPEAKING = QProgressBar | QAbstractButton | QAbstractSpinBox | QLabel | QLineEdit


live_bench = start.open_simulated_bench


class Told:
    """Answers for the window."""

    def __init__(self):
        self.session = None

    def bench(self, settings=None, disturbances=()):
        """Build the bench as the window does; free moves are fast."""
        self.session = live_bench(settings, disturbances)
        self.session.method = brisk_method()
        return self.session

    def listen(self):
        self._notifier = QSocketNotifier(sys.stdin.fileno(), QSocketNotifier.Type.Read)
        self._notifier.activated.connect(self._answer)

    def _answer(self):
        word = sys.stdin.readline().strip()
        if SPEED[word] is not None and self.session is not None:
            self.session._live._speed = SPEED[word]
        sys.stdout.write(json.dumps(controls()) + "\n")
        sys.stdout.flush()


def controls():
    """Return what can be seen: name, words, whether it can be used, where on the screen to click.

    A click near the corner hits the field of a number, the box of a tick, the first row of a list.
    """
    found = []
    for widget in QApplication.allWidgets():
        seen = widget.visibleRegion().boundingRect()
        name, words = widget.accessibleName(), words_of(widget)
        if not widget.isVisible() or seen.isEmpty() or not (name or words):
            continue
        corner = seen.topLeft()
        inside = QPoint(min(INSIDE_PX, seen.width() // 2), min(INSIDE_PX, seen.height() // 2))
        at = widget.mapToGlobal(corner + inside)
        found.append(
            {"name": name, "words": words, "usable": widget.isEnabled(), "at": [at.x(), at.y()]}
        )
    return found


def words_of(widget: QWidget):
    if isinstance(widget, SPEAKING):
        return widget.text()
    return ""


def main():
    told = Told()
    start.open_simulated_bench = told.bench
    made = start.TouchdownApp

    class TellingApp(made):
        def start(self):
            super().start()
            told.listen()

    start.TouchdownApp = TellingApp
    return command_line()


if __name__ == "__main__":
    sys.exit(main())

"""Exceptions of every kind of code in a real window: time until the card, and lines in the log.

As a program it is that window, with a live simulated bench, and prints what it measured as JSON.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

from PySide6.QtCore import QObject, Qt, QTimer, Signal
from PySide6.QtGui import QPaintEvent
from PySide6.QtWidgets import QPushButton, QWidget

from tests.bench.children.failing_window import Watched, print_found
from tests.bench.registry import Figure, figure
from tests.bench.workers import hooked, window
from touchdown.app.shell.cards import exit_after_timeout
from touchdown.app.shell.errors import log_to

TICK_MS, FLOOD_S = 16, 10.0
TOLD_S, LINES_PER_S = 0.5, 5.0


class SlotError(Exception):
    """Raised in a slot."""


class TimerError(Exception):
    """Raised when a timer is due."""


class PaintError(Exception):
    """Raised while a widget is painted."""


class ThreadError(Exception):
    """Raised in a thread."""


class QueuedError(Exception):
    """Raised in a call that a thread has put in the queue of the window."""


class Canvas(QWidget):
    """Paints nothing, or raises."""

    raising = False

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: N802
        """Raise if armed."""
        if self.raising:
            raise PaintError("as was wanted")


class Asked(QObject):
    """Signal whose slot runs on the window's thread."""

    now = Signal()


class Raising:
    """``ways``: by kind of error, what raises it once."""

    def __init__(self, main: QWidget) -> None:
        self.canvas, self.button = Canvas(main), QPushButton(main)
        self.canvas.resize(40, 40)
        self.canvas.show()
        self.asked = Asked(main)
        self.button.clicked.connect(self._in_slot)
        self.asked.now.connect(self._queued, Qt.ConnectionType.QueuedConnection)
        self.ways: dict[type[Exception], Callable[[], None]] = {
            SlotError: self.button.click,
            TimerError: lambda: QTimer.singleShot(0, main, self._due),
            PaintError: self._paint,
            ThreadError: lambda: threading.Thread(target=self._in_thread).start(),
            QueuedError: lambda: threading.Thread(target=self.asked.now.emit).start(),
        }

    def _paint(self) -> None:
        self.canvas.raising = True
        self.canvas.repaint()
        self.canvas.raising = False

    def _in_slot(self) -> None:
        raise SlotError("as was wanted")

    def _due(self) -> None:
        raise TimerError("as was wanted")

    def _in_thread(self) -> None:
        raise ThreadError("as was wanted")

    def _queued(self) -> None:
        raise QueuedError("as was wanted")


def measured(window: Watched, log: Path) -> dict[str, dict[str, float]]:
    """Raise each once, then each at every tick."""
    main, found = window.main, dict[str, dict[str, float]]()
    raising = Raising(main.window)
    for kind, once in raising.ways.items():
        code = f"BUG-{kind.__name__.upper()}"
        raised_s = time.monotonic()
        QTimer.singleShot(0, main.window, once)
        window.pump(lambda: code in main.cards.codes)  # noqa: B023 - called at once
        found[kind.__name__] = {"told_s": time.monotonic() - raised_s}
    for kind, once in raising.ways.items():
        main.reset()
        before, flood = log.read_text("utf-8").count("\n"), QTimer(main.window)
        flood.timeout.connect(once)
        flood.start(TICK_MS)
        end_s = time.monotonic() + FLOOD_S
        window.pump(lambda: time.monotonic() >= end_s)  # noqa: B023 - called at once
        flood.stop()
        lines = log.read_text("utf-8").count("\n") - before
        found[kind.__name__] |= {"lines_per_s": lines / FLOOD_S, "cards": len(main.cards.codes)}
    return found


@figure("faults")
def exceptions_of_every_kind() -> list[Figure]:
    """In a slot, a timer, a paint event, a thread and a queued call: once, then at every tick."""
    with hooked() as environment:
        found = window(environment, module=__name__)
    if "named" in found:
        return [Figure("exceptions in a window", None, "", "alive", ok=False, note=f"{found}")]
    kinds: dict[str, dict[str, float]] = found  # type: ignore[assignment]
    slowest = max(kinds, key=lambda kind: kinds[kind]["told_s"])
    loudest = max(kinds, key=lambda kind: kinds[kind]["lines_per_s"])
    told_s, lines = kinds[slowest]["told_s"], kinds[loudest]["lines_per_s"]
    told = ", ".join(f"{kind} {1e3 * one['told_s']:.0f} ms" for kind, one in kinds.items())
    loud = ", ".join(f"{kind} {one['lines_per_s']:.1f}" for kind, one in kinds.items())
    return [
        Figure("exception: its card is there after, worst", told_s, "s", "<= 0.5",
               told_s <= TOLD_S, told),
        Figure("log of an exception at every tick", lines, "lines/s", "<= 5",
               lines <= LINES_PER_S, f"{loud}; the window lives and is closed in order"),
    ]  # fmt: skip


def main() -> int:
    """Print what was measured."""
    with tempfile.TemporaryDirectory() as name:
        log = log_to(Path(name) / "log")
        assert log is not None
        window = Watched(Path(name))
        window.bench()
        found = measured(window, log)
        window.close()
        print_found(found)
    exit_after_timeout()
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Results of worker threads, handed over to the window's thread."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from PySide6.QtCore import QObject, Qt, Signal


class Post(QObject):
    """Runs on the window's thread what other threads put in, in that order."""

    _arrived = Signal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._letters: deque[Callable[[], None]] = deque()
        self._arrived.connect(self._open, Qt.ConnectionType.QueuedConnection)

    def put(self, letter: Callable[[], None]) -> None:
        """Have ``letter`` called soon on the window's thread; callable from any thread."""
        self._letters.append(letter)
        self._arrived.emit()

    def close(self) -> None:
        """Throw away what is still on its way: whoever it was for has ended."""
        self._letters.clear()

    def _open(self) -> None:
        # One letter per call: each has its own turn of the event loop.
        if self._letters:
            self._letters.popleft()()

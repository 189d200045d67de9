"""Processor time of the window's thread in each turn of its event loop.

Each turn of the loop holds at least one slot, so a turn that is short enough proves that every
slot in it is. It is processor time of this thread: other work on the machine does not count.
"""

from __future__ import annotations

import time

from PySide6.QtCore import QAbstractEventDispatcher, QObject

SLOT_S = 0.050  # no turn of the window's loop may take longer


class SlotWatch(QObject):
    """Measures while it is on; ``visits`` has the longest turn of every visit to every page, s."""

    def __init__(self) -> None:
        super().__init__()
        self.begin()
        self._dispatcher = QAbstractEventDispatcher.instance()
        # Which of the two comes before the slots and which after them depends on the platform.
        self._dispatcher.awake.connect(self._mark)
        self._dispatcher.aboutToBlock.connect(self._mark)

    def begin(self) -> None:
        """Forget what was measured so far."""
        self._since_s, self.turns, self._longest_s = None, 0, 0.0
        self.visits: dict[str, list[float]] = {}
        self.doing = ""
        """What goes on now, for the message."""

    def next_visit(self) -> None:
        """The visit to ``doing`` ends here and another begins."""
        if self.doing:
            self.visits.setdefault(self.doing, []).append(self._longest_s)
        self._longest_s = 0.0

    def close(self) -> None:
        self._dispatcher.awake.disconnect(self._mark)
        self._dispatcher.aboutToBlock.disconnect(self._mark)

    def _mark(self) -> None:
        now_s = time.thread_time()
        since_s, self._since_s = self._since_s, now_s
        if since_s is None:
            return
        self.turns += 1
        self._longest_s = max(self._longest_s, now_s - since_s)

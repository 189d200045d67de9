"""A place for one thing between two threads: a newer one takes the place of what nobody took."""

from __future__ import annotations

import threading
from typing import Generic, TypeVar

T = TypeVar("T")


class Newest(Generic[T]):
    """Holds at most one item; ``skipped`` counts those that were never taken."""

    def __init__(self) -> None:
        self._item: T | None = None
        self._there = threading.Condition()
        self.skipped = 0

    def put(self, item: T) -> None:
        """Offer an item."""
        with self._there:
            self.skipped += self._item is not None
            self._item = item
            self._there.notify()

    def take(self, limit_s: float) -> T | None:
        """Return the newest item and leave none behind; None if none comes in time."""
        with self._there:
            self._there.wait_for(lambda: self._item is not None, limit_s)
            item, self._item = self._item, None
            return item

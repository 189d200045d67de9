"""Reads the episodes round the present one ahead of time, and no more than those."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Generic, TypeVar

from app.label.post import Post

AHEAD = 3
"""So many episodes before and after the present one are kept ready."""
CALM_S = 0.08
JOIN_S = 1.0
"""It only reads: a disk that hangs is left behind."""

Item = TypeVar("Item")


class Prefetch(Generic[Item]):
    """Holds what was asked for last, at most ``2 * AHEAD + 1`` items; one thread reads.

    ``arrived`` is called on the window's thread with the id of what is newly there.
    """

    def __init__(
        self, read: Callable[[str], Item], post: Post, arrived: Callable[[str], None]
    ) -> None:
        self._read, self._post, self._arrived = read, post, arrived
        self._changed = threading.Condition()
        self._wanted: tuple[str, ...] = ()
        self._items: dict[str, Item | Exception] = {}
        self._closed = False
        self._thread = threading.Thread(target=self._run, name="label-prefetch", daemon=True)
        self._thread.start()

    def want(self, wanted: Sequence[str]) -> None:
        """Keep exactly these ready, the first one first."""
        with self._changed:
            self._wanted = tuple(wanted[: 2 * AHEAD + 1])
            self._drop()
            self._changed.notify()

    def get(self, uuid: str) -> Item | Exception | None:
        """Return the item, why it cannot be read, or None while it is not there yet."""
        with self._changed:
            return self._items.get(uuid)

    def forget(self) -> None:
        """Read everything anew."""
        with self._changed:
            self._items.clear()
            self._changed.notify()

    def held(self) -> tuple[str, ...]:
        """Return the ids of what is in memory."""
        with self._changed:
            return tuple(self._items)

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join(JOIN_S)

    def _drop(self) -> None:
        for uuid in set(self._items) - set(self._wanted):
            del self._items[uuid]

    def _run(self) -> None:
        while (uuid := self._next()) is not None:
            item: Item | Exception
            try:
                item = self._read(uuid)
            except Exception as error:  # noqa: BLE001 - one bad episode must not end the reading
                item = error
            with self._changed:
                self._items[uuid] = item
                self._drop()
            self._post.put(lambda uuid=uuid: self._arrived(uuid))  # type: ignore[misc]

    def _next(self) -> str | None:
        """Wait for something to read; None: the end.

        The present episode is read at once; its neighbours only when nobody has moved on for a
        moment, so that reading ahead does not hold up the painting of what was just chosen.
        """
        with self._changed:
            while not self._closed:
                missing = [uuid for uuid in self._wanted if uuid not in self._items]
                if missing and missing[0] == self._wanted[0]:
                    return missing[0]
                if missing and not self._changed.wait(CALM_S):
                    return missing[0]
                if not missing:
                    self._changed.wait()
        return None


def around(order: Sequence[str], at: int) -> list[str]:
    """Return the present id and its neighbours, nearest first, later before earlier."""
    places = [at]
    for distance in range(1, AHEAD + 1):
        places += [at + distance, at - distance]
    return [order[place] for place in places if 0 <= place < len(order)]

"""Publish and subscribe for facts: rare, none may be lost, in order."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from backend.core.doing import SharedLock
from backend.core.facts import Fact

Subscriber = Callable[[Fact], None]


class Hub:
    """Delivers each fact to every subscriber, synchronously and in order of publication.

    A subscriber that must not block the publisher (a window) subscribes a ``Mailbox``.
    """

    def __init__(self) -> None:
        self._subscribers: list[Subscriber] = []
        self._lock = SharedLock()

    def subscribe(self, subscriber: Subscriber) -> Callable[[], None]:
        """Add ``subscriber``; call the returned function to leave."""
        with self._lock:
            self._subscribers.append(subscriber)

        def leave() -> None:
            with self._lock:
                if subscriber in self._subscribers:
                    self._subscribers.remove(subscriber)

        return leave

    def publish(self, fact: Fact) -> None:
        """Deliver ``fact`` now, on this thread."""
        with self._lock:
            for subscriber in tuple(self._subscribers):
                subscriber(fact)


class Mailbox:
    """A bounded box of facts for a slow reader; what does not fit is dropped and counted."""

    def __init__(self, capacity: int = 4096) -> None:
        self._facts: deque[Fact] = deque()
        self._capacity = capacity
        self._lock = threading.Lock()
        self.dropped = 0

    def __call__(self, fact: Fact) -> None:
        """Put ``fact`` (this makes a mailbox a subscriber)."""
        with self._lock:
            if len(self._facts) >= self._capacity:
                self._facts.popleft()
                self.dropped += 1
            self._facts.append(fact)

    def take(self) -> Fact | None:
        """Take the oldest fact, or None."""
        with self._lock:
            return self._facts.popleft() if self._facts else None

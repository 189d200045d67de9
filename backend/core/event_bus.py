"""Publish-subscribe bus for events.

Events are rare: none is lost, and every subscriber receives them in order of publication.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from touchdown.backend.core.events import Event
from touchdown.backend.core.scheduling import SharedLock

Subscriber = Callable[[Event], None]


class EventBus:
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

    def publish(self, fact: Event) -> None:
        """Deliver ``fact`` now, on this thread."""
        with self._lock:
            for subscriber in tuple(self._subscribers):
                subscriber(fact)


class EventQueue:
    """A bounded box of facts for a slow reader; what does not fit is dropped and counted."""

    def __init__(self, capacity: int = 4096) -> None:
        self._facts: deque[Event] = deque()
        self._capacity = capacity
        self._lock = threading.Lock()
        self.dropped = 0

    def __call__(self, fact: Event) -> None:
        """Put ``fact`` (this makes a mailbox a subscriber)."""
        with self._lock:
            if len(self._facts) >= self._capacity:
                self._facts.popleft()
                self.dropped += 1
            self._facts.append(fact)

    def take(self) -> Event | None:
        """Take the oldest fact, or None."""
        with self._lock:
            return self._facts.popleft() if self._facts else None

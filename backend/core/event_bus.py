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
    """Delivers each event to every subscriber, synchronously and in order of publication.

    A subscriber that must not block the publisher (a window) subscribes an ``EventQueue``.
    """

    def __init__(self) -> None:
        self._subscribers: list[Subscriber] = []
        self._lock = SharedLock()

    def subscribe(self, subscriber: Subscriber) -> Callable[[], None]:
        """Add ``subscriber``; the returned function removes it."""
        with self._lock:
            self._subscribers.append(subscriber)

        def unsubscribe() -> None:
            with self._lock:
                if subscriber in self._subscribers:
                    self._subscribers.remove(subscriber)

        return unsubscribe

    def publish(self, event: Event) -> None:
        """Deliver ``event`` on this thread."""
        with self._lock:
            for subscriber in tuple(self._subscribers):
                subscriber(event)


class EventQueue:
    """A bounded queue of events for a slow reader; the oldest are dropped and counted."""

    def __init__(self, capacity: int = 4096) -> None:
        self._events: deque[Event] = deque(maxlen=capacity)
        self._lock = threading.Lock()
        self.dropped: int = 0

    def __call__(self, event: Event) -> None:
        """Put ``event``; makes the queue a subscriber."""
        with self._lock:
            self.dropped += len(self._events) == self._events.maxlen
            self._events.append(event)

    def take(self) -> Event | None:
        """Remove and return the oldest event, or None."""
        with self._lock:
            return self._events.popleft() if self._events else None

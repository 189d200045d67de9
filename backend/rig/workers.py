"""The threads of the rig that carry out orders: one a device, so that none waits for another."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Iterable

from backend.rig.messages import Message


class Workers:
    """``carry_out`` is called for one order after the other, on the thread of its device."""

    def __init__(self, names: Iterable[str], carry_out: Callable[[Message], None]) -> None:
        self._carry_out, self._gone = carry_out, False
        self._waiting: dict[str, queue.SimpleQueue[Message | None]] = {}
        self._threads: dict[str, threading.Thread] = {}
        for name in names:
            self._waiting[name] = queue.SimpleQueue()
            self._threads[name] = threading.Thread(
                target=self._work, args=(self._waiting[name],), name=f"rig {name}", daemon=True
            )
            self._threads[name].start()

    def give(self, name: str, order: Message) -> bool:
        """Let the thread of a device do this next; False if there is no such device."""
        if name not in self._waiting:
            return False
        self._waiting[name].put(order)
        return True

    def leave(self) -> None:
        """Begin nothing more: what is under way is the last."""
        self._gone = True
        for waiting in self._waiting.values():
            waiting.put(None)

    def idle(self, name: str, limit_s: float) -> bool:
        """After ``leave``: wait until nobody is at work with a device; False if it takes longer."""
        self._threads[name].join(limit_s)
        return not self._threads[name].is_alive()

    def _work(self, waiting: queue.SimpleQueue[Message | None]) -> None:
        while (order := waiting.get()) is not None and not self._gone:
            self._carry_out(order)

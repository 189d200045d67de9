"""One end of the pipe between the backend and the rig process: nobody who speaks ever waits.

What is said goes through a bounded queue; when that is full the other side has stopped listening,
and the channel counts as ended.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import IO

from backend.rig.messages import Message, pack, receive

WAITING = 512


class Channel:
    """``take`` hears each message, ``ended`` once that no more come, both on the same thread."""

    def __init__(
        self,
        source: IO[bytes],
        sink: IO[bytes],
        take: Callable[[Message], None],
        ended: Callable[[], None],
    ) -> None:
        self._source, self._sink = source, sink
        self._take, self._ended = take, ended
        self._waiting: queue.Queue[bytes | None] = queue.Queue(WAITING)
        self._speaker = threading.Thread(target=self._speak, name="rig speaker", daemon=True)
        self._listener = threading.Thread(target=self._listen, name="rig listener", daemon=True)

    def start(self) -> None:
        """Begin to listen."""
        self._speaker.start()
        self._listener.start()

    def say(self, message: Message) -> bool:
        """Send a message in its turn; False if the other side does not take any more."""
        try:
            self._waiting.put_nowait(pack(message))
        except queue.Full:
            return False
        return True

    def close(self) -> None:
        """Say no more: the other side sees the end once all before has been sent."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)

    def join(self, limit_s: float) -> None:
        """Wait for both threads; the listener ends with the other side."""
        for thread in (self._speaker, self._listener):
            thread.join(limit_s)

    def _speak(self) -> None:
        with suppress(OSError, ValueError):
            while (content := self._waiting.get()) is not None:
                self._sink.write(content)
                self._sink.flush()
        with suppress(OSError):
            self._sink.close()

    def _listen(self) -> None:
        try:
            while (message := receive(self._source)) is not None:
                self._take(message)
        except Exception:  # noqa: BLE001 - who tells nonsense, of whatever kind, is as good as gone
            return
        finally:
            self._ended()

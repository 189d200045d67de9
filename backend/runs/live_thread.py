"""The thread that paces a live bench against the wall clock."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

BEHIND_S = 0.25
"""A live bench that is later than this against the wall clock gives up catching up."""
JOIN_S = 5.0
HUNG_S, HUNG_JOIN_S = 2.0, 0.5
"""One that has made no step for so long is not waited for as others are."""


class LiveThread:
    """Calls ``step`` every ``step_s`` of bench time; ``failed`` hears what ended it early."""

    def __init__(
        self, step: Callable[[], None], step_s: float, failed: Callable[[BaseException], None]
    ) -> None:
        self._step, self._step_s, self._failed = step, step_s, failed
        self._thread: threading.Thread | None = None
        self._closing = threading.Event()
        self._speed, self._stepped_s = 1.0, 0.0
        self.pace = 0.0
        """Bench seconds per wall second, measured once a second."""

    @property
    def running(self) -> bool:
        """Whether it was started and not closed."""
        return self._thread is not None

    @property
    def still_s(self) -> float:
        """For how long no step has ended; 0 while none are made."""
        return time.monotonic() - self._stepped_s if self._thread is not None else 0.0

    def open(self, speed: float) -> None:
        """Start; ``speed`` bench seconds per wall second. A second time changes nothing."""
        if self._thread is None:
            self._closing.clear()
            self._speed, self._stepped_s = speed, time.monotonic()
            self._thread = threading.Thread(target=self._live, name="bench", daemon=True)
            self._thread.start()

    def close(self, settle: Callable[[], object]) -> None:
        """End; ``settle`` is called first, while time still passes."""
        hung = self.still_s > HUNG_S
        thread, self._thread = self._thread, None
        if thread is not None:
            settle()
            self._closing.set()
            thread.join(HUNG_JOIN_S if hung else JOIN_S)

    def _live(self) -> None:
        try:
            self._keep_pace()
        except BaseException as error:
            # Whatever it was: latch, stop, end the run, and let the exception hooks show it.
            self._failed(error)
            raise

    def _keep_pace(self) -> None:
        due_s = time.monotonic()
        measured_s, steps = due_s, 0
        while not self._closing.is_set():
            self._step()
            steps += 1
            due_s += self._step_s / self._speed
            now_s = self._stepped_s = time.monotonic()
            if now_s - measured_s >= 1.0:
                self.pace = steps * self._step_s / (now_s - measured_s)
                measured_s, steps = now_s, 0
            if now_s - due_s > BEHIND_S:
                due_s = now_s
            self._closing.wait(max(0.0, due_s - now_s))

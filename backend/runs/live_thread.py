"""The thread that paces a live bench against the wall clock, and the one that watches it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

from backend.core.faults import Fault
from backend.runs.bench_watch import LOOK_S, BenchWatch

BEHIND_S = 0.25
"""A live bench that is later than this against the wall clock gives up catching up."""
JOIN_S = 5.0
HUNG_S, HUNG_JOIN_S = 2.0, 0.5
"""One that has made no step for so long is not waited for as others are."""


class LiveThread:
    """Calls ``step`` every ``step_s`` of bench time; ``failed`` hears what ended it early.

    ``still`` hears, on a thread of its own, that it makes no step: every ``LOOK_S``, meanwhile.
    """

    def __init__(
        self,
        step: Callable[[], None],
        step_s: float,
        failed: Callable[[BaseException], None],
        still: Callable[[Fault], None],
    ) -> None:
        self._step, self._step_s, self._failed, self._still = step, step_s, failed, still
        self._thread: threading.Thread | None = None
        self._closing, self._over = threading.Event(), threading.Event()
        self._hung_at = -1
        """The step after which it was told to stand still."""
        self._speed, self._stepped_s, self._steps = 1.0, 0.0, 0
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
            self._over.clear()
            self._speed, self._stepped_s = speed, time.monotonic()
            self._thread = threading.Thread(target=self._live, name="bench", daemon=True)
            self._thread.start()
            threading.Thread(
                target=self._watch, args=(self._thread,), name="bench watch", daemon=True
            ).start()

    def close(self, settle: Callable[[], object]) -> None:
        """End; ``settle`` is called first, while time still passes."""
        hung = self.still_s > HUNG_S
        thread, self._thread = self._thread, None
        if thread is None:
            return
        settle()
        self._closing.set()
        begun_s = waited_s = time.monotonic()
        # It may also be told only now that it stands still.
        while waited_s - begun_s < (HUNG_JOIN_S if hung else JOIN_S) and thread.is_alive():
            thread.join(LOOK_S)
            waited_s, hung = time.monotonic(), hung or self._hung_at == self._steps
        self._over.set()

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
            self._steps += 1
            steps += 1
            due_s += self._step_s / self._speed
            now_s = self._stepped_s = time.monotonic()
            if now_s - measured_s >= 1.0:
                self.pace = steps * self._step_s / (now_s - measured_s)
                measured_s, steps = now_s, 0
            if now_s - due_s > BEHIND_S:
                due_s = now_s
            self._closing.wait(max(0.0, due_s - now_s))

    def _watch(self, thread: threading.Thread) -> None:
        assert thread.native_id is not None
        step_s = self._step_s / self._speed
        watch = BenchWatch(thread.native_id, lambda: self._steps, step_s, self._hangs)
        while thread.is_alive() and not self._over.wait(LOOK_S):
            watch.look(time.monotonic())

    def _hangs(self, fault: Fault) -> None:
        self._hung_at = self._steps
        self._still(fault)

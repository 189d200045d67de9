"""Saving of label edits on a worker thread."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from PySide6.QtCore import QObject, Qt, Signal

from touchdown.backend.core import FaultError, RefusedError, TouchdownError


class MainThreadQueue(QObject):
    """Runs on the window's thread what other threads put in, in that order."""

    _arrived = Signal()

    def __init__(self, parent: QObject | None = None) -> None:
        super().__init__(parent)
        self._letters: deque[Callable[[], None]] = deque()
        self._arrived.connect(self._open, Qt.ConnectionType.QueuedConnection)

    def put(self, letter: Callable[[], None]) -> None:
        """Have ``letter`` called soon on the window's thread; callable from any thread."""
        self._letters.append(letter)
        self._arrived.emit()

    def close(self) -> None:
        """Throw away what is still on its way: whoever it was for has ended."""
        self._letters.clear()

    def _open(self) -> None:
        # One letter per call: each has its own turn of the event loop.
        if self._letters:
            self._letters.popleft()()


Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class _SaveJob:
    work: Callable[[], Any]
    done: Callable[[Any], None]
    failed: Callable[[Exception], None]


class SaveWorker:
    """Runs jobs one after the other; exactly one of ``done`` and ``failed`` follows each."""

    def __init__(self, post: MainThreadQueue, name: str = "label-commits") -> None:
        self._post = post
        self._jobs: queue.SimpleQueue[_SaveJob | None] = queue.SimpleQueue()
        self._waiting = 0
        self.told: Callable[[], None] = _ignore_end
        """Called after each end was told, whoever had submitted the job."""
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Whether a job has been submitted whose end was not yet told."""
        return self._waiting > 0

    def submit(
        self,
        work: Callable[[], Result],
        done: Callable[[Result], None],
        failed: Callable[[Exception], None],
    ) -> None:
        """Have ``work`` run on the thread; its end is told on the window's thread."""
        self._waiting += 1
        self._jobs.put(_SaveJob(work, done, failed))

    def close(self) -> None:
        """Finish what was submitted, then end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._do(job)

    def _do(self, job: _SaveJob) -> None:
        try:
            result = job.work()
        except Exception as error:  # noqa: BLE001 - a save whose end nobody tells blocks the page
            failure = error
            self._post.put(lambda: self._tell(job.failed, failure))
        else:
            self._post.put(lambda: self._tell(job.done, result))

    def _tell(self, tell: Callable[[Any], None], what: object) -> None:
        self._waiting -= 1
        tell(what)
        self.told()


def _ignore_end() -> None:
    """Do nothing: nobody waits."""


LOCKED = "CATALOGUE-BUSY"
"""Code of the fault that another program writes to the dataset."""
SaveAction = Callable[[], None]


@dataclass(frozen=True, slots=True)
class SaveFailure:
    """A save that failed: ``what`` happened in words, and how to try again."""

    what: str
    again: SaveAction


class SaveQueue:
    """Orders saves and intents. ``refused`` gets the reason where a change is not allowed."""

    def __init__(
        self, commits: SaveWorker, refused: Callable[[str], None], changed: Callable[[], None]
    ) -> None:
        self._commits, self._refused, self._changed = commits, refused, changed
        self._intents: deque[SaveAction] = deque()
        self._draining = self._held = self._locked = False
        self.trouble: SaveFailure | None = None
        commits.told = self._drain

    @property
    def busy(self) -> bool:
        """Whether a save is under way, or the present episode is not there yet."""
        return self._held or self._commits.busy

    @property
    def waiting(self) -> int:
        """How many actions wait until another program lets go of the dataset."""
        return 1 + len(self._intents) if self._locked else 0

    def hold(self, held: bool) -> None:
        """Let intents wait while the next episode is still being read."""
        self._held = held

    def go_on(self) -> None:
        """Do what waited, if nothing is in the way any more."""
        self._drain()

    def after(self, intent: SaveAction) -> None:
        """Do ``intent`` now, or after the saves that are under way."""
        self._intents.append(intent)
        self._drain()
        if self._locked:
            self._changed()

    def save(self, work: Callable[[], Result], done: Callable[[Result], None]) -> None:
        """Have ``work`` done on the thread of the saves; ``done`` follows if it succeeded."""

        def succeeded(result: Result) -> None:
            self.trouble, self._locked = None, False
            done(result)
            self._changed()

        def failed(error: Exception) -> None:
            self._locked = isinstance(error, FaultError) and error.fault.code == LOCKED
            if self._locked:
                # The next try waits for the lock as long as this one did: no wait of our own.
                self._commits.submit(work, succeeded, failed)
                self._changed()
                return
            self._intents.clear()
            if isinstance(error, RefusedError):
                self._refused(error.detail)
            else:
                self.trouble = SaveFailure(_error_text(error), lambda: self.save(work, done))
            self._changed()

        self._commits.submit(work, succeeded, failed)
        self._changed()

    def try_again(self) -> None:
        """Save once more what could not be saved."""
        trouble, self.trouble = self.trouble, None
        if trouble is not None:
            trouble.again()

    def discard(self) -> None:
        """Give up what could not be saved."""
        self.trouble = None
        self._changed()

    def _drain(self) -> None:
        if self._draining:
            return
        self._draining = True
        try:
            while self._intents and not self.busy:
                self._intents.popleft()()
        finally:
            self._draining = False


def _error_text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return f"{error.fault.what} {error.fault.next_step}"
    return str(error) if isinstance(error, TouchdownError) else f"{type(error).__name__}: {error}"

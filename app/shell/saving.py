"""Saving of label edits on a worker thread."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Awaitable, Callable, Coroutine, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

from PySide6.QtCore import QObject, Qt, Signal

from touchdown.backend.core import FaultError, RefusedError, TouchdownError

Result = TypeVar("Result")


class SaveWorker(QObject):
    """Runs jobs on one thread, in order. Exactly one of ``done`` and ``failed`` follows each job.

    The thread starts with the first job. ``put`` calls a function on the thread of the window, and
    ``finished`` is emitted there after each job.
    """

    finished = Signal()
    _arrived = Signal()

    def __init__(self, parent: QObject, name: str) -> None:
        super().__init__(parent)
        self._calls: deque[Callable[[], None]] = deque()
        self._jobs: queue.SimpleQueue[tuple[Callable[..., Any], ...] | None] = queue.SimpleQueue()
        self._waiting, self._closed = 0, False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._arrived.connect(self._call_next, Qt.ConnectionType.QueuedConnection)

    @property
    def busy(self) -> bool:
        """True while a submitted job has not finished."""
        return self._waiting > 0

    def submit(
        self,
        work: Callable[[], Result],
        done: Callable[[Result], None],
        failed: Callable[[Exception], None],
    ) -> None:
        """Run ``work`` on the thread; call ``done`` or ``failed`` on the thread of the window."""
        self._waiting += 1
        self._jobs.put((work, done, failed))
        if self._thread.ident is None:
            self._thread.start()

    def put(self, call: Callable[[], None]) -> None:
        """Call ``call`` from the event loop of the window. Any thread may use this method."""
        self._calls.append(call)
        self._arrived.emit()

    def close(self, timeout_s: float | None = None) -> None:
        """Finish the submitted jobs and end the thread; the ends that remain are not reported."""
        self._closed = True
        if self._thread.ident is not None:
            self._jobs.put(None)
            self._thread.join(timeout_s)

    def _call_next(self) -> None:
        # One call per event, so that the window stays responsive between them.
        if self._calls and not self._closed:
            self._calls.popleft()()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            work, done, failed = job
            try:
                finish = partial(self._finish, done, work())
            except Exception as error:  # noqa: BLE001 - an unreported end would block the page
                finish = partial(self._finish, failed, error)
            self.put(finish)

    def _finish(self, report: Callable[[Any], None], result: object) -> None:
        self._waiting -= 1
        report(result)
        self.finished.emit()


LOCKED = "CATALOGUE-BUSY"  # code of the fault that another program writes to the dataset
SaveAction = Callable[[], Coroutine[Any, Any, None] | None]


@dataclass(slots=True)
class _Save(Generic[Result]):
    """Awaits the result of ``work``, which runs on the thread of the saves."""

    work: Callable[[], Result]

    def __await__(self) -> Generator[_Save[Result], Result, Result]:
        return (yield self)


class SaveQueue:
    """Runs user actions in order; each may be a coroutine that awaits saves.

    An action waits for the saves of the actions before it. A save that another program locks out
    is repeated; one that is refused ends its action; one that fails stays as ``failure`` until
    ``try_again`` or ``discard``. Refusal and failure also drop the actions that wait.

    Parameters
    ----------
    worker
        Thread of the saves.
    refused
        Receives the reason where a change is not allowed.
    changed
        Called when the state of the saves has changed.

    """

    def __init__(
        self, worker: SaveWorker, refused: Callable[[str], None], changed: Callable[[], None]
    ) -> None:
        self._worker, self._refused, self._changed = worker, refused, changed
        self._actions: deque[SaveAction] = deque()
        self._draining = self._held = self._locked = False
        self._failed: tuple[Coroutine[Any, Any, None], Callable[[], Any]] | None = None
        self.failure = ""  # text of the save that failed
        worker.finished.connect(self.drain)

    @property
    def busy(self) -> bool:
        """True while a save is in progress or the present episode is being read."""
        return self._held or self._worker.busy

    @property
    def waiting(self) -> int:
        """Number of actions that wait until another program unlocks the dataset."""
        return 1 + len(self._actions) if self._locked else 0

    def hold(self, held: bool) -> None:
        """Keep actions waiting while the next episode is being read."""
        self._held = held

    def after(self, action: SaveAction) -> None:
        """Run ``action`` now, or after the saves in progress."""
        self._actions.append(action)
        self.drain()
        if self._locked:
            self._changed()

    def start(self, coroutine: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine now, up to its first save."""
        self._resume(coroutine, None)

    def save(self, work: Callable[[], Result]) -> Awaitable[Result]:
        """Run ``work`` on the thread of the saves; await its result."""
        return _Save(work)

    def try_again(self) -> None:
        """Repeat the save that failed."""
        if self._failed is not None:
            (coroutine, work), self._failed, self.failure = self._failed, None, ""
            self._submit(coroutine, work)

    def discard(self) -> None:
        """Drop the save that failed and the rest of its action."""
        self._failed, self.failure = None, ""
        self._changed()

    def drain(self) -> None:
        """Run the actions that wait, until one of them saves."""
        if self._draining:
            return
        self._draining = True
        try:
            while self._actions and not self.busy:
                coroutine = self._actions.popleft()()
                if isinstance(coroutine, Coroutine):
                    self.start(coroutine)
        finally:
            self._draining = False

    def _resume(self, coroutine: Coroutine[Any, Any, None], result: object) -> None:
        try:
            step = coroutine.send(result)
        except StopIteration:
            return
        self._submit(coroutine, step.work)

    def _submit(self, coroutine: Coroutine[Any, Any, None], work: Callable[[], Any]) -> None:
        self._worker.submit(
            work, partial(self._succeed, coroutine), partial(self._fail, coroutine, work)
        )
        self._changed()

    def _succeed(self, coroutine: Coroutine[Any, Any, None], result: object) -> None:
        self._failed, self.failure, self._locked = None, "", False
        self._resume(coroutine, result)
        self._changed()

    def _fail(
        self, coroutine: Coroutine[Any, Any, None], work: Callable[[], Any], error: Exception
    ) -> None:
        self._locked = isinstance(error, FaultError) and error.fault.code == LOCKED
        if self._locked:
            # Each attempt waits for the lock, so no delay is needed here.
            self._submit(coroutine, work)
            return
        self._actions.clear()
        if isinstance(error, RefusedError):
            coroutine.close()
            self._refused(error.detail)
        else:
            self._failed, self.failure = (coroutine, work), _error_text(error)
        self._changed()


def _error_text(error: Exception) -> str:
    if isinstance(error, FaultError):
        return f"{error.fault.what} {error.fault.next_step}"
    return str(error) if isinstance(error, TouchdownError) else f"{type(error).__name__}: {error}"

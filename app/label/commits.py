"""One thread that writes labels, so that a slow disk never holds up the window."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

from app.label.post import Post

Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class _Job:
    work: Callable[[], Any]
    done: Callable[[Any], None]
    failed: Callable[[Exception], None]


class Commits:
    """Runs jobs one after the other; exactly one of ``done`` and ``failed`` follows each."""

    def __init__(self, post: Post, name: str = "label-commits") -> None:
        self._post = post
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._waiting = 0
        self.told: Callable[[], None] = _nothing
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
        self._jobs.put(_Job(work, done, failed))

    def close(self) -> None:
        """Finish what was submitted, then end the thread."""
        self._jobs.put(None)
        self._thread.join()

    def _run(self) -> None:
        while (job := self._jobs.get()) is not None:
            self._do(job)

    def _do(self, job: _Job) -> None:
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


def _nothing() -> None:
    """Do nothing: nobody waits."""

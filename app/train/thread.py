"""One training on a thread of its own, which waits for the child process and tells the window."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from app.label.post import Post
from backend.core.standstill import Standstill
from backend.learning.job import Cancelled, Epoch, Finished, Loaded
from backend.learning.recorded import RecordedTraining, TrainingRequest

Report = Loaded | Epoch | Finished | Cancelled
LOOK_S = 0.05
PATIENCE_S, JOIN_S = 1.0, 1.0
"""So long a window that closes waits for a cancelled training, and after that for a killed one."""


@dataclass(frozen=True, slots=True)
class Told:
    """Whom to tell, on the window's thread. ``ended`` gets what ended it early, or None.

    ``still``: the child process does nothing, or goes on after all.
    """

    begun: Callable[[Path], None]
    report: Callable[[Report], None]
    ended: Callable[[Exception | None], None]
    still: Callable[[bool], None]


class TrainingThread:
    """Begins at once; exactly one ``ended`` follows."""

    def __init__(self, request: TrainingRequest, post: Post, told: Told) -> None:
        self._request, self._post, self._told = request, post, told
        self._lock, self._cancelled = threading.Lock(), False
        self._training: RecordedTraining | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="training", daemon=True)
        self._watch = threading.Thread(target=self._look, name="training watch", daemon=True)
        self._thread.start()
        self._watch.start()

    def cancel(self) -> None:
        """End it after the present batch, or at once if it stands still; returns at once."""
        with self._lock:
            self._cancelled = True
            if self._training is not None:
                self._training.cancel()

    def close(self) -> None:
        """End it and wait, for a while only: the process is gone then, whatever it did."""
        self.cancel()
        self._thread.join(PATIENCE_S)
        self._kill()
        self._over.set()
        self._thread.join(JOIN_S)
        self._watch.join(JOIN_S)

    def _kill(self) -> None:
        with self._lock:
            if self._training is not None:
                self._training.kill()

    def _run(self) -> None:
        failure: Exception | None = None
        try:
            self._train()
        except Exception as error:  # noqa: BLE001 - a training whose end nobody tells blocks the page
            failure = error
        self._over.set()
        self._post.put(partial(self._told.ended, failure))

    def _train(self) -> None:
        training = RecordedTraining(self._request)
        with self._lock:
            self._training = training
            if self._cancelled:
                training.cancel()
        self._post.put(partial(self._told.begun, training.folder))
        for report in training.reports():
            self._post.put(partial(self._told.report, report))

    def _look(self) -> None:
        """Tell when the child stands still and when it goes on; a cancelled one is ended then."""
        watch, told = None, False
        while not self._over.wait(LOOK_S):
            with self._lock:
                training, cancelled = self._training, self._cancelled
            number = None if training is None else training.number
            if number is None:
                continue
            watch = watch or Standstill(number)
            still = watch.look(time.monotonic())
            if still and cancelled:
                self._kill()
            elif still is not told:
                told = still
                self._post.put(partial(self._told.still, still))

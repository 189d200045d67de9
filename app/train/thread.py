"""One training on a thread of its own, which waits for the child process and tells the window."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from app.label.post import Post
from backend.learning.job import Cancelled, Epoch, Finished, Loaded
from backend.learning.recorded import RecordedTraining, TrainingRequest

Report = Loaded | Epoch | Finished | Cancelled
JOIN_S = 20.0


@dataclass(frozen=True, slots=True)
class Told:
    """Whom to tell, on the window's thread. ``ended`` gets what ended it early, or None."""

    begun: Callable[[Path], None]
    report: Callable[[Report], None]
    ended: Callable[[Exception | None], None]


class TrainingThread:
    """Begins at once; exactly one ``ended`` follows."""

    def __init__(self, request: TrainingRequest, post: Post, told: Told) -> None:
        self._request, self._post, self._told = request, post, told
        self._lock, self._cancelled = threading.Lock(), False
        self._training: RecordedTraining | None = None
        self._thread = threading.Thread(target=self._run, name="training", daemon=True)
        self._thread.start()

    def cancel(self) -> None:
        """End it after the present batch; returns at once."""
        with self._lock:
            self._cancelled = True
            if self._training is not None:
                self._training.cancel()

    def close(self) -> None:
        """End it and wait."""
        self.cancel()
        self._thread.join(JOIN_S)

    def _run(self) -> None:
        failure: Exception | None = None
        try:
            self._train()
        except Exception as error:  # noqa: BLE001 - a training whose end nobody tells blocks the page
            failure = error
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

"""A training in its child process, kept as a run beside its data: parameters, curves, model."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from backend.catalogue.dataset import Dataset
from backend.catalogue.program import environment, hardware
from backend.catalogue.run_folder import About, LiveRun
from backend.catalogue.training_set import LabelChoice, is_dataset
from backend.catalogue.uuid7 import uuid7
from backend.config.method import TrainingSettings
from backend.core.faults import FaultError, InputError
from backend.core.program import program
from backend.learning.child import TrainingProcess
from backend.learning.job import Cancelled, Epoch, Finished, Loaded, TrainingJob
from backend.learning.run_record import note, note_bins
from backend.learning.training_runs import KIND, MODEL, RESUME, TrainingRun


@dataclass(frozen=True, slots=True)
class TrainingRequest:
    """Train on the episodes of ``piece`` in ``data``; ``labels``: which ones count in a dataset.

    ``goes_on``: an unfinished run with the same data and settings, whose epochs are kept.
    """

    data: Path
    piece: str
    settings: TrainingSettings
    labels: LabelChoice = "approved"
    goes_on: TrainingRun | None = None

    def params(self) -> dict[str, Any]:
        """Return what the run depends on, JSON-ready."""
        resumed = {} if self.goes_on is None else {"resumed": self.goes_on.uuid}
        kept = {"piece": self.piece, "labels": self.labels, **self.settings.model_dump(mode="json")}
        return kept | resumed


def request_of(run: TrainingRun, data: Path) -> TrainingRequest:
    """Return the request that goes on with ``run``; raises ``InputError`` if it cannot."""
    if not run.can_resume:
        raise InputError(
            "There is nothing to go on with: no whole epoch was kept.",
            str(run.folder),
            "Start a new training.",
        )
    params: Mapping[str, Any] = run.about.params
    known = {name: params[name] for name in TrainingSettings.model_fields if name in params}
    settings = TrainingSettings.model_validate(known)
    return TrainingRequest(data, str(params["piece"]), settings, params["labels"], run)


class RecordedTraining:
    """One training. ``reports`` runs on one thread; ``cancel`` may come from any."""

    def __init__(self, request: TrainingRequest) -> None:
        self._request = request
        self._run = _begin(request)
        self._child: TrainingProcess | None = None
        self._cancelled = self._killed = False
        self._lock = threading.Lock()

    @property
    def uuid(self) -> str:
        """Id of the run."""
        return self._run.uuid

    @property
    def folder(self) -> Path:
        """Folder of the run."""
        return self._run.folder

    @property
    def number(self) -> int | None:
        """Number of the child process, None while there is none."""
        with self._lock:
            return None if self._child is None else self._child.number

    def reports(self) -> Iterator[Loaded | Epoch | Finished | Cancelled]:
        """Train, and yield what is told once it is kept.

        Raises ``InputError`` for what the child refused, ``FaultError`` if it died.
        """
        with self._run as run:
            job = self._job()
            with TrainingProcess(job) as child:
                with self._lock:
                    self._child = child
                    if self._cancelled:
                        child.cancel()
                try:
                    for report in child.reports():
                        note(run, report)
                        yield report
                except FaultError:
                    # One that had to be killed to end is a cancelled one.
                    if not self._killed:
                        raise
                finally:
                    with self._lock:
                        self._child = None

    def cancel(self) -> None:
        """Stop after the present batch; whole epochs are kept for a resume."""
        with self._lock:
            self._cancelled = True
            if self._child is not None:
                self._child.cancel()

    def kill(self) -> None:
        """Cancel one that does not react: whole epochs are kept, the present one is lost."""
        self.cancel()
        with self._lock:
            self._killed = True
            if self._child is not None:
                self._child.kill()

    def _job(self) -> TrainingJob:
        request, out = self._request, self._run.folder / MODEL
        if request.goes_on is not None:
            shutil.copyfile(request.goes_on.folder / RESUME, self._run.folder / RESUME)
            _repeat(self._run, request.goes_on)
        return TrainingJob(
            data=request.data,
            piece=request.piece,
            out=out,
            settings=request.settings,
            labels=request.labels,
            resume=request.goes_on is not None,
            keep=self._run.folder,
        )


def _begin(request: TrainingRequest) -> LiveRun:
    seed, params = request.settings.seed, request.params()
    try:
        if is_dataset(request.data):
            with Dataset.open(request.data, write=False) as dataset:
                return dataset.runs.begin(KIND, seed=seed, settings=params)
        about = About(
            uuid7(), KIND, "running", time.time_ns(), seed, program(), params,
            hardware=hardware(), environment=environment(),
        )  # fmt: skip
        return LiveRun(request.data, about)
    except OSError as error:
        raise InputError(
            f"No run can be kept there: {error.strerror or error}.",
            str(request.data),
            "Make room, or give the account the right to write there.",
        ) from error


def _repeat(run: LiveRun, former: TrainingRun) -> None:
    """Begin the curves with those of the run that is gone on with."""
    for name, values in former.curves.items():
        for step, value in values:
            run.metric(name, step, value)
    for epoch, bins in former.reliability.items():
        note_bins(run, epoch, bins)
    run.end_epoch()

"""A training as a run of its dataset. The process that started it writes; the child knows nothing.

Everything is in the folder of the run, so that it makes no difference who has the dataset open.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

from backend.catalogue.dataset import Dataset
from backend.catalogue.run_folder import LiveRun
from backend.catalogue.training_set import is_dataset
from backend.catalogue.writer_lock import NotWritableError
from backend.core.faults import InputError
from backend.learning.checkpoint import load_card
from backend.learning.job import Cancelled, Epoch, Finished, Loaded, TrainingJob
from backend.learning.metrics import calibration_error
from backend.learning.training_runs import KIND, RELIABILITY

CURVES = ("train_loss", "validation_loss", "iou", "point_accuracy")
"""Fields of ``Epoch`` that are kept as metrics, a value per epoch."""
CALIBRATION = "calibration_error"


def begin_training(dataset: Dataset, job: TrainingJob) -> LiveRun:
    """Begin the run of ``job``; its params are what the job asks for."""
    asked = job.model_dump(mode="json", include={"piece", "out", "labels", "resume", "threads"})
    settings = asked | job.settings.model_dump(mode="json")
    return dataset.runs.begin(KIND, seed=job.settings.seed, settings=settings)


def kept_in(run: LiveRun | None, job: TrainingJob) -> TrainingJob:
    """Return ``job`` that leaves its manifest and samples in the folder of its run, if any."""
    return job if run is None else job.model_copy(update={"keep": run.folder})


def note(run: LiveRun, report: Loaded | Epoch | Finished | Cancelled) -> None:
    """Keep what the training said; its last word ends the run."""
    match report:
        case Loaded():
            facts = report.model_dump(mode="json", include={"episodes", "held_out", "base_rate"})
            for name, value in facts.items():
                run.metric(name, 0, value)
        case Epoch():
            for name in CURVES:
                run.metric(name, report.epoch, getattr(report, name))
            run.metric(CALIBRATION, report.epoch, calibration_error(report.reliability))
            note_bins(run, report.epoch, report.reliability)
            run.end_epoch()
        case Finished():
            for name, path in (("model", report.out), ("card", report.out.with_suffix(".json"))):
                run.artifact(name, path)
            run.name_data(load_card(report.out).manifest_sha256)
            run.finish()
        case Cancelled():
            run.cancel()


def note_bins(run: LiveRun, epoch: int, bins: object) -> None:
    """Append the reliability bins of an epoch."""
    with (run.folder / RELIABILITY).open("a", encoding="utf-8") as file:
        file.write(json.dumps({"epoch": epoch, "bins": bins}) + "\n")


@contextmanager
def recorded(job: TrainingJob, say: Callable[[str], None]) -> Iterator[LiveRun | None]:
    """Record ``job`` in the dataset ``job.data``, which may be open elsewhere; None for packs.

    An error ends the run as failed, and goes on. Afterwards the catalogue is brought up to date,
    and ``say`` gets what a start says; where another program has it open, that one does it.
    """
    if not is_dataset(job.data):
        yield None
        return
    try:
        with Dataset.open(job.data, create=False, write=False) as dataset:
            run = begin_training(dataset, job)
    except OSError as error:
        raise InputError(
            f"No run can be kept there: {error.strerror or error}.",
            str(job.data),
            "Make room, or give the account the right to write there.",
        ) from error
    try:
        with run:
            yield run
    finally:
        with suppress(NotWritableError), Dataset.open(job.data, create=False) as dataset:
            for notice in dataset.notices:
                say(notice)

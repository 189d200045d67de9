"""Job and report messages between a training process and its parent (JSON lines)."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from touchdown.backend.annotations import LabelChoice
from touchdown.backend.config import TrainingSettings
from touchdown.backend.learning.metrics import ReliabilityBin

# What computes: ``auto`` is the graphics processor if torch finds one, else the processor.
DeviceName = Literal["auto", "cpu", "cuda"]
DEVICES: tuple[DeviceName, ...] = ("auto", "cpu", "cuda")
# More were never measured; the same on all machines that have them gives the same numbers.
MOST_THREADS = 2


def default_threads() -> int:
    """Return on how many threads a training computes that has the machine to itself."""
    return min(MOST_THREADS, os.cpu_count() or 1)


class JobMessage(BaseModel):
    """Base of everything that crosses the border between the two processes."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class TrainingJob(JobMessage):
    """Train on the episodes of ``piece`` (None: the only one) in ``data``; write to ``out``.

    ``data``: a dataset, of which ``labels`` says what counts, or a folder of packs.
    """

    data: Path
    piece: str | None
    out: Path
    settings: TrainingSettings
    labels: LabelChoice = "approved"
    resume: bool = False
    # Folder that takes the manifest of the training set and sample predictions, if any.
    keep: Path | None = None
    # More than one gain where as many cores are free, and wait for each other where they are not;
    # other last digits than one thread gives.
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    device: DeviceName = "auto"


class TrainingLoaded(JobMessage):
    """The data are there. ``kept_together``: what was never divided (mounting, series or grip)."""

    kind: Literal["loaded"] = "loaded"
    piece: str
    episodes: int
    held_out: int
    kept_together: str
    points: int
    parameters: int
    base_rate: float
    done: int


class TrainingEpoch(JobMessage):
    """One epoch ended; see ``EpochReport``."""

    kind: Literal["epoch"] = "epoch"
    epoch: int
    epochs: int
    train_loss: float
    validation_loss: float
    iou: float
    point_accuracy: float
    best_epoch: int
    reliability: tuple[ReliabilityBin, ...] = ()


class TrainingFinished(JobMessage):
    """The model is written."""

    kind: Literal["finished"] = "finished"
    out: Path
    weights_sha256: str
    best_epoch: int
    iou: float
    point_accuracy: float
    seconds: float


class TrainingCancelled(JobMessage):
    """Stopped on request after ``done`` whole epochs; ``state`` resumes it."""

    kind: Literal["cancelled"] = "cancelled"
    done: int
    state: Path


class TrainingRefused(JobMessage):
    """Bad input, in the words of ``InputError``."""

    kind: Literal["refused"] = "refused"
    what: str
    where: str
    fix: str


TrainingReport = Annotated[
    TrainingLoaded | TrainingEpoch | TrainingFinished | TrainingCancelled | TrainingRefused,
    Field(discriminator="kind"),
]
TRAINING_REPORT: TypeAdapter[
    TrainingLoaded | TrainingEpoch | TrainingFinished | TrainingCancelled | TrainingRefused
] = TypeAdapter(TrainingReport)
ReportCallback = Callable[
    [TrainingLoaded | TrainingEpoch | TrainingFinished | TrainingCancelled], None
]

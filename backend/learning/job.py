"""Job and report messages between a training process and its parent (JSON lines)."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from touchdown.backend.annotations import LabelChoice
from touchdown.backend.config import TrainingSettings
from touchdown.backend.learning.metrics import ReliabilityBin

# ``auto``: CUDA if torch finds it, else the processor
DeviceName = Literal["auto", "cpu", "cuda"]
DEVICES: tuple[DeviceName, ...] = ("auto", "cpu", "cuda")
# not measured above; the same number gives the same results on all machines
MOST_THREADS = 2


def default_threads() -> int:
    """Return the number of threads for a training without other load."""
    return min(MOST_THREADS, os.cpu_count() or 1)


class JobMessage(BaseModel):
    """Base of all messages between the two processes."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")


class TrainingJob(JobMessage):
    """Train on the episodes of ``piece`` (None: the only one) in ``data``; write to ``out``.

    ``data``: dataset, with the ``labels`` to use, or folder of packs.
    """

    data: Path
    piece: str | None
    out: Path
    settings: TrainingSettings
    labels: LabelChoice = "approved"
    resume: bool = False
    # folder for the manifest of the training set and sample predictions
    keep: Path | None = None
    # More than one is faster only with as many free cores, and changes the last digits.
    threads: Annotated[int, Field(ge=1, le=64)] = 1
    device: DeviceName = "auto"


class TrainingLoaded(JobMessage):
    """The data are loaded. ``kept_together``: undivided unit (mounting, series or grip)."""

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
    """One epoch is finished; ``epoch`` counts from 1. Losses are mean BCE per point (nats).

    All but ``train_loss`` are measured on the validation side.
    """

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
    """The model was written."""

    kind: Literal["finished"] = "finished"
    out: Path
    weights_sha256: str
    best_epoch: int
    iou: float
    point_accuracy: float
    seconds: float


class TrainingCancelled(JobMessage):
    """Cancelled after ``done`` whole epochs; ``state`` resumes it."""

    kind: Literal["cancelled"] = "cancelled"
    done: int
    state: Path


class TrainingRefused(JobMessage):
    """Invalid input, with the fields of ``InputError``."""

    kind: Literal["refused"] = "refused"
    what: str
    where: str
    fix: str


TrainingReport = TrainingLoaded | TrainingEpoch | TrainingFinished | TrainingCancelled
TRAINING_REPORT: TypeAdapter[TrainingReport | TrainingRefused] = TypeAdapter(
    Annotated[TrainingReport | TrainingRefused, Field(discriminator="kind")]
)
ReportCallback = Callable[[TrainingReport], None]

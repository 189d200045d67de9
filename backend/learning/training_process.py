"""Training process as seen by its parent: start, job and report messages, cancel, early death.

The messages are JSON lines. ``training_child`` is the process itself.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from touchdown.backend.annotations import LabelChoice
from touchdown.backend.config import TrainingSettings
from touchdown.backend.core import Fault, FaultError, InputError
from touchdown.backend.learning.metrics import ReliabilityBin

# ``auto``: CUDA if torch finds it, else the processor
DeviceName = Literal["auto", "cpu", "cuda"]

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

    ``data``: dataset, with the ``labels`` to use, or folder of packs. ``pretrained``: model file to
    fine-tune. Episodes of ``mix`` are added, as the share ``mix_share`` of the training side.
    """

    data: Path
    piece: str | None
    out: Path
    settings: TrainingSettings
    labels: LabelChoice = "approved"
    pretrained: Path | None = None
    mix: Path | None = None
    mix_share: Annotated[float, Field(gt=0, lt=1)] = 0.5
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


EXIT_WAIT_S = 10.0
# Waiting threads sleep. By default they spin: two threads then took 9 times the processor time of
# one beside other load, asleep 1.04 times.
IDLE_THREADS = {"OMP_WAIT_POLICY": "PASSIVE"}


class TrainingProcess:
    """Child process that runs one job at low priority; ends with the ``with`` block.

    ``cancel`` may be called from another thread than ``reports``.
    """

    def __init__(self, job: TrainingJob) -> None:
        order = job.model_dump_json()  # fails for a path that is not UTF-8
        self._stderr = tempfile.TemporaryFile()  # noqa: SIM115 - closed by __exit__
        environment = IDLE_THREADS | os.environ
        self._child = subprocess.Popen(
            [sys.executable, "-m", "touchdown.backend.learning.training_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stderr,
            env=environment,
            text=True,
            encoding="utf-8",
        )
        self._send(order)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        """End the child and wait for it."""
        for pipe in (self._child.stdin, self._child.stdout):
            if pipe is not None:
                with suppress(BrokenPipeError):
                    pipe.close()
        try:
            self._child.wait(EXIT_WAIT_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()
        self._stderr.close()

    def reports(self) -> Iterator[TrainingReport]:
        """Yield the reports of the child until it ends.

        Raises ``InputError`` for invalid input, ``FaultError`` if the child dies.
        """
        assert self._child.stdout is not None
        last: object = None
        for line in self._child.stdout:
            report = TRAINING_REPORT.validate_json(line)
            if isinstance(report, TrainingRefused):
                raise InputError(report.what, report.where, report.fix)
            last = report
            yield report
        self._child.wait(EXIT_WAIT_S)
        if not isinstance(last, TrainingFinished | TrainingCancelled):
            raise FaultError(self._death())

    def cancel(self) -> None:
        """Stop after the current batch; whole epochs are kept for a resume."""
        self._send("cancel")

    def kill(self) -> None:
        """Kill the child; work since the last whole epoch is lost."""
        self._child.kill()

    def _send(self, line: str) -> None:
        assert self._child.stdin is not None
        with suppress(BrokenPipeError):
            self._child.stdin.write(line + "\n")
            self._child.stdin.flush()

    def _death(self) -> Fault:
        self._stderr.seek(0)
        lines = self._stderr.read().decode("utf-8", "replace").strip().splitlines()
        why = lines[-1] if lines else f"exit code {self._child.returncode}"
        return Fault(
            "TRAINING-DIED",
            f"The training process ended early: {why}.",
            "There is no new model; whole epochs are kept.",
            "Free memory if it ran short, then train again with --resume.",
        )

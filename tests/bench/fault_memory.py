"""A training whose memory ends, or that is killed: told, and resumed to its end."""

from __future__ import annotations

import os
import resource
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.app.tiny_packs import write_tiny_packs
from tests.bench.registry import Figure, figure
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.learning.job import TrainingEpoch, TrainingJob
from touchdown.backend.learning.training_runs import TrainingProcess

EPOCHS = 6
ROOM_BYTES = 65_536
"""What a training may still take once its limit is set: less than a batch needs."""


def out_of_memory(number: int) -> None:
    """Let the process ``number`` take next to nothing more."""
    taken = psutil.Process(number).memory_info().vms
    resource.prlimit(number, resource.RLIMIT_AS, (taken // 2, taken // 2))
    resource.prlimit(number, resource.RLIMIT_DATA, (ROOM_BYTES, ROOM_BYTES))


def killed(number: int) -> None:
    """Kill the process ``number``, as a system without memory does."""
    os.kill(number, signal.SIGKILL)


WAYS: dict[str, Callable[[int], None]] = {"no memory left": out_of_memory, "killed": killed}


@figure("faults")
def trainings_without_memory() -> list[Figure]:
    """The limit of a training's memory is reached, or the system kills it; then it is resumed."""
    broken, said = list[str](), list[str]()
    for way, strike in WAYS.items():
        with tempfile.TemporaryDirectory() as name:
            data, out = Path(name) / "packs", Path(name) / "pot.safetensors"
            data.mkdir()
            write_tiny_packs(data)
            settings = TrainingSettings(hidden=256, layers=2, epochs=EPOCHS, batch=8)
            job = TrainingJob(data=data, piece="pot", out=out, settings=settings)
            epochs, code = 0, ""
            try:
                with TrainingProcess(job) as training:
                    for report in training.reports():
                        epochs += isinstance(report, TrainingEpoch)
                        if epochs == 1 and isinstance(report, TrainingEpoch):
                            strike(training.number)
            except FaultError as error:
                code = error.fault.code
                said.append(error.fault.what)
            if code != "TRAINING-DIED" or out.exists():
                broken.append(f"{way}: {code or 'not told'} after {epochs} epochs")
            with TrainingProcess(job.model_copy(update={"resume": True})) as training:
                more = sum(isinstance(report, TrainingEpoch) for report in training.reports())
            if not 0 < more < EPOCHS or load_checkpoint(out).card.piece != "pot":
                broken.append(f"{way}: resumed with {more} epochs")
    told = "; ".join([*broken, *said])
    name = "trainings without memory or killed: not told, or not resumed"
    return [Figure(name, len(broken), f"of {len(WAYS)}", "0", not broken, told)]

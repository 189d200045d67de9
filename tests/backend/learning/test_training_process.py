"""Training in a child process: completion, cancelling, resuming, refusal, crash."""

from collections.abc import Callable
from pathlib import Path

import pytest

from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.learning.fitting import fit_model
from touchdown.backend.learning.job import (
    TrainingCancelled,
    TrainingEpoch,
    TrainingFinished,
    TrainingJob,
    TrainingLoaded,
)
from touchdown.backend.learning.training import resume_path
from touchdown.backend.learning.training_runs import TrainingProcess

Data = Callable[[Path], Path]


def job(data: Path, out: Path, **changes: object) -> TrainingJob:
    settings = TrainingSettings(hidden=12, epochs=3, batch=8, validation_share=0.25)
    fields = {"data": data, "piece": "pot", "out": out, "settings": settings, "threads": 1}
    return TrainingJob.model_validate(fields | changes)


@pytest.mark.cold_start
def test_the_child_trains_and_equals_training_here(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data")
    out = tmp_path / "pot.safetensors"
    with TrainingProcess(job(data, out)) as training:
        reports = list(training.reports())
    assert [type(r) for r in reports] == [
        TrainingLoaded,
        TrainingEpoch,
        TrainingEpoch,
        TrainingEpoch,
        TrainingFinished,
    ]
    assert isinstance(reports[0], TrainingLoaded)
    assert (reports[0].episodes, reports[0].points, reports[0].kept_together) == (24, 177, "series")
    card = load_checkpoint(out).card
    assert card.data["episodes"] == {"circle15": 12, "short": 12}
    assert not resume_path(out).exists()

    here = tmp_path / "here.safetensors"
    told: list[object] = []
    fit_model(job(data, here), told.append, lambda: False)
    assert told[:-1] == reports[:-1]
    assert here.read_bytes() == out.read_bytes()


@pytest.mark.promise("W14")
def test_cancelled_then_resumed_equals_uninterrupted(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data")
    whole, parts = tmp_path / "whole.safetensors", tmp_path / "parts.safetensors"
    fit_model(job(data, whole), lambda _: None, lambda: False)

    told: list[object] = []
    fit_model(job(data, parts), told.append, lambda: len(told) >= 2)
    assert isinstance(told[-1], TrainingCancelled)
    assert told[-1].done == 1
    assert not parts.exists()
    fit_model(job(data, parts, resume=True), told.append, lambda: False)
    assert isinstance(told[-1], TrainingFinished)
    assert parts.read_bytes() == whole.read_bytes()


def test_the_child_stops_when_asked(tmp_path: Path, write_data: Data) -> None:
    settings = TrainingSettings(hidden=12, epochs=100_000, patience=100_000, batch=8)
    endless = job(write_data(tmp_path / "data"), tmp_path / "pot.safetensors", settings=settings)
    reports = []
    with TrainingProcess(endless) as training:
        for report in training.reports():
            reports.append(report)
            if len(reports) == 3:
                training.cancel()
    assert isinstance(reports[-1], TrainingCancelled)
    assert reports[-1].done >= 2
    assert reports[-1].state.exists()


def test_the_child_ends_with_its_parent_block(tmp_path: Path, write_data: Data) -> None:
    settings = TrainingSettings(hidden=12, epochs=100_000, patience=100_000, batch=8)
    endless = job(write_data(tmp_path / "data"), tmp_path / "pot.safetensors", settings=settings)
    with TrainingProcess(endless) as training:
        next(training.reports())
    assert training._child.returncode is not None


def test_bad_input_of_the_child_is_an_input_error_here(tmp_path: Path) -> None:
    (tmp_path / "bad.mcap").write_bytes(b"not at all")
    with (
        TrainingProcess(job(tmp_path, tmp_path / "pot.safetensors")) as training,
        pytest.raises(InputError, match="not an MCAP file") as error,
    ):
        list(training.reports())
    assert error.value.where == str(tmp_path / "bad.mcap")


@pytest.mark.promise("P7", "P10")
def test_a_child_that_dies_is_a_fault_with_the_next_step(tmp_path: Path, write_data: Data) -> None:
    settings = TrainingSettings(hidden=12, epochs=100_000, patience=100_000, batch=8)
    endless = job(write_data(tmp_path / "data"), tmp_path / "pot.safetensors", settings=settings)
    with TrainingProcess(endless) as training:
        reports = training.reports()
        next(reports)
        training._child.kill()
        with pytest.raises(FaultError, match="--resume"):
            list(reports)


def test_a_wrong_ending_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="safetensors"):
        fit_model(job(tmp_path, tmp_path / "pot.pt"), lambda _: None, lambda: False)

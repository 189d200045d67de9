"""Trainings recorded as runs, whatever process has the dataset open."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from tests.backend.catalogue.test_packs_in_datasets import write_pack
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.run_tracking import RunInfo
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.learning.checkpoint import load_card
from touchdown.backend.learning.job import TrainingCancelled, TrainingEpoch, TrainingJob
from touchdown.backend.learning.training_runs import (
    CURVES,
    TrainingProcess,
    record_report,
    record_training,
)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    Dataset.open(folder).close()
    write_pack(folder / "packs" / "a.mcap", 24)
    Dataset.open(folder).close()
    return folder


def job(folder: Path, **changes: Any) -> TrainingJob:
    settings = TrainingSettings(hidden=12, epochs=changes.pop("epochs", 2), batch=8, patience=9,
                                divide_series=True)  # fmt: skip
    fields = {"data": folder, "piece": "pot", "out": folder.parent / "pot.safetensors"}
    return TrainingJob.model_validate(
        {**fields, "settings": settings, "labels": "drafts", **changes}
    )


def only_run(folder: Path) -> RunInfo:
    with Dataset.open(folder, write=False) as dataset:
        (run,) = dataset.runs.entries("train")
        return run


def test_the_train_verb_records_its_run(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = folder.parent / "pot.safetensors"
    words = [
        "train",
        str(folder),
        "--labels",
        "drafts",
        "--epochs",
        "2",
        "--seed",
        "5",
        "--divide-series",
    ]
    assert main([*words, "--out", str(out), "--json"]) == 0
    answer = json.loads(capfd.readouterr().out)
    run = only_run(folder)
    assert (run.uuid, run.state, run.seed) == (answer["run"], "finished", 5)
    assert (run.params["epochs"], run.params["labels"]) == (2, "drafts")
    (model,) = [made for made in run.artifacts if made.name == "model"]
    assert model.sha256 == sha256(out.read_bytes()).hexdigest()
    assert run.manifest == load_card(out).manifest_sha256 != ""
    with Dataset.open(folder, write=False) as dataset:
        for name in CURVES:
            kept = [m.value for m in dataset.runs.metrics(run.uuid, name)]
            assert kept == [epoch[name] for epoch in answer["curve"]]


def test_a_dataset_that_is_open_elsewhere_gets_its_run_too(folder: Path) -> None:
    with Dataset.open(folder) as window:
        asked = job(folder)
        with record_training(asked, pytest.fail) as run, TrainingProcess(asked) as training:
            assert run is not None
            states = set()
            for report in training.reports():
                record_report(run, report)
                states.add(window.runs.entry(run.uuid).state)
        assert states == {"running", "finished"}
        assert len(window.runs.metrics(run.uuid, "iou")) == 2


def test_a_cancelled_training_is_a_cancelled_run(folder: Path) -> None:
    asked = job(folder, epochs=100_000)
    with record_training(asked, lambda _: None) as run, TrainingProcess(asked) as training:
        assert run is not None
        for report in training.reports():
            record_report(run, report)
            if isinstance(report, TrainingEpoch):
                training.cancel()
    assert isinstance(report, TrainingCancelled)
    assert only_run(folder).state == "cancelled"


def test_a_killed_child_is_a_failed_run(folder: Path) -> None:
    asked = job(folder, epochs=100_000)

    def train() -> None:
        with record_training(asked, lambda _: None) as run, TrainingProcess(asked) as training:
            assert run is not None
            for report in training.reports():
                record_report(run, report)
                training._child.kill()

    with pytest.raises(FaultError):
        train()
    assert only_run(folder).state == "failed"
    assert "ended early" in only_run(folder).reason


def test_refused_data_is_a_failed_run_and_packs_alone_have_none(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = str(folder.parent / "m.safetensors")
    assert main(["train", str(folder), "--out", out]) == 2
    assert "label" in only_run(folder).reason
    capfd.readouterr()
    words = ["--epochs", "1", "--divide-series", "--out", out, "--json"]
    assert main(["train", str(folder / "packs"), *words]) == 0
    assert "run" not in json.loads(capfd.readouterr().out)

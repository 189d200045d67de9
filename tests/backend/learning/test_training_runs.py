"""Recorded trainings: curves, model, manifest, samples, and resuming."""

from __future__ import annotations

import json
import resource
from collections.abc import Callable
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from tests.backend.annotations.test_packs_in_datasets import write_pack
from touchdown.backend.annotations import Dataset, RunInfo
from touchdown.backend.cli.command_line import main
from touchdown.backend.config.method import TrainingSettings
from touchdown.backend.core import program_stamp, program_version
from touchdown.backend.core.faults import FaultError, InputError
from touchdown.backend.episodes.training_rows import load_rows
from touchdown.backend.learning import (
    ModelRegistry,
    RecordedTraining,
    TrainingCancelled,
    TrainingCandidate,
    TrainingEpoch,
    TrainingFinished,
    TrainingLoaded,
    TrainingRequest,
    list_training_runs,
    load_card,
    load_samples,
    read_training_run,
    resume_request,
    save_card,
    training_candidates,
    training_set_overview,
)
from touchdown.backend.learning.metrics import calibration_error, reliability
from touchdown.backend.learning.training_process import TrainingJob, TrainingProcess
from touchdown.backend.learning.training_runs import CURVES, record_report, record_training

Data = Callable[[Path, int], Path]
SMALL = TrainingSettings(hidden=12, epochs=3, batch=8, validation_share=0.25)
ENDLESS = SMALL.model_copy(update={"epochs": 100_000, "patience": 100_000})


def test_a_finished_training_is_kept_whole(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data", 24)
    training = RecordedTraining(TrainingRequest(data, "pot", SMALL))
    reports = list(training.reports())
    assert [type(r) for r in reports] == [TrainingLoaded, *3 * [TrainingEpoch], TrainingFinished]
    (run,) = list_training_runs(data)
    epochs = [r for r in reports if isinstance(r, TrainingEpoch)]
    assert run.state == "finished"
    assert run.curves["iou"] == tuple((e.epoch, e.iou) for e in epochs)
    assert run.reliability[2] == epochs[1].reliability
    assert run.value("calibration_error", 3) == calibration_error(epochs[2].reliability)
    assert run.best_epoch == epochs[-1].best_epoch
    assert run.card is not None
    assert run.about.params["piece"] == "pot"
    assert (run.card.program_version, run.about.program) == (program_version(), program_stamp())
    manifest = (run.folder / "manifest.json").read_bytes()
    assert run.card.manifest_sha256 == run.about.manifest == sha256(manifest).hexdigest()
    sides = [e["split"] for e in json.loads(manifest)["episodes"]]
    held_out = next(r for r in reports if isinstance(r, TrainingLoaded)).held_out
    assert sides.count("held out") == held_out
    figures = run.card.metrics["validation"]
    bottoms = figures["bottoms"]
    assert sum(b["episodes"] for b in bottoms.values()) == held_out
    mean = sum(b["episodes"] * b["iou"] for b in bottoms.values()) / held_out
    assert mean == pytest.approx(figures["iou"], abs=1e-4)
    samples = load_samples(run.folder)
    truth = {str(label["episode"]): i for i, label in enumerate(load_rows(data).labels)}
    assert [s.iou for s in samples] == sorted((s.iou for s in samples), reverse=True)
    assert all(
        np.array_equal(s.truth, load_rows(data).patch[truth[s.episode]]) for s in samples[:2]
    )
    assert not run.can_resume


@pytest.mark.promise("W14")
def test_cancelled_and_gone_on_with_equals_uninterrupted(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data", 24)
    longer = SMALL.model_copy(update={"epochs": 40, "patience": 40})
    whole = RecordedTraining(TrainingRequest(data, "pot", longer))
    list(whole.reports())
    first = RecordedTraining(TrainingRequest(data, "pot", longer))
    for report in first.reports():
        if isinstance(report, TrainingEpoch) and report.epoch == 2:
            first.cancel()
    cut = read_training_run(first.folder)
    assert isinstance(report, TrainingCancelled)
    assert report.state.exists()
    assert (cut.state, cut.can_resume) == ("cancelled", True)
    second = RecordedTraining(resume_request(cut, data))
    list(second.reports())
    one, two = read_training_run(whole.folder), read_training_run(second.folder)
    assert two.about.params["resumed"] == cut.uuid
    assert two.curves == one.curves
    assert two.reliability == one.reliability
    assert two.model.read_bytes() == one.model.read_bytes()
    with pytest.raises(InputError, match="cannot be continued"):
        resume_request(two, data)


def _take_memory(pid: int) -> None:
    """Leave the process less than a batch; libraries reserve address space far beyond that."""
    taken = psutil.Process(pid).memory_info().vms
    resource.prlimit(pid, resource.RLIMIT_AS, (taken // 2, taken // 2))
    resource.prlimit(pid, resource.RLIMIT_DATA, (65_536, 65_536))


@pytest.mark.promise("P7", "P10")
@pytest.mark.parametrize("way", ["killed", "no memory left"])
def test_a_child_that_dies_leaves_a_failed_run_that_can_be_resumed(
    tmp_path: Path, write_data: Data, way: str
) -> None:
    data = write_data(tmp_path / "data", 24)
    longer = TrainingSettings(hidden=256, layers=2, epochs=12, batch=8, patience=12)
    training = RecordedTraining(TrainingRequest(data, "pot", longer))
    reports = training.reports()
    assert isinstance([next(reports), next(reports)][1], TrainingEpoch)
    assert training._child is not None
    if way == "killed":
        training._child._child.kill()
    else:
        _take_memory(training._child.pid)
    with pytest.raises(FaultError, match=r"ended early.*--resume") as error:
        list(reports)
    assert error.value.fault.code == "TRAINING-DIED"
    (run,) = list_training_runs(data)
    assert (run.state, run.can_resume) == ("failed", True)
    assert "ended early" in run.about.reason
    epochs = sum(
        isinstance(report, TrainingEpoch)
        for report in RecordedTraining(resume_request(run, data)).reports()
    )
    assert 0 < epochs < 12


def test_a_refusal_is_kept_as_the_reason(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data", 24)
    with pytest.raises(InputError, match="of 'barrel'"):
        list(RecordedTraining(TrainingRequest(data, "barrel", SMALL)).reports())
    (run,) = list_training_runs(data)
    assert (run.state, run.can_resume) == ("failed", False)


def test_reliability_of_known_probabilities() -> None:
    probability = np.array([[0.05, 0.05, 0.95, 1.0]])
    truth = np.array([[False, True, True, True]])
    bins = reliability(probability, truth)
    assert bins == ((0.05, 0.5, 2), (0.975, 1.0, 2))
    assert calibration_error(bins) == pytest.approx((2 * 0.45 + 2 * 0.025) / 4)
    rng = np.random.default_rng(1)
    p = rng.uniform(size=(400, 500))
    assert calibration_error(reliability(p, rng.uniform(size=p.shape) < p)) < 0.01


def test_the_overview_counts_what_training_will_see(tmp_path: Path, write_data: Data) -> None:
    data = write_data(tmp_path / "data", 24)
    seen = training_set_overview(training_candidates(data, "approved"), "", 0.25, 0)
    (loaded, *_) = RecordedTraining(TrainingRequest(data, "pot", SMALL)).reports()
    assert isinstance(loaded, TrainingLoaded)
    assert (seen.piece, seen.train + seen.held_out) == ("pot", loaded.episodes)
    assert (seen.held_out, seen.kept_together) == (loaded.held_out, loaded.kept_together)
    assert [(p.bottom, p.train + p.held_out) for p in seen.pairs] == [
        ("circle15", 12),
        ("short", 12),
    ]
    assert seen.kept_together == "series"
    assert not any("Leakage" in words for words in seen.warnings)
    leaking = training_set_overview(
        training_candidates(data, "approved"), "", 0.25, 0, divide_series=True
    )
    assert leaking.kept_together == "grip"
    assert leaking.warnings[0].startswith("Leakage: ")
    assert "on both sides" in leaking.warnings[0]


def of(count: int, mountings: int, content: str = "") -> list[TrainingCandidate]:
    return [
        TrainingCandidate("pot", "short", f"g{i}", f"m{i % mountings}", content or f"{i}")
        for i in range(count)
    ]


def test_leakage_is_told() -> None:
    whole = training_set_overview(of(400, 40), "pot", 0.1, 0)
    assert (whole.kept_together, whole.warnings) == ("mounting", ())
    twins = training_set_overview(of(400, 40, "same"), "pot", 0.1, 0)
    assert "a copy in training" in twins.warnings[0]
    single = training_set_overview([TrainingCandidate("pot", "short", "g", "m")] * 9, "pot", 0.1, 0)
    assert "one series only of pot on short" in single.error
    assert "Collect another campaign" in single.error
    assert single.pairs[0].train == 9
    assert training_set_overview([], "", 0.1, 0).error


def test_few_held_out_episodes_are_counted_in_words() -> None:
    ends = []
    for share in (0.1, 0.2):
        warnings = training_set_overview(of(10, 10), "pot", share, 0).warnings
        ends += [said.partition(" held out")[0] for said in warnings if said.startswith("Only")]
    assert ends == ["Only 1 episode is", "Only 2 episodes are"]


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
    words = ["train", str(folder), "--labels", "drafts", "--epochs", "2", "--seed", "5"]
    assert main([*words, "--divide-series", "--out", str(out), "--json"]) == 0
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
    # Its model, outside the dataset, can be promoted, until a later one takes its file.
    shown = read_training_run(folder / "runs" / run.uuid)
    assert (shown.model, shown.card, shown.piece) == (out, load_card(out), "pot")
    use = ModelRegistry(folder.parent / "models").promote(shown.model)
    assert use.weights_sha256 == model.sha256
    save_card(out, load_card(out).model_copy(update={"weights_sha256": 64 * "0"}))
    assert read_training_run(shown.folder).card is None


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

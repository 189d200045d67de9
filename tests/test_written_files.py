"""Files written by version 0.1.0 stay readable, with the values that were written.

The files lie in ``tests/data/written_0_1`` (its README.md says how they were made). They are never
written anew: where a test fails, the program must learn to read the older file.
"""

import json
import shutil
import sqlite3
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.backend.annotations.conftest import stored_label
from tests.backend.runs.test_event_log import ALL, same
from touchdown.app.application import TouchdownApp
from touchdown.app.shell import ErrorBox, load_settings
from touchdown.app.shell.layouts import load_layouts
from touchdown.backend.annotations import Dataset, EpisodeFilter, Label, check_dataset
from touchdown.backend.annotations.backups import check_backup, list_backups, restore_backup
from touchdown.backend.calibration.records import CalibrationStore, read_record
from touchdown.backend.cli.command_line import main
from touchdown.backend.cli.settings import load_method
from touchdown.backend.config.lab import load_lab
from touchdown.backend.core import InputError, RefusedError, events, values
from touchdown.backend.episodes.training_rows import load_rows
from touchdown.backend.learning.checkpoint import load_checkpoint
from touchdown.backend.learning.metrics import load_samples
from touchdown.backend.learning.registry import ModelRegistry
from touchdown.backend.learning.training import load_network
from touchdown.backend.learning.training_process import TrainingEpoch
from touchdown.backend.learning.training_runs import (
    RecordedTraining,
    TrainingRun,
    list_training_runs,
    resume_request,
)
from touchdown.backend.runs.event_log import read_events

WRITTEN = Path(__file__).parent / "data" / "written_0_1"
NOW = datetime(2026, 11, 30, 12, tzinfo=UTC)
OFFSETS_UM = [(-1588, 8245), (7500, -2100), (-3164, 3853), (3857, 8980)]
STATES = ["approved", "draft", "submitted", "draft"]
OF_OPENING = (".lock", "-shm", "-wal")  # files that an opened dataset has beside its data


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The dataset, unpacked in a folder of this test."""
    shutil.unpack_archive(WRITTEN / "dataset.zip", tmp_path / "dataset")
    return tmp_path / "dataset"


@pytest.fixture
def dataset(folder: Path) -> Iterator[Dataset]:
    with Dataset.open(folder, create=False, person="ann") as opened:
        yield opened


@pytest.fixture
def uuids(dataset: Dataset) -> list[str]:
    return [entry.uuid for entry in dataset.episodes()]


def test_a_dataset_opens_without_a_finding(folder: Path) -> None:
    with Dataset.open(folder, create=False, write=False) as dataset:
        assert dataset.notices == ()
        assert list(check_dataset(dataset.parts, whole=True)) == []
        assert [entry.state for entry in dataset.episodes()] == STATES
        assert dataset.description.schema_version == 4
        assert dataset.description.created_by == "touchdown 0.1.0"
        assert dataset.people() == ["ann", "bob", "cleo", "dora"]


def test_entries_say_what_was_collected(dataset: Dataset) -> None:
    entries = dataset.episodes(EpisodeFilter(piece="pot", bottom="circle15", person="cleo"))
    assert len(entries) == 4
    assert [entry.plan_item for entry in entries] == [0, 1, 2, 3]
    assert len({entry.campaign for entry in entries}) == 1
    assert [entry.mounting_id[-1] for entry in entries] == ["1", "1", "2", "2"]
    assert all(entry.quality.accepted and not entry.adopted for entry in entries)
    assert all(entry.file_state == "complete" for entry in entries)
    assert [entry.flagged for entry in entries] == [False, False, True, False]
    (campaign,) = (dataset.folder / "campaigns").glob("*.json")
    assert campaign.stem == entries[0].campaign


def test_labels_keep_state_source_and_history(dataset: Dataset, uuids: list[str]) -> None:
    heads = [dataset.labels.head(uuid) for uuid in uuids]
    assert [(h.label.x_um, h.label.y_um) for h in heads] == OFFSETS_UM
    assert [h.label.sigma_um for h in heads] == [150, 250, 150, 150]
    assert [h.source for h in heads] == ["measured", "human", "measured", "measured"]
    assert (heads[1].verdict, heads[1].note) == ("unstable", "by eye")
    history = dataset.labels.history(uuids[1])
    assert sorted(r.state for r in history) == ["draft", "draft", "draft", "rejected", "submitted"]
    assert [r.reason for r in history if r.state == "rejected"] == ["disturbed"]
    assert dataset.labels.marks(uuids[2]) == {"flag": "look again"}
    assert set(dataset.labels.marks(uuids[3])) == {"spare", "skipped"}


def test_operations_keep_their_verbs_and_the_chain_goes_on(
    dataset: Dataset, uuids: list[str]
) -> None:
    verbs = Counter(operation.verb for operation in dataset.labels.log())
    assert verbs == {
        "record": 4, "label.take_over": 3, "label.accept_next": 3, "approve": 1, "reject": 1,
        "label.opinion": 1, "label.set": 1, "flag": 1, "tag": 1, "skip": 1, "delete": 1, "undo": 1,
    }  # fmt: skip
    dataset.labels.set("ann", uuids[1], Label(7400, -2000, 0, 200))
    assert dataset.labels.undo("ann") is not None
    assert dataset.labels.head(uuids[1]).label.x_um == 7500
    assert dataset.labels.undo("ann") is not None
    assert set(dataset.labels.marks(uuids[3])) == {"spare"}
    assert list(check_dataset(dataset.parts, whole=True)) == []


def test_geometry_gives_the_same_patches(dataset: Dataset, uuids: list[str]) -> None:
    patches = [dataset.patch(uuid) for uuid in uuids]
    assert {len(patch.points_mm) for patch in patches} == {177}
    assert [int(patch.touching.sum()) for patch in patches] == [58, 62, 105, 41]


def test_an_episode_file_keeps_signals_pictures_and_label(
    dataset: Dataset, uuids: list[str]
) -> None:
    episode = dataset.read(uuids[0])
    recording = episode.recording
    assert episode.observation.shape == (20, 258)
    assert episode.observation[-1, -6:] == pytest.approx(
        [0.2704, 0.8503, 7.6133, 0.0845, -0.0166, -0.0094], abs=1e-4
    )
    assert episode.offset_mm == pytest.approx([-1.58806, 8.24518], abs=1e-4)
    assert episode.onset_s == pytest.approx(10.22133, abs=1e-4)
    assert recording.wrench.shape == (60, 6)
    assert recording.pose_mm.shape == recording.command_mm.shape == (24, 3)
    assert Counter(field.finger for field in recording.fields) == {"left": 2, "right": 2}
    assert {field.position_px.shape for field in recording.fields} == {(63, 2)}
    assert dict(episode.metadata)["recorded_as"] == "4958185b8892a30158d96789d122cac2"
    film = dataset.film(uuids[0])
    picture = film.pictures["left"].picture(0)
    assert picture.shape == (240, 320, 3)
    assert picture.mean() == pytest.approx(89.3, abs=0.5)
    assert film.pictures["right"].packed == ()
    assert [scene.image.shape for scene in recording.scene] == [(480, 640, 3)]
    label = stored_label(dataset.path(uuids[0]))
    assert (label["x_um"], label["y_um"], label["person"]) == (-1588, 8245, "cleo")


def test_a_backup_is_whole_and_can_be_gone_back_to(folder: Path) -> None:
    (backup,) = list_backups(folder / "backup")
    assert backup.made.year == 2026
    heads = check_backup(backup.path)
    with Dataset.open(folder, create=False, write=False) as dataset:
        assert {site: head for site, (_, head) in heads.items()} == dataset.labels.chain_heads()
    (folder / "catalog.db").unlink()
    restore_backup(folder, backup.path)
    with Dataset.open(folder, create=False, write=False) as dataset:
        assert [entry.state for entry in dataset.episodes()] == STATES


def test_the_catalogue_can_be_rebuilt_from_the_files(
    folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert main(["dataset", "rebuild", "--dataset", str(folder), "--json"]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert answer["equal"]
    assert (answer["rows"]["op"], answer["rows"]["opinion"]) == (19, 1)
    assert answer["rows"]["label_head"] == answer["rows"]["episode"] == 4


@pytest.fixture
def trainings(folder: Path) -> dict[str, TrainingRun]:
    return {run.state: run for run in list_training_runs(folder)}


def test_a_finished_training_keeps_curves_model_and_samples(
    trainings: dict[str, TrainingRun],
) -> None:
    run = trainings["finished"]
    assert run.about.params["hidden"] == 4
    assert [epoch for epoch, _ in run.curves["iou"]] == [1, 2]
    assert run.curves["validation_loss"][-1][1] == pytest.approx(0.73525, abs=1e-4)
    assert run.best_epoch == 2
    assert sorted(run.reliability) == [1, 2]
    assert run.card is not None
    assert run.card.weights_sha256 == load_checkpoint(run.model).card.weights_sha256
    samples = load_samples(run.folder)
    assert {len(sample.truth) for sample in samples} == {177}


def test_a_cancelled_training_goes_on(folder: Path, trainings: dict[str, TrainingRun]) -> None:
    cut = trainings["cancelled"]
    done = len(cut.curves["iou"])
    assert cut.can_resume
    again = RecordedTraining(resume_request(cut, folder))
    epochs = []
    for report in again.reports():
        if isinstance(report, TrainingEpoch):
            epochs.append(report.epoch)
            again.cancel()
    assert epochs[0] == done + 1


def test_a_dataset_lists_its_trainings(dataset: Dataset) -> None:
    assert sorted(about.state for about in dataset.runs.entries("train")) == [
        "cancelled",
        "finished",
    ]
    finished = next(a for a in dataset.runs.entries() if a.state == "finished")
    assert {metric.name for metric in dataset.runs.metrics(finished.uuid)} >= {"iou", "train_loss"}


def test_a_model_answers_as_it_did_and_its_history_is_known() -> None:
    registry = ModelRegistry(WRITTEN / "models")
    path = registry.in_use("pot")
    assert path is not None
    checkpoint = load_checkpoint(path)
    card = checkpoint.card
    assert (card.piece, card.modality, card.program_version) == ("pot", "FT+Tac", "0.1.0")
    assert (card.hyper.inputs, card.hyper.hidden, card.hyper.layers) == (258, 4, 1)
    assert card.hyper.points == 177
    assert [events.mode for events in card.benches] == ["simulated"]
    with torch.no_grad():
        said = load_network(checkpoint)(torch.linspace(-1, 1, 20 * 258).reshape(1, 20, 258))
    assert said.shape == (1, 177)
    assert float(said.mean()) == pytest.approx(-0.04522, abs=1e-4)
    assert float(said[0, 0]) == pytest.approx(-0.56979, abs=1e-4)
    uses = [(use.action, use.person, use.run) for use in registry.history("pot")]
    assert uses == [("promote", "ann", "first"), ("roll back", "bob", ""), ("promote", "ann", "")]
    assert registry.hardware_probes(registry.history("pot")[-1].weights_sha256) == 12
    assert registry.before("pot") == ""


def test_a_simulated_pack_trains() -> None:
    rows = load_rows(WRITTEN / "pack", "pot")
    assert rows.observation.shape == (2, 20, 258)
    assert rows.bottom == ("circle15", "circle15")
    assert rows.offset_mm == pytest.approx(np.array([[4.318, 9.354], [-3.919, 5.728]]))
    assert rows.patch.sum(axis=1).tolist() == [35, 76]
    assert rows.observation.mean() == pytest.approx(-3.01914, abs=1e-5)


def test_the_log_of_a_stacked_piece_is_read_to_its_end_with_what_the_method_thought() -> None:
    log = list(read_events(WRITTEN / "runs" / "stacked"))
    started, finished = log[0], log[-1]
    assert isinstance(started, events.RunStarted)
    assert (started.piece, started.bottom, started.strategy) == ("pot", "short", "paper")
    assert (started.seed, started.trials, started.simulated) == (2, 1, True)
    assert json.loads(started.settings)["method"]["belief"]["half_extent_mm"] == 16.0
    assert isinstance(finished, events.RunFinished)
    assert finished.ending == "finished"
    (trial,) = [event for event in log if isinstance(event, events.TrialFinished)]
    assert (trial.outcome, trial.probes, trial.seed) == (values.Outcome.PLACED, 2, 2)
    assert trial.margin_mm == pytest.approx(2.52938, abs=1e-4)
    assert len(log) == 31
    actions = [event.action.kind for event in log if isinstance(event, events.ActionChosen)]
    assert actions == ["shift", "release"]
    beliefs = [event.belief for event in log if isinstance(event, events.BeliefUpdated)]
    assert [belief.probes for belief in beliefs] == [1, 2]
    assert beliefs[-1].log_odds.shape == beliefs[-1].covered.shape == (33, 33)
    patches = [event.patch for event in log if isinstance(event, events.PatchEstimated)]
    assert [patch.probability.shape for patch in patches] == [(177,), (177,)]
    judged = [event.stability for event in log if isinstance(event, events.StabilityJudged)]
    assert [verdict.stable for verdict in judged] == [False, True]
    assert judged[0].support is values.SupportKind.AREA
    episodes = [event.episode for event in log if isinstance(event, events.EpisodeRecorded)]
    assert [episode.observation.shape for episode in episodes] == [(20, 258), (20, 258)]


def test_every_kind_of_event_is_read() -> None:
    log = list(read_events(WRITTEN / "runs" / "every-kind"))
    assert len(log) == 34
    assert [event for event in log if not any(same(event, known) for known in ALL)] == []


def test_a_lab_file_opens() -> None:
    lab = load_lab(WRITTEN / "lab.toml")
    settings = lab.settings
    assert (settings.name, settings.kind, settings.piece) == ("Second floor", "hardware", "pot")
    assert settings.limits.trip_n == 40.0
    assert "press_n" in (WRITTEN / "lab.toml").read_text("utf-8"), "a limit that was retired"
    assert (settings.melfa.host, settings.melfa.yaw_deg) == ("192.168.7.20", 90.0)
    assert settings.ft.driver == "dynpick"
    assert settings.gelsight.left.serial == "GSM00417"
    assert lab.calibrations == WRITTEN / "calibrations"


def test_calibrations_hold() -> None:
    store = CalibrationStore(WRITTEN / "calibrations", "simulated")
    standings = {standing.what: standing for standing in store.statuses({}, NOW)}
    assert {what for what, s in standings.items() if s.condition == "valid"} == {
        "payload", "wrist", "camera"
    }  # fmt: skip
    payload = standings["payload"].record.file
    assert payload.values["mass_kg"].value == pytest.approx(1.50037, abs=1e-5)
    assert (payload.person, payload.expires_days) == ("ann", 90)
    camera = standings["camera"].record.file
    assert {len(dots) for dots in camera.gels.values()} == {126}


def test_settings_of_the_method_are_kept() -> None:
    method = load_method(WRITTEN / "method.toml")
    assert method.belief.half_extent_mm == 16.0
    assert method.probe.depth_mm == 1.5
    assert method.policy.fallback == "best-cells"


def test_settings_of_the_window_are_kept() -> None:
    settings, warning = load_settings(WRITTEN / "window.json")
    assert warning == ""
    assert (settings.theme, settings.scale, settings.front) == ("light", 1.25, "review")
    assert sorted(settings.pages) == ["collect", "operate", "review", "stack", "train"]
    book, notice = load_layouts(WRITTEN / "layouts.json")
    assert notice == ""
    assert not book.locked
    assert book.saved["stack"]["no score"].hidden == {"Trials"}


def test_the_window_comes_up_as_it_was_left(qapp, qtbot, tmp_path: Path) -> None:
    for name in ("window.json", "layouts.json"):
        shutil.copy(WRITTEN / name, tmp_path)
    window = TouchdownApp(qapp, ErrorBox(), tmp_path / "window.json", tmp_path / "runs")
    try:
        for name in window.workspaces:
            window.go(name)
        assert window.cards.codes == ()
        assert window.look.theme.scale == 1.25
        window.layouts.choose("stack", "no score")
        assert window.workspaces["stack"].page.score.isHidden()
    finally:
        window.close()
        window.window.deleteLater()
        window.deleteLater()


@pytest.mark.parametrize("kind", ["csv", "coco"])
def test_exported_labels_come_in_unchanged(
    kind: str, folder: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    words = ["--dataset", str(folder), "--person", "eve", "--json"]
    assert main(["import", kind, str(WRITTEN / kind), *words]) == 0
    answer = json.loads(capfd.readouterr().out)
    assert (answer["changed"], answer["unchanged"], answer["refused"]) == (0, 4, [])
    assert answer["warnings"] == []


# -- downgrade: this version with the files of a newer one -----------------------------------------


@pytest.mark.parametrize(
    ("name", "old", "new", "read", "said"),
    [
        ("models/pot/*.json", "touchdown-model/1", "touchdown-model/2",
         lambda p: load_checkpoint(p.with_suffix(".safetensors")), "touchdown-model/1"),
        ("calibrations/payload-*.json", '"version": 1', '"version": 2', read_record, "version 1"),
        ("runs/stacked/journal.jsonl", '"format":1', '"format":2', lambda p: list(read_events(p)),
         "format 2 is not known"),
    ],
)  # fmt: skip
def test_a_file_of_a_newer_version_is_refused_by_name(tmp_path, name, old, new, read, said) -> None:
    shutil.copytree(WRITTEN, tmp_path / "data")
    (path,) = (tmp_path / "data").glob(name)
    text = path.read_text("utf-8").replace(old, new, 1)
    assert new in text
    path.write_text(text, "utf-8")
    with pytest.raises(InputError, match=said) as refused:
        read(path)
    assert path.name in refused.value.where
    assert path.read_text("utf-8") == text


@pytest.mark.parametrize(("name", "load"), [("window.json", load_settings), ("layouts.json", None)])
def test_settings_of_a_newer_version_are_kept_aside(tmp_path, name, load) -> None:
    raw = json.loads((WRITTEN / name).read_bytes()) | {"version": 99}
    path = tmp_path / name
    path.write_text(json.dumps(raw))
    _, warning = load(path) if load else load_layouts(path)
    assert "of another version" in warning
    (kept,) = tmp_path.glob("*-aside-*.json")
    assert json.loads(kept.read_bytes()) == raw
    assert kept.name in warning


def test_a_dataset_of_a_newer_version_is_exported_but_not_changed(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    about = json.loads((folder / "dataset.json").read_bytes())
    about |= {"schema_version": about["schema_version"] + 1, "created_by": "touchdown 0.9.0+ab"}
    (folder / "dataset.json").write_text(json.dumps(about))
    with closing(sqlite3.connect(folder / "catalog.db")) as catalogue:
        catalogue.execute(f"PRAGMA user_version = {about['schema_version']}")

    def files() -> dict[Path, bytes]:
        kept = (p for p in folder.rglob("*") if p.is_file() and not p.name.endswith(OF_OPENING))
        return {path: path.read_bytes() for path in kept}

    before = files()
    words = ["--dataset", str(folder)]
    assert main(["export", "csv", *words, "--out", str(tmp_path / "out"), "--states", "draft"]) == 0
    assert main(["import", "csv", str(WRITTEN / "csv"), *words, "--person", "eve"]) == 0
    said = "".join(capfd.readouterr())
    assert "was written by touchdown 0.9.0+ab (schema 5): open for reading only" in said
    with (
        Dataset.open(folder, create=False, person="ann") as newer,
        pytest.raises(RefusedError, match="reading only"),
    ):
        newer.labels.set("ann", newer.episodes()[0].uuid, Label(3, 4))
    assert files() == before

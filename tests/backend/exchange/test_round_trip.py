"""Export, import, export again: low-dimensional data bit by bit, labels and splits as they were."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.backend.catalogue.conftest import context_for
from tests.backend.exchange.conftest import Hand, recorded_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import InputError
from touchdown.backend.exchange.imports import EpisodeImport, ImportOptions

WISH = ImportOptions("dora")
FORMATS = ("lerobot", "robomimic")


def manifest_of(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "manifest.json").read_text("utf-8"))
    return content


def by_origin(dataset: Dataset) -> dict[str, str]:
    """Imported episode by the one it was exported from."""
    found = {entry.uuid: dict(dataset.read(entry.uuid).metadata) for entry in dataset.episodes()}
    return {facts["imported_as"]: uuid for uuid, facts in found.items()}


@pytest.mark.parametrize("kind", FORMATS)
def test_numbers_labels_and_splits_come_back(
    kind: str, dataset: Dataset, hand: Hand, tmp_path: Path
) -> None:
    first = hand(kind)
    with Dataset.open(tmp_path / "back") as back:
        written = EpisodeImport(back, kind, first.folder, WISH).write()
        assert len(written) == 6
        origin = by_origin(back)
        for entry in dataset.episodes():
            mine, theirs = dataset.read(entry.uuid), back.read(origin[entry.uuid])
            assert mine.observation.tobytes() == theirs.observation.tobytes()
            here, there = dataset.labels.head(entry.uuid), back.labels.head(theirs.episode_id)
            assert (there.label, there.source, there.geometry) == (
                here.label, here.source, here.geometry
            )  # fmt: skip
            assert (there.state, there.person) == ("draft", "dora")
            known = back.entry(theirs.episode_id)
            assert (known.mode, known.grip_id, known.piece) == ("imported", entry.grip_id, "pot")
        assert len({entry.series for entry in back.episodes()}) == 1
        hand(kind, "again", of=back)
    assert sides(first.folder) == {
        {new: old for old, new in origin.items()}[uuid]: side
        for uuid, side in sides(tmp_path / "again").items()
    }
    assert set(sides(first.folder).values()) == {"train", "held_out"}


def sides(folder: Path) -> dict[str, str]:
    return {episode["uuid"]: episode["split"] for episode in manifest_of(folder)["episodes"]}


def test_a_lerobot_dataset_made_again_has_the_same_bytes(hand: Hand, tmp_path: Path) -> None:
    first = hand("lerobot")
    with Dataset.open(tmp_path / "back") as back:
        EpisodeImport(back, "lerobot", first.folder, WISH).write()
        again = hand("lerobot", "again", of=back)
    for name in ("data/chunk-000/file-000.parquet", "meta/info.json", "meta/tasks.parquet"):
        assert (first.folder / name).read_bytes() == (again.folder / name).read_bytes()


def test_parquet_rows_are_the_recorded_numbers(dataset: Dataset, hand: Hand) -> None:
    """Read by pyarrow alone, compared with an interpolation of its own."""
    out = hand("lerobot").folder
    table = pq.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
    for listed in manifest_of(out)["episodes"]:
        rows = slice(20 * listed["export_index"], 20 * listed["export_index"] + 20)
        episode = dataset.read(listed["uuid"])
        assert episode.recording is not None
        assert set(table["episode_index"][rows]) == {listed["export_index"]}
        markers = np.array(table["observation.markers"][rows], np.float32)
        wrench = np.array(table["observation.ft"][rows], np.float32)
        assert np.concatenate([markers, wrench], 1).tobytes() == episode.observation.tobytes()
        offset = np.array(table["label.offset_mm"][rows][7], np.float32)
        assert np.rint(offset.astype(float) * 1e3).tolist() == [
            listed["label"]["x_um"], listed["label"]["y_um"]
        ]  # fmt: skip
        patch = dataset.patch(listed["uuid"]).touching
        assert np.array(table["label.patch"][rows][3], bool).tolist() == patch.tolist()
        t_s = episode.onset_s + 0.1 * np.arange(1, 21)
        recording = episode.recording
        x_m = np.interp(t_s, recording.pose_t_s, recording.pose_mm[:, 0]) / 1e3
        state = np.array(table["observation.state"][rows], np.float32)
        np.testing.assert_allclose(state[:, 0], x_m, atol=1e-7)
        told = [max(np.flatnonzero(recording.command_t_s <= t + 0.1 + 1e-9)) for t in t_s]
        action = np.array(table["action"][rows], np.float32)
        assert action[:, :3].tolist() == (recording.command_mm[told] / 1e3).astype("f4").tolist()
        assert action[:, 3:].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 20
        window = np.array(table["observation.ft_window"][rows], np.float32)
        latest = np.searchsorted(recording.wrench_t_s, t_s[4] + 1e-6, side="right") - 1
        assert window[4, -1].tolist() == recording.wrench[latest].astype(np.float32).tolist()


@pytest.mark.parametrize("kind", FORMATS)
def test_positions_are_metres_in_the_file_and_mm_after_an_import(
    kind: str, tmp_path: Path, hand: Hand
) -> None:
    """The arm stands at (120, -45, 31) mm and is told to go to (125, -50, 29) mm."""
    still = recorded_episode(5)
    assert still.recording is not None
    poses, told = (np.tile(at, (260, 1)) for at in ((120.0, -45.0, 31.0), (125.0, -50.0, 29.0)))
    still = replace(still, recording=replace(still.recording, pose_mm=poses, command_mm=told))
    with Dataset.open(tmp_path / "still") as dataset:
        label = Label(1500, -2750, 0, 3)
        dataset.record(still, label, source="measured", context=context_for(dataset))
        out = hand(kind, of=dataset).folder
    if kind == "lerobot":
        rows = pq.read_table(out / "data/chunk-000/file-000.parquet").to_pydict()
        state, action = rows["observation.state"][7], rows["action"][7]
    else:
        with h5py.File(out / "demos.hdf5", "r") as file:
            state, action = file["data/demo_0/obs/state"][7], file["data/demo_0/actions"][7]
    assert list(state) == pytest.approx([0.120, -0.045, 0.031, 0.0, 0.0, 0.0, 1.0])
    assert list(action) == pytest.approx([0.125, -0.050, 0.029, 0.0, 0.0, 0.0, 1.0])
    with Dataset.open(tmp_path / "back") as back:
        (uuid,) = EpisodeImport(back, kind, out, WISH).write()
        recording = back.read(uuid).recording
        assert recording is not None
        np.testing.assert_allclose(recording.pose_mm[7], (120.0, -45.0, 31.0), atol=1e-4)
        np.testing.assert_allclose(recording.command_mm[7], (125.0, -50.0, 29.0), atol=1e-4)
        assert back.labels.head(uuid).label.offset_mm.tolist() == [1.5, -2.75]


def test_without_commanded_poses_the_action_is_the_measured_one(
    dataset: Dataset, hand: Hand
) -> None:
    """One older episode makes it so for the whole export, and the manifest says it."""
    assert manifest_of(hand("lerobot", "told").folder)["feature_spec"]["action"] == "commanded"
    older = recorded_episode(70, commands=False)
    dataset.record(older, Label(1, 2, 0, 3), source="measured", context=context_for(dataset))
    done = hand("lerobot", "older")
    assert manifest_of(done.folder)["feature_spec"]["action"] == "measured"
    assert any("do not say the commanded pose" in warning for warning in done.warnings)
    table = pq.read_table(done.folder / "data/chunk-000/file-000.parquet").to_pydict()
    state, action = (np.array(table[key][:20]) for key in ("observation.state", "action"))
    assert action[:-1].tolist() == state[1:].tolist()


def test_actions_beyond_one_are_scaled_without_loss(tmp_path: Path, hand: Hand) -> None:
    far = recorded_episode(99)
    assert far.recording is not None
    far.recording.command_mm.flags.writeable = True
    far.recording.command_mm[:, 2] += 5300.0
    with Dataset.open(tmp_path / "far") as dataset:
        context = context_for(dataset)
        dataset.record(far, Label(1, 2, 0, 3), source="measured", context=context)
        out = hand("robomimic", "scaled", of=dataset).folder
        plain = hand("lerobot", "plain", of=dataset).folder
    with h5py.File(out / "demos.hdf5", "r") as file:
        scale = json.loads(file["data"].attrs["env_args"])["env_kwargs"]["action_scale"]
        actions = file["data/demo_0/actions"][()]
    assert scale == 8.0
    assert np.abs(actions).max() <= 1.0
    table = pq.read_table(plain / "data/chunk-000/file-000.parquet").to_pydict()
    assert (actions * np.float32(scale)).tolist() == np.array(table["action"], np.float32).tolist()


def test_importing_twice_adds_nothing(hand: Hand, tmp_path: Path, dataset: Dataset) -> None:
    out = hand("robomimic").folder
    with Dataset.open(tmp_path / "back") as back:
        assert len(EpisodeImport(back, "robomimic", out, WISH).write()) == 6
        survey = EpisodeImport(back, "robomimic", out, WISH).survey()
        assert (survey.found, survey.here, survey.fit) == (6, 6, 0)
    # In the dataset that it came from, the episodes themselves are there.
    survey = EpisodeImport(dataset, "robomimic", out, WISH).survey()
    assert (survey.here, survey.fit) == (6, 0)


def test_an_interrupted_import_goes_on(
    hand: Hand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = hand("lerobot").folder

    def stop(done: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with Dataset.open(tmp_path / "back") as back:
        with pytest.raises(KeyboardInterrupt):
            EpisodeImport(back, "lerobot", out, WISH).write(stop)
        assert len(EpisodeImport(back, "lerobot", out, WISH).write()) == 3
        assert len(back.episodes()) == 6


@pytest.mark.parametrize("kind", FORMATS)
def test_without_a_manifest_the_pair_has_to_be_named(kind: str, hand: Hand, tmp_path: Path) -> None:
    out = hand(kind).folder
    (out / "manifest.json").unlink()
    with Dataset.open(tmp_path / "back") as back:
        with pytest.raises(InputError, match="which pieces"):
            EpisodeImport(back, kind, out, WISH)
        wish = ImportOptions("dora", "dora", "pot", "circle15")
        EpisodeImport(back, kind, out, wish).write()
        heads = [back.labels.head(entry.uuid) for entry in back.episodes()]
        assert {head.label.x_um for head in heads} == {1000 * k - 2501 for k in range(6)}
        assert {(head.source, head.state) for head in heads} == {("human", "draft")}
    with Dataset.open(tmp_path / "nobody") as back:
        EpisodeImport(back, kind, out, ImportOptions("root", None, "pot", "circle15")).write()
        sources = {back.labels.head(entry.uuid).source for entry in back.episodes()}
        assert sources == {"measured"}


def test_a_changed_file_does_not_pass_for_the_export(hand: Hand, tmp_path: Path) -> None:
    out = hand("robomimic").folder
    data = bytearray((out / "demos.hdf5").read_bytes())
    data[len(data) // 2] ^= 1
    (out / "demos.hdf5").write_bytes(data)
    with (
        Dataset.open(tmp_path / "back") as back,
        pytest.raises(InputError, match="changed since it was exported"),
    ):
        EpisodeImport(back, "robomimic", out, WISH)

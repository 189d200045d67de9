"""Exports: selection, manifest, incomplete exports, and readers of other projects."""

from __future__ import annotations

import csv
import errno
import hashlib
import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import av
import cv2
import h5py
import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
import zarr
from mcap.reader import make_reader
from zarr.core.sync import cleanup_resources

from tests.backend.annotations.conftest import context_for, small_episode
from tests.backend.annotations.test_packs_in_datasets import write_pack
from tests.backend.exchange.conftest import EVERY, recorded_episode
from tests.backend.exchange.test_imports import manifest_of
from touchdown.backend.annotations import SPLIT_TAG, Dataset, Label, operation_log, review
from touchdown.backend.core import FaultError, InputError
from touchdown.backend.exchange import EXPORTS, EpisodeImport, ImportOptions, export, exports
from touchdown.backend.exchange.export_episode import common_signals, read_export
from touchdown.backend.exchange.features import STATE
from touchdown.backend.exchange.query import ExportQuery, SelectedEpisode, select_episodes
from touchdown.backend.exchange.robomimic import DiskFullSafeFile


@pytest.mark.parametrize("kind", EXPORTS)
def test_the_manifest_names_every_file_by_its_hash_and_is_the_same_again(kind, hand):
    out = hand(kind, "one").folder
    one, two = (manifest_of(folder) for folder in (out, hand(kind, "two").folder))
    assert one.pop("created_ns") < two.pop("created_ns")
    assert one == two
    files = [path for path in out.rglob("*") if path.is_file() and path.name != "manifest.json"]
    assert files
    assert {file["path"]: file["sha256"] for file in one["files"]} == {
        path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
    }


def test_the_manifest_says_where_it_comes_from(dataset, hand):
    content = manifest_of(hand("lerobot").folder)
    assert content["dataset_uuid"] == dataset.description.uuid
    assert content["site_heads"] == dataset.labels.chain_heads()
    assert content["label_states"] == {"approved": 4, "draft": 1, "submitted": 1}
    assert content["label_sources"] == {"measured": 6}
    for episode in content["episodes"]:
        assert episode["file_sha256"] == dataset.entry(episode["uuid"]).sha256
        assert episode["rev_uuid"] == dataset.labels.head(episode["uuid"]).rev_uuid
    numbers = sorted(k for side in content["splits"].values() for k in side)
    assert numbers == list(range(6))


def apart(chosen: tuple[SelectedEpisode, ...], *names: str) -> bool:
    """True if both sides have episodes, and share no value of these fields."""
    train, held_out = (
        {tuple(getattr(o.entry, name) for name in names) for o in chosen if o.split == side}
        for side in ("train", "held_out")
    )
    return bool(train and held_out) and not train & held_out


def test_grips_stay_on_one_side(dataset):
    query = ExportQuery(states=EVERY, held_out=0.4, divide_series=True)
    assert apart(select_episodes(dataset, query).chosen, "grip_id")


def tag(dataset: Dataset, uuids: list[str], side: str) -> None:
    with dataset.labels.commit() as connection:
        marks = [operation_log.read_mark(connection, u, f"{SPLIT_TAG}{side}", present=True)
                 for u in uuids]  # fmt: skip
        site, draft = dataset.description.site, operation_log.OperationDraft(marks=marks)
        _, touched = operation_log.append_operation(connection, site, "ann", "tag", draft)
        review.refresh_heads(connection, touched)


def test_a_pair_of_a_series_is_divided_only_where_somebody_says_so(dataset, hand):
    alone = select_episodes(dataset, ExportQuery(states=EVERY, held_out=0.4))
    assert {one.split for one in alone.chosen} == {"train"}
    assert alone.warnings[0].startswith("Nothing is held out. There is one series only of")
    first, *rest = [entry.uuid for entry in dataset.episodes()]
    tag(dataset, rest[:2], "held_out")
    with pytest.raises(InputError, match="1 pair of a series is on both sides") as refused:
        select_episodes(dataset, ExportQuery(states=EVERY))
    assert first in refused.value.where
    done = hand("csv", states=EVERY, divide_series=True)
    content = manifest_of(done.folder)
    assert content["warnings"] == list(done.warnings)
    assert content["warnings"][0].startswith("Leakage: 1 pair of a series is on both sides")
    assert content["query"]["resolved"]["divide_series"] is True
    assert len(content["splits"]["held_out"]) == 2


def test_whole_series_are_held_out(dataset):
    for number, bottom in enumerate(("circle15", "circle15", "hex20")):
        context = replace(context_for(dataset, "pot", bottom), mounting_id=f"mounting-{number}")
        for k in range(3):
            grip = replace(context, grip_id=f"{number}/{k}")
            dataset.record(recorded_episode(50 + 3 * number + k, frames=False), Label(1, 2, 0, 3),
                           source="measured", context=grip)  # fmt: skip
    selection = select_episodes(dataset, ExportQuery(states=EVERY, held_out=0.3))
    assert selection.warnings == ()
    assert apart(selection.chosen, "mounting_id", "bottom")


def test_states_choose_and_the_approved_label_counts(dataset):
    everything = [entry.uuid for entry in dataset.episodes()]
    chosen = select_episodes(dataset, ExportQuery()).chosen
    assert {o.entry.uuid for o in chosen} == set(everything[:4])
    before = dataset.labels.head(everything[0])
    dataset.labels.set("ann", everything[0], Label(7, 7, 0, 9))
    chosen = select_episodes(dataset, ExportQuery()).chosen
    found = {o.entry.uuid: o.revision.rev_uuid for o in chosen}
    assert found[everything[0]] == before.rev_uuid
    dataset.labels.reject("bob", everything[4], "tilt")
    dataset.labels.delete("bob", everything[1], "test")
    selection = select_episodes(dataset, ExportQuery(states=("approved", "submitted")))
    assert {o.entry.uuid for o in selection.chosen} == {everything[k] for k in (0, 2, 3)}
    assert "Episodes left out: 1, its label is rejected." in selection.warnings


def test_nothing_to_hand_on_says_why(tmp_path):
    with Dataset.open(tmp_path / "d") as dataset:
        episode = small_episode(accepted=False)
        context = context_for(dataset)
        dataset.record(episode, Label(1, 2, 0, 3), source="commanded", context=context)
        with pytest.raises(InputError, match="failed its quality checks"):
            select_episodes(dataset, ExportQuery(states=("draft",)))


@pytest.mark.parametrize(
    ("name", "has"), [("piece", "pot"), ("bottom", "circle15"), ("series", ""), ("campaign", "")]
)
def test_what_the_dataset_lacks_is_named_with_what_it_has(dataset, tmp_path, name, has):
    query = ExportQuery(**{name: "barrel"})
    with pytest.raises(InputError, match=f"The dataset has no {name} 'barrel'.") as refused:
        select_episodes(dataset, query)
    assert refused.value.fix.startswith("It has ")
    assert has in refused.value.fix
    with Dataset.open(tmp_path / "empty") as empty, pytest.raises(InputError) as refused:
        select_episodes(empty, query)
    assert refused.value.fix == "It has no episodes."


def test_an_export_stays_out_of_the_dataset(dataset):
    with pytest.raises(InputError, match="part of the dataset"):
        export(dataset, "ros2", dataset.folder / "raw" / "out")
    assert not (dataset.folder / "raw" / "out").exists()


def test_two_faces_need_a_piece(dataset, hand):
    barrel = replace(recorded_episode(50), piece="barrel")
    context = context_for(dataset, "barrel")
    dataset.record(barrel, Label(1, 2, 0, 3), source="measured", context=context)
    with pytest.raises(InputError, match="--piece"):
        hand("zarr")
    assert hand("zarr", piece="pot", states=("approved", "draft")).episodes == 5
    assert hand("csv").episodes == 7


def test_an_interrupted_export_is_never_complete(dataset, tmp_path, hand):
    def stop(done: int, total: int) -> None:
        if done == 2:
            raise KeyboardInterrupt

    out = tmp_path / "lerobot"
    with pytest.raises(KeyboardInterrupt):
        export(dataset, "lerobot", out, video="none", on_progress=stop)
    part = tmp_path / "lerobot.partial"
    assert part.is_dir()
    assert not out.exists()
    assert not (part / "manifest.json").exists()
    with pytest.raises(InputError, match="interrupted"):
        EpisodeImport(dataset, "lerobot", part, ImportOptions("dora"))
    assert hand("lerobot").folder == out
    assert not part.exists()


def test_a_full_disk_is_a_fault(dataset, hand, monkeypatch):
    def full(folder: Path, content: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(exports.manifest, "write_manifest", full)
    with pytest.raises(FaultError, match="DISK-FULL"):
        hand("csv")


def test_no_folder_is_overwritten(dataset, hand, tmp_path):
    hand("csv")
    with pytest.raises(InputError, match="there already"):
        hand("csv")
    (tmp_path / "mine.partial").mkdir()
    (tmp_path / "mine.partial" / "thesis.txt").write_text("keep")
    with pytest.raises(InputError, match="no interrupted export"):
        hand("csv", "mine")
    assert (tmp_path / "mine.partial" / "thesis.txt").exists()


def test_zarr_holds_the_same_numbers(dataset, hand, request):
    out = hand("zarr").folder
    request.addfinalizer(cleanup_resources)
    group = zarr.open_group(out / "episodes.zarr", mode="r")
    assert group.attrs["committed"] is True
    uuids = list(group.attrs["episodes"])
    markers, wrench = (group[f"observation.{name}"][:] for name in ("markers", "ft"))
    for k, uuid in enumerate(uuids):
        mine = np.concatenate([markers[k], wrench[k]], 1)
        assert mine.tobytes() == dataset.read(str(uuid)).observation.tobytes()
    array = group["observation.markers"]
    assert array.metadata.zarr_format == 3
    assert array.shards[0] == 100
    assert array.chunks[0] == 1


def test_a_replay_buffer_is_read_as_diffusion_policy_does(seen, hand, request):
    """The checks and reads of ReplayBuffer in real-stanford/diffusion_policy."""
    request.addfinalizer(cleanup_resources)
    done = hand("replay-buffer", of=seen, states=("draft",), video="all")
    root = zarr.open(str(done.folder / "replay_buffer.zarr"), mode="r")
    assert root.metadata.zarr_format == 2
    ends = root["meta"]["episode_ends"][:]
    assert (ends.dtype, ends.tolist()) == (np.int64, [20, 40])
    data = {key: array[: ends[-1]] for key, array in root["data"].arrays()}
    assert all(len(values) == ends[-1] for values in data.values())
    assert {"state", "action", "markers", "ft", "ft_window", "tac_left", "scene"} <= set(data)
    assert data["scene"].shape == (40, 240, 320, 3)
    assert (data["label_offset_mm"][:20] == data["label_offset_mm"][0]).all()
    for listed, end in zip(manifest_of(done.folder)["episodes"], ends, strict=True):
        mine = np.concatenate([data["markers"], data["ft"]], axis=1)[end - 20 : end]
        assert mine.tobytes() == seen.read(listed["uuid"]).observation.tobytes()


def test_a_ros_2_bag_says_what_its_file_holds(seen, hand, tmp_path):
    done = hand("ros2", of=seen, states=("draft",))
    for listed in manifest_of(done.folder)["episodes"]:
        bag = done.folder / listed["uuid"]
        told = json.loads((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
        assert told["relative_file_paths"] == [f"{listed['uuid']}.mcap"]
        with (bag / told["relative_file_paths"][0]).open("rb") as file:
            summary = make_reader(file).get_summary()
        numbers = summary.statistics
        assert told["starting_time"]["nanoseconds_since_epoch"] == numbers.message_start_time
        span_ns = numbers.message_end_time - numbers.message_start_time
        assert (told["duration"]["nanoseconds"], told["message_count"]) == (
            span_ns, numbers.message_count
        )  # fmt: skip
        topics = {
            about["name"]: (about["type"], about["offered_qos_profiles"], one["message_count"])
            for one in told["topics_with_message_count"]
            for about in [one["topic_metadata"]]
        }
        assert topics == {
            channel.topic: (
                summary.schemas[channel.schema_id].name,
                *channel.metadata.values(),
                count,
            )
            for number, count in numbers.channel_message_counts.items()
            if (channel := summary.channels[number]) and count
        }
        assert {"/tf", "/tf_static", "/tac/left/points", "/scene/camera_info"} <= set(topics)
    with Dataset.open(tmp_path / "packed"):
        write_pack(tmp_path / "packed" / "packs" / "a.mcap")
    with (
        Dataset.open(tmp_path / "packed") as dataset,
        pytest.raises(InputError, match="no signals"),
    ):
        hand("ros2", "none", of=dataset)


def test_lerobot_tells_quantiles_robot_and_scene(seen, hand):
    done = hand("lerobot", of=seen, states=("draft",), video="all")
    info = json.loads((done.folder / "meta/info.json").read_text())
    assert info["robot_type"] == "touchdown_simulated"
    film = info["features"]["observation.images.scene"]["info"]
    assert (film["video.codec"], film["video.pix_fmt"]) == ("h264", "yuv420p")
    with av.open(str(next((done.folder / "videos").glob("*scene/*/*.mp4")))) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert container.streams.video[0].pix_fmt == "yuv420p"
        assert not container.streams.video[0].codec_context.has_b_frames
    pressed = seen.read(manifest_of(done.folder)["episodes"][0]["uuid"]).recording.scene[0].image
    small = cv2.resize(pressed, (320, 240), interpolation=cv2.INTER_AREA)[:, :, ::-1]
    assert np.abs(frames[9].astype(int) - small).mean() < 4.0
    stats = json.loads((done.folder / "meta/stats.json").read_text())
    every = np.concatenate([seen.read(e.uuid).observation[:, 252:] for e in seen.episodes()])
    for key, share in (("q01", 0.01), ("q10", 0.1), ("q50", 0.5), ("q90", 0.9), ("q99", 0.99)):
        np.testing.assert_allclose(
            stats["observation.ft"][key], np.quantile(every, share, axis=0), rtol=1e-5, atol=1e-6
        )
        assert np.shape(stats["observation.images.scene"][key]) == (3, 1, 1)
    card = (done.folder / "README.md").read_text()
    front = yaml.safe_load(card.split("---")[1])
    assert "LeRobot" in front["tags"]
    assert front["configs"][0]["data_files"] == "data/*/*.parquet"


@pytest.mark.parametrize("apart", [False, True])
def test_the_state_can_hold_the_touch_signals(apart, dataset, hand, tmp_path):
    wanted = ("wrench", "markers", *(("environment_state",) if apart else ()))
    done = hand("lerobot", states=EVERY, divide_series=True, state_with=wanted)
    table = pq.read_table(done.folder / "data/chunk-000/file-000.parquet").to_pydict()
    touch = np.concatenate([table["observation.ft"], table["observation.markers"]], axis=1)
    state = np.array(table["observation.state"])
    added = np.array(table["observation.environment_state"]) if apart else state[:, 7:]
    assert np.array_equal(added, touch)
    assert state.shape[1] == (7 if apart else 265)
    info = json.loads((done.folder / "meta/info.json").read_text())["features"]
    assert len(info["observation.state"]["names"]) == state.shape[1]
    with Dataset.open(tmp_path / "back") as back:
        EpisodeImport(back, "lerobot", done.folder, ImportOptions("dora")).write()
        assert all(back.read(e.uuid).recording is not None for e in back.episodes())
    for name, wrong in (("zarr", ("wrench",)), ("lerobot", ("force",)), ("lerobot", wanted[2:])):
        if wrong:
            with pytest.raises(InputError, match="cannot hold"):
                hand(name, "none", states=EVERY, divide_series=True, state_with=wrong)


def test_packed_episodes_have_what_the_model_is_given(tmp_path, hand):
    folder = tmp_path / "packed"
    with Dataset.open(folder):
        pass
    write_pack(folder / "packs" / "a.mcap")
    with Dataset.open(folder) as dataset:
        done = hand("lerobot", "packed-out", of=dataset)
        assert done.episodes == 4
        assert "no recorded signals" in done.warnings[1]
        with Dataset.open(tmp_path / "back") as back:
            EpisodeImport(back, "lerobot", done.folder, ImportOptions("dora")).write()
            mine = {back.read(e.uuid).observation.tobytes() for e in back.episodes()}
            again = hand("lerobot", "packed-again", of=back)
            first, second = (
                [row["split"] for row in manifest_of(one.folder)["episodes"]]
                for one in (done, again)
            )
            assert first == second
            table, same = (one.folder / "data/chunk-000/file-000.parquet" for one in (done, again))
            assert table.read_bytes() == same.read_bytes()
    from touchdown.backend.episodes.packs import read_pack

    packed = {row.observation.tobytes() for row in read_pack(folder / "packs" / "a.mcap")}
    assert mine == packed


@pytest.mark.parametrize("states", ["draft", ("drft",)])
def test_states_are_names_in_a_tuple(states, dataset, tmp_path):
    with pytest.raises(InputError, match=r"cannot be chosen by .*Give a tuple of names"):
        export(dataset, "csv", tmp_path / "out", states=states)


def test_pictures_are_refused_where_there_are_none(hand, dataset):
    with pytest.raises(InputError, match="has no videos"):
        hand("csv", video="all")
    dataset.record(recorded_episode(60, frames=False), Label(1, 2, 0, 3), source="measured",
                   context=context_for(dataset), keep_frames="none")  # fmt: skip
    with pytest.raises(InputError, match="without pictures"):
        hand("lerobot", video="all")
    assert hand("lerobot", video="sample").episodes == 7


def test_a_script_exports_a_folder_or_an_open_dataset(dataset, filled, tmp_path):
    by_path = export(str(filled), "csv", str(tmp_path / "path"), held_out=0.0)
    assert by_path.episodes == 4
    seen: list[tuple[int, int]] = []
    of_open = export(dataset, "robomimic", tmp_path / "open", states=EVERY,
                     on_progress=lambda done, total: seen.append((done, total)))  # fmt: skip
    assert of_open.episodes == 6
    assert seen[-1] == (6, 6)
    with pytest.raises(InputError, match="no dataset"):
        export(tmp_path / "none", "csv", tmp_path / "out")
    with pytest.raises(InputError, match="no format"):
        export(dataset, "hdf", tmp_path / "out")


def columns(path: Path) -> dict[str, list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def test_positions_are_metres_in_arrays_and_mm_in_tables(dataset, hand):
    chosen = select_episodes(dataset, ExportQuery(states=EVERY, divide_series=True)).chosen
    values = read_export(dataset, chosen[0], common_signals(dataset, chosen)).values
    episode = dataset.read(chosen[0].entry.uuid)
    recording, last_s = episode.recording, episode.onset_s + 2.0
    place_mm = [np.interp(last_s, recording.pose_t_s, mm) for mm in recording.pose_mm.T]
    assert values[STATE][-1, :3] == pytest.approx(np.divide(place_mm, 1000.0), abs=1e-5)
    table = columns(hand("csv").folder / "episodes.csv")
    assert "-2.501" in table["x_mm"]
    assert "0.137" in table["y_mm"]
    assert set(table["sigma_mm"]) == {"0.150"}


FULL = Path("/dev/full")
VALUES = np.random.default_rng(1).normal(size=(40, 300, 20))


def fill(disk: DiskFullSafeFile) -> None:
    """Write more than the caches of HDF5 hold, and look at it before it is closed."""
    with h5py.File(disk, "w") as file:
        for k, values in enumerate(VALUES):
            file.create_dataset(f"demo_{k}/obs", data=values, compression=1)
            file[f"demo_{k}"].attrs["name"] = "x" * 5000
        for k, values in enumerate(VALUES):
            np.testing.assert_array_equal(file[f"demo_{k}/obs"][...], values)


@pytest.mark.skipif(not FULL.exists(), reason="the system has no /dev/full")
def test_a_full_disk_is_told_after_hdf5_has_closed():
    with DiskFullSafeFile(FULL) as disk:
        fill(disk)
        with pytest.raises(OSError, match="No space left") as caught:
            disk.check()
    assert caught.value.errno == errno.ENOSPC


def test_with_room_it_is_a_file_like_any_other(tmp_path):
    with DiskFullSafeFile(tmp_path / "a.hdf5") as disk:
        fill(disk)
        disk.check()
    with h5py.File(tmp_path / "a.hdf5") as file:
        assert len(file) == len(VALUES)
        np.testing.assert_array_equal(file["demo_7/obs"][...], VALUES[7])


ROOT = Path(__file__).resolve().parents[3]
READERS = Path(os.environ.get("READERS") or ROOT / ".venv-readers") / "bin" / "python"
CHECKS = ROOT / ".ci" / "exchange_check"


@pytest.mark.optional
@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.skipif(not READERS.exists(), reason="no readers: 'make exchange-check' has them")
def test_real_readers_find_every_number(dataset, hand, tmp_path):
    for kind in ("robomimic", "zarr", "replay-buffer", "coco", "ros2"):
        hand(kind, f"exports/{kind}")
    hand("lerobot", "exports/lerobot", video="sample")
    touch, chosen = ("wrench", "markers"), {"states": EVERY, "divide_series": True}
    hand("lerobot", "exports/lerobot-state", video="sample", state_with=touch, **chosen)
    touch += ("environment_state",)
    hand("lerobot", "exports/lerobot-apart", state_with=touch, **chosen)
    dataset.close()
    truth = tmp_path / "truth.npz"
    environment = {**os.environ, "HF_HOME": str(tmp_path / "hf"), "PYTHONPATH": str(ROOT)}
    subprocess.run(
        [sys.executable, CHECKS / "truth.py", tmp_path / "data", truth], check=True, env=environment
    )
    found = subprocess.run(
        [READERS, CHECKS / "readers.py", tmp_path / "exports", truth],
        env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert found.returncode == 0, found.stdout + found.stderr[-3000:]
    assert found.stdout.count(" ok ") == 9

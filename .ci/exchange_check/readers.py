"""Load the exports with the real readers: ``readers.py EXPORTS TRUTH.npz`` (readers' environment).

Prints one line per reader and leaves with 1 if one of them failed.
"""

import importlib.metadata
import importlib.util
import json
import os
import shutil
import sys
import tempfile
import traceback
from pathlib import Path

import numpy as np

os.environ["HF_HUB_OFFLINE"] = "1"
FFMPEG = "TOUCHDOWN_CHECK_FFMPEG"
"""Names the folder of the decoder's libraries once they are in sight."""
OBSERVED = ("observation.markers", "observation.ft")


def with_ffmpeg() -> None:
    """Begin anew with the FFmpeg libraries of the package ``av`` in sight; then do nothing.

    LeRobot's decoder looks for them by their plain names, av's carry a hash in theirs; and where a
    process looks for libraries is settled when it begins.
    """
    found = importlib.util.find_spec("av")
    if FFMPEG in os.environ or found is None or found.origin is None:
        return
    folder = Path(tempfile.mkdtemp(prefix="ffmpeg-"))
    libraries = Path(found.origin).parent.parent / "av.libs"
    for pattern in ("libav*.so.*", "libsw*.so.*"):
        for library in libraries.glob(pattern):
            name, _, version = library.name.partition(".so.")
            plain = f"{name.partition('-')[0]}.so.{version.partition('.')[0]}"
            (folder / plain).symlink_to(library)
    # They ask for each other by the names with hashes.
    places = (str(folder), str(libraries), os.environ.get("LD_LIBRARY_PATH"))
    os.environ["LD_LIBRARY_PATH"] = ":".join(filter(None, places))
    os.environ[FFMPEG] = str(folder)
    os.execv(sys.executable, [sys.executable, *sys.argv])  # noqa: S606 - this very program


class Truth:
    """What every reader must find, and which episode is which number of an export."""

    def __init__(self, exports: Path, path: Path) -> None:
        self.exports = exports
        with np.load(path) as stored:
            self._arrays = {name: stored[name] for name in stored.files}

    def episodes(self, kind: str) -> list[dict]:
        """Return the episodes that the manifest of ``kind`` lists, by number."""
        listed = json.loads((self.exports / kind / "manifest.json").read_text("utf-8"))["episodes"]
        return sorted(listed, key=lambda episode: episode["export_index"])

    def check(self, uuid: str, markers: np.ndarray, wrench: np.ndarray) -> None:
        """Compare an observation bit by bit."""
        found = np.concatenate([markers, wrench], axis=1).astype(np.float32)
        assert found.tobytes() == self._arrays[f"{uuid}/observation"].tobytes(), uuid

    def check_label(self, uuid: str, offset_mm: np.ndarray, patch: np.ndarray) -> None:
        """Compare offset and patch."""
        um = np.rint(np.asarray(offset_mm, np.float64) * 1e3)
        assert um.tolist() == self._arrays[f"{uuid}/um"].tolist(), uuid
        assert np.asarray(patch, bool).tolist() == self._arrays[f"{uuid}/patch"].tolist(), uuid


def lerobot(truth: Truth) -> str:
    """Load rows, tasks and statistics with LeRobotDataset, and a subset of the episodes."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = truth.exports / "lerobot"
    listed = truth.episodes("lerobot")
    dataset = LeRobotDataset("touchdown/check", root=root)
    assert (dataset.num_episodes, len(dataset)) == (len(listed), 20 * len(listed))
    for number, episode in enumerate(listed):
        rows = [dataset[k] for k in range(20 * number, 20 * number + 20)]
        assert {int(row["episode_index"]) for row in rows} == {number}
        assert rows[0]["task"] == f"press the {episode['piece']} on the {episode['bottom']}"
        markers, wrench = (np.stack([row[key].numpy() for row in rows]) for key in OBSERVED)
        truth.check(episode["uuid"], markers, wrench)
        last = rows[-1]
        truth.check_label(episode["uuid"], last["label.offset_mm"], last["label.patch"])
        assert tuple(last["observation.ft_window"].shape) == (100, 6)
    some = LeRobotDataset("touchdown/check", root=root, episodes=[1, 3])
    assert len(some) == 40
    mean = dataset.meta.stats["observation.ft"]["mean"]
    found = np.stack([dataset[k]["observation.ft"].numpy() for k in range(len(dataset))])
    np.testing.assert_allclose(mean, found.mean(axis=0, dtype=np.float64), rtol=1e-5, atol=1e-6)
    return f"{len(listed)} episodes, {len(dataset)} frames bit-equal, subset, tasks, statistics"


def lerobot_video(truth: Truth) -> str:
    """Decode pictures of the sample through LeRobotDataset itself."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = truth.exports / "lerobot" / "sample"
    dataset = LeRobotDataset("touchdown/check", root=root)
    keys = dataset.meta.video_keys
    seen = set()
    for k in (0, 19, 20, len(dataset) - 1):
        for key in keys:
            picture = dataset[k][key]
            assert tuple(picture.shape) == (3, 240, 320)
            assert 0.05 < float(picture.mean()) < 0.95
            seen.add(round(float(picture.mean()), 6))
    assert len(seen) > 1
    return f"{dataset.num_episodes} episodes, cameras {', '.join(keys)}"


def lerobot_stream(truth: Truth) -> str:
    """Read all rows one after the other with StreamingLeRobotDataset, and some with their past."""
    from lerobot.datasets.streaming_dataset import StreamingLeRobotDataset

    root, listed = truth.exports / "lerobot", truth.episodes("lerobot")
    rows: dict[int, dict[int, dict]] = {}
    for row in StreamingLeRobotDataset("touchdown/check", root=root, shuffle=False):
        rows.setdefault(int(row["episode_index"]), {})[int(row["frame_index"])] = row
    assert {number: len(found) for number, found in rows.items()} == dict.fromkeys(
        range(len(listed)), 20
    )
    for number, episode in enumerate(listed):
        in_order = [rows[number][k] for k in range(20)]
        markers, wrench = (np.stack([row[key].numpy() for row in in_order]) for key in OBSERVED)
        truth.check(episode["uuid"], markers, wrench)
        assert in_order[0]["task"] == f"press the {episode['piece']} on the {episode['bottom']}"
    spans = {"observation.ft": [-0.1, 0.0], "action": [0.0, 0.1]}
    dataset = StreamingLeRobotDataset("touchdown/check", root=root, delta_timestamps=spans)
    row = next(iter(dataset))
    assert [tuple(row[key].shape) for key in spans] == [(2, 6), (2, 7)]
    return f"{len(listed)} episodes, {20 * len(listed)} frames bit-equal, spans of time"


def lerobot_policy(truth: Truth) -> str:
    """Train ACT: its actions depend on touch if the state holds it, and only then."""
    from policy import change_without_touch

    plain, state, apart = (
        change_without_touch(truth.exports / folder, steps, batch)
        for folder, steps, batch in (
            ("lerobot/sample", 10, 4), ("lerobot-state/sample", 10, 4), ("lerobot-apart", 300, 32)
        )
    )  # fmt: skip
    assert plain[0] == 0.0 < min(state[0], apart[0])
    return (
        f"without touch its actions change by {plain[0]:g}; with touch in the state by "
        f"{state[0]:.3g}, in the environment state by {apart[0]:.3g} (deviation {apart[1]:.3g})"
    )


def robomimic(truth: Truth) -> str:
    """Load all demos and the training side with SequenceDataset."""
    import robomimic.utils.obs_utils as obs_utils
    from robomimic.utils.dataset import SequenceDataset

    names = ["markers", "ft", "ft_window", "state"]
    obs_utils.initialize_obs_utils_with_obs_specs({"obs": {"low_dim": names}})

    def load(side: str | None) -> SequenceDataset:
        return SequenceDataset(
            str(truth.exports / "robomimic" / "demos.hdf5"), obs_keys=names,
            dataset_keys=("actions", "rewards", "dones", "label_offset_mm", "label_patch"),
            frame_stack=1, seq_length=20, pad_seq_length=True, load_next_obs=True,
            hdf5_cache_mode=None, filter_by_attribute=side,
        )  # fmt: skip

    dataset = load(None)
    by_uuid = {episode["uuid"]: episode for episode in truth.episodes("robomimic")}
    assert dataset.n_demos == len(by_uuid)
    for name in dataset.demos:
        uuid = dataset.hdf5_file[f"data/{name}"].attrs["product_episode"]
        item = dataset[dataset._demo_id_to_start_indices[name]]  # noqa: SLF001
        truth.check(uuid, item["obs"]["markers"], item["obs"]["ft"])
        truth.check_label(uuid, item["label_offset_mm"][0], item["label_patch"][0])
        assert np.abs(item["actions"]).max() <= 1.0
    train = sum(episode["split"] == "train" for episode in by_uuid.values())
    assert load("train").n_demos == train
    return f"{dataset.n_demos} demos bit-equal, {train} of them by the mask 'train'"


def zarr(truth: Truth) -> str:
    """Read the arrays with zarr-python."""
    import zarr as package

    group = package.open_group(truth.exports / "zarr" / "episodes.zarr", mode="r")
    assert group.attrs["committed"] is True
    listed = truth.episodes("zarr")
    for k, episode in enumerate(listed):
        truth.check(episode["uuid"], *(group[key][k] for key in OBSERVED))
        truth.check_label(episode["uuid"], group["label.offset_mm"][k], group["label.patch"][k])
    return f"{len(listed)} episodes bit-equal"


def replay_buffer(truth: Truth) -> str:
    """Read the replay buffer with its checks: ReplayBuffer itself needs zarr 2."""
    import zarr as package

    root = package.open_group(truth.exports / "replay-buffer" / "replay_buffer.zarr", mode="r")
    ends = root["meta"]["episode_ends"][:]
    assert all(array.shape[0] == ends[-1] for _, array in root["data"].arrays())
    listed = truth.episodes("replay-buffer")
    for episode, end in zip(listed, ends, strict=True):
        markers, wrench = (root["data"][key][end - 20 : end] for key in ("markers", "ft"))
        truth.check(episode["uuid"], markers, wrench)
    return f"{len(listed)} episodes bit-equal"


def ros2(truth: Truth) -> str:
    """Open every bag with rosbags and decode all messages of the types of ROS 2 itself."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    store, decoded = get_typestore(Stores.ROS2_HUMBLE), 0
    listed = truth.episodes("ros2")
    for episode in listed:
        with Reader(truth.exports / "ros2" / episode["uuid"]) as reader:
            read = 0
            for connection, _, raw in reader.messages():
                read += 1
                if not connection.msgtype.startswith("lab_msgs/"):
                    message = store.deserialize_cdr(raw, connection.msgtype)
                    assert bytes(store.serialize_cdr(message, connection.msgtype)) == bytes(raw)
                    decoded += 1
            assert read == reader.message_count
            assert {"/tf", "/tf_static", "/tac/left/points"} <= set(reader.topics)
    return f"{len(listed)} bags, {decoded} messages written again with the same bytes"


def coco(truth: Truth) -> str:
    """Index annotations and draw masks with pycocotools."""
    from pycocotools.coco import COCO

    loaded = COCO(str(truth.exports / "coco" / "annotations.json"))
    drawn = 0
    for annotation in loaded.loadAnns(loaded.getAnnIds()):
        if annotation["segmentation"] and annotation["category_id"] == 1:
            area = int(loaded.annToMask(annotation).sum())
            assert abs(area - annotation["area"]) < 0.02 * annotation["area"] + 50
            drawn += 1
    return f"{len(loaded.imgs)} images, {len(loaded.anns)} annotations, {drawn} masks of their area"


CHECKS = {"lerobot": lerobot, "lerobot stream": lerobot_stream, "lerobot video": lerobot_video,
          "lerobot policy": lerobot_policy,
          "robomimic": robomimic, "zarr": zarr, "replay buffer": replay_buffer, "ros2": ros2,
          "coco": coco}  # fmt: skip
PACKAGES = {
    "coco": "pycocotools",
    "replay buffer": "zarr",
    "ros2": "rosbags",
    "lerobot video": "lerobot",
    "lerobot stream": "lerobot",
    "lerobot policy": "lerobot",
}


def main(exports: Path, truth_path: Path) -> int:
    """Run all checks."""
    truth, failed = Truth(exports, truth_path), 0
    for name, check in CHECKS.items():
        package = PACKAGES.get(name, name)
        version = importlib.metadata.version(package)
        try:
            told = f"ok      {check(truth)}"
        except Exception as error:  # noqa: BLE001 - each reader fails in its own way
            failed += 1
            traceback.print_exc()
            told = f"FAILED  {type(error).__name__}: {error}".splitlines()[0]
        sys.stdout.write(f"{name:14} {package} {version:8} {told}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    with_ffmpeg()
    try:
        ended = main(Path(sys.argv[1]), Path(sys.argv[2]))
    finally:
        shutil.rmtree(os.environ.get(FFMPEG, ""), ignore_errors=True)
    sys.exit(ended)

"""Write ``tests/data/foreign``: one press of the emulated bench, as another laboratory records it.

``pip install --target /tmp/rosbags rosbags==0.11.9``, then, in the product's environment,
``PYTHONPATH=.:/tmp/rosbags python .ci/exchange_check/foreign_example.py``. ``rosbags`` writes the
bag. The wrist sensor hangs upside down, was never tared and gives the force on the environment in
N and N mm; the arm gives m; the left gel is filmed upside down; the right gel is an array of marker
positions. ``truth.npz`` holds the model input and the offset of the dataset.
"""

import shutil
import tempfile
from pathlib import Path

import cv2
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from touchdown.backend.annotations import Dataset
from touchdown.backend.bench import EmulatedBench, SimulatedBenchChoice
from touchdown.backend.core import Episode
from touchdown.backend.runs import CollectRequest, RecordingOptions

FOLDER = Path("tests/data/foreign")
START_NS, WRENCH_HZ = 1_700_000_000_000_000_000, 250.0
ORIGIN_MM, PAYLOAD_N = (412.0, -35.0), 14.7
store = get_typestore(Stores.ROS2_HUMBLE)
msg = store.types


def record() -> Episode:
    """Record one press through the drivers of the emulated bench."""
    request = CollectRequest(piece="pot", bottom="square15", person="example", count=1,
                             probes_per_grip=1, seed=11)  # fmt: skip
    with (
        tempfile.TemporaryDirectory() as folder,
        Dataset.open(Path(folder) / "dataset", person="example") as dataset,
        EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(None)) as bench,
    ):
        bench.session.dataset = dataset
        bench.session.run(request)
        (entry,) = [e for e in dataset.episodes() if e.quality.accepted]
        return dataset.read(entry.uuid)


def header(t_s: float, frame: str) -> object:
    """Return a header; the clock of the other laboratory starts at ``START_NS``."""
    stamp = divmod(START_NS + round(1e9 * t_s), 1_000_000_000)
    return msg["std_msgs/msg/Header"](msg["builtin_interfaces/msg/Time"](*stamp), frame)


def messages(episode: Episode) -> list[tuple[float, str, str, object]]:
    """Return (time, topic, type, message) of all signals, in the frames of the other laboratory."""
    recording = episode.recording
    assert recording is not None
    first, last = recording.wrench_t_s[0], recording.wrench_t_s[-1]
    vector, point = msg["geometry_msgs/msg/Vector3"], msg["geometry_msgs/msg/Point"]
    level = msg["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    found: list[tuple[float, str, str, object]] = []
    for t_s in np.arange(first, last, 1.0 / WRENCH_HZ):
        row = np.array([np.interp(t_s, recording.wrench_t_s, c) for c in recording.wrench.T])
        row[2] -= PAYLOAD_N
        turned = -row * np.tile([1.0, -1.0, -1.0], 2)
        kind = "geometry_msgs/msg/WrenchStamped"
        wrench = msg["geometry_msgs/msg/Wrench"](vector(*turned[:3]), vector(*1e3 * turned[3:]))
        found.append((t_s, "/ft_sensor", kind, msg[kind](header(t_s, "ft"), wrench)))
    shift_mm = np.append(np.subtract(ORIGIN_MM, origin_mm(episode)), 0.0)
    for t_s, mm in zip(recording.pose_t_s, recording.pose_mm, strict=True):
        kind = "geometry_msgs/msg/PoseStamped"
        pose = msg["geometry_msgs/msg/Pose"](point(*1e-3 * (mm + shift_mm)), level)
        found.append((t_s, "/tool_pose", kind, msg[kind](header(t_s, "base"), pose)))
    for frame in recording.frames:
        if frame.finger == "left":
            kind = "sensor_msgs/msg/CompressedImage"
            picture = cv2.rotate(frame.image, cv2.ROTATE_180)
            data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 75])[1].ravel()
            image = msg[kind](header(frame.t_s, "gel_left"), "jpeg", data)
            found.append((frame.t_s, "/gel_left/compressed", kind, image))
    for field in recording.fields:
        if field.finger == "right":
            kind = "std_msgs/msg/Float64MultiArray"
            layout = msg["std_msgs/msg/MultiArrayLayout"]([], 0)
            markers = msg[kind](layout, field.position_px.ravel().round(4))
            found.append((field.t_s, "/gel_right/markers", kind, markers))
    return sorted((m for m in found if first <= m[0] <= last), key=lambda m: m[0])


def origin_mm(episode: Episode) -> np.ndarray:
    """Return where the arm stands with the face centred on the bottom."""
    recording = episode.recording
    assert recording is not None
    here = [np.interp(episode.onset_s, recording.pose_t_s, c) for c in recording.pose_mm.T[:2]]
    return np.array(here) - episode.offset_mm


def main() -> None:
    """Record, and write bag and truth."""
    episode = record()
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / "bag"
        writer = Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP)
        writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        with writer:
            made: dict[str, object] = {}
            for t_s, topic, kind, message in messages(episode):
                if topic not in made:
                    made[topic] = writer.add_connection(topic, kind, typestore=store)
                stamp_ns = START_NS + round(1e9 * t_s)
                writer.write(made[topic], stamp_ns, store.serialize_cdr(message, kind))
        (file,) = bag.glob("*.mcap")
        shutil.copyfile(file, FOLDER / "press.mcap")
    np.savez(FOLDER / "truth.npz", observation=episode.observation, offset_mm=episode.offset_mm)


if __name__ == "__main__":
    main()

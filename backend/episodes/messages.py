"""Messages of the episode files: topics, ROS 2 schemas, CDR encoding.

Encoding: little-endian XCDR1; offsets count from the end of the 4 bytes of the encapsulation
header. `pack_*` writes messages, `unpack_*` returns arrays. See data-and-labelling 2.4.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import GRID_COLS, GRID_ROWS, MARKERS, BeliefMap, FloatArray, parse_json

ENCAPSULATION = b"\x00\x01\x00\x00"


def cdr(layout: str, *values: Any) -> bytes:
    """Return a message, one value per letter of ``layout``; primitives are aligned to their size.

    Letters: h ``std_msgs/Header`` (stamp in ns, frame), s string, q sequence (array or bytes), else
    the ``struct`` letter of one or several numbers (B H i I f d).
    """
    content = bytearray()

    def put(kind: str, *numbers: float) -> None:
        content.extend(bytes(-len(content) % struct.calcsize(kind)))
        content.extend(struct.pack(f"<{len(numbers)}{kind}", *numbers))

    def text(value: str) -> None:
        data = value.encode("utf-8") + b"\x00"
        put("I", len(data))
        content.extend(data)

    for kind, value in zip(layout, values, strict=True):
        if kind == "h":
            put("i", value[0] // 1_000_000_000)
            put("I", value[0] % 1_000_000_000)
            text(value[1])
        elif kind == "s":
            text(value)
        elif kind == "q":
            array = np.frombuffer(value, np.uint8) if isinstance(value, bytes) else value
            put("I", array.size)
            content.extend(bytes(-len(content) % array.itemsize if array.size else 0))
            content.extend(np.ascontiguousarray(array).tobytes())
        else:
            put(kind, *np.ravel(value).tolist())
    return ENCAPSULATION + bytes(content)


class CdrReader:
    """Read fields in order; raises ``ValueError`` if the message is too short or foreign."""

    def __init__(self, message: bytes | memoryview) -> None:
        if len(message) < 4 or bytes(message[:4]) != ENCAPSULATION:
            raise ValueError("not a little-endian CDR message")
        self._data = memoryview(message)[4:]
        self._at = 0

    def _take(self, count: int) -> memoryview:
        if count < 0 or self._at + count > len(self._data):
            raise ValueError("the message is shorter than its content")
        part = self._data[self._at : self._at + count]
        self._at += count
        return part

    def number(self, kind: str) -> float:
        """Read one number."""
        size = struct.calcsize(kind)
        self._at += -self._at % size
        value: float = struct.unpack("<" + kind, self._take(size))[0]
        return value

    def integer(self, kind: str) -> int:
        """Read one integer."""
        return int(self.number(kind))

    def text(self) -> str:
        """Read a string."""
        content = bytes(self._take(self.integer("I")))
        return content[:-1].decode("utf-8")

    def sequence(self, dtype: str) -> NDArray[np.generic]:
        """Read a sequence as a new array of ``dtype`` such as ``<f4``."""
        count = self.integer("I")
        kind = np.dtype(dtype)
        if count:
            self._at += -self._at % kind.itemsize
        return np.frombuffer(self._take(count * kind.itemsize), kind).copy()

    def header(self) -> tuple[int, str]:
        """Read a ``std_msgs/Header``: (stamp in ns, frame)."""
        seconds = self.integer("i")
        return seconds * 1_000_000_000 + self.integer("I"), self.text()


ByteRows = NDArray[np.uint8]
Times = NDArray[np.int64]
Stamp = np.dtype([("sec", "<i4"), ("nsec", "<u4")])
_HEAD = len(ENCAPSULATION)


@dataclass(frozen=True, slots=True)
class Topic:
    """Channel of a file: name, message type, constant ``frame_id`` and ROS 2 quality of service."""

    name: str
    schema: str
    frame_id: str = ""
    qos: str = ""


OBSERVATION_TOPIC = Topic("/obs", "lab_msgs/msg/Observation", "obs")
LABEL_TOPIC = Topic("/episode/label", "std_msgs/msg/String")
EVENT_TOPIC = Topic("/episode/event", "std_msgs/msg/String")
WRENCH_TOPIC = Topic("/ft/tared", "geometry_msgs/msg/WrenchStamped", "ft")
POSE_TOPIC = Topic("/robot/pose", "geometry_msgs/msg/PoseStamped", "base")
COMMAND_TOPIC = Topic("/robot/command", "geometry_msgs/msg/PoseStamped", "base")
IMAGE_TOPICS = {
    "left": Topic("/tac/left/image", "sensor_msgs/msg/CompressedImage", "tac_left"),
    "right": Topic("/tac/right/image", "sensor_msgs/msg/CompressedImage", "tac_right"),
}
SCENE_TOPIC = Topic("/scene/image", "sensor_msgs/msg/CompressedImage", "scene")
MARKER_TOPICS = {
    "left": Topic("/tac/left/markers", "lab_msgs/msg/MarkerField", "tac_left"),
    "right": Topic("/tac/right/markers", "lab_msgs/msg/MarkerField", "tac_right"),
}
POINT_TOPICS = {
    finger: Topic(f"/tac/{finger}/points", "sensor_msgs/msg/PointCloud2", topic.frame_id)
    for finger, topic in IMAGE_TOPICS.items()
}
TF_TOPIC = Topic("/tf", "tf2_msgs/msg/TFMessage", POSE_TOPIC.frame_id)
_EVER = {"sec": 9223372036, "nsec": 854775807}
# Quality of service "transient local": the last message also reaches later subscribers.
_LATCHED = {"history": 1, "depth": 1, "reliability": 1, "durability": 1, "liveliness": 1,
            "deadline": _EVER, "lifespan": _EVER, "liveliness_lease_duration": _EVER,
            "avoid_ros_namespace_conventions": False}  # fmt: skip
STATIC_TOPIC = Topic("/tf_static", TF_TOPIC.schema, qos=json.dumps([_LATCHED]))
CAMERA_TOPICS = {
    topic.frame_id: Topic(
        topic.name.replace("image", "camera_info"), "sensor_msgs/msg/CameraInfo", topic.frame_id
    )
    for topic in (*IMAGE_TOPICS.values(), SCENE_TOPIC)
}
BELIEF_TOPIC = Topic("/belief", "nav_msgs/msg/OccupancyGrid", POSE_TOPIC.frame_id)
HAND_FRAME = "hand"
POINT_FIELDS = ("x", "y", "z", "displacement_px")
TACTILE_PX = (320, 240)
# The optics of a tactile camera are not known. A pinhole this far from its gel stands for it.
GEL_DEPTH_MM = 20.0


@lru_cache(maxsize=16)
def schema_text(name: str) -> bytes:
    """Return the ros2msg definition of ``name`` with its dependencies."""
    file = files("touchdown.resources").joinpath("schemas", name.replace("/", ".") + ".msg")
    return file.read_bytes()


def _repeat(template: bytes, stamps_ns: Times, at: int = _HEAD) -> ByteRows:
    rows = np.tile(np.frombuffer(template, np.uint8), (len(stamps_ns), 1))
    stamp = np.empty(len(stamps_ns), Stamp)
    stamp["sec"], stamp["nsec"] = stamps_ns // 1_000_000_000, stamps_ns % 1_000_000_000
    rows[:, at : at + 8] = stamp.view(np.uint8).reshape(-1, 8)
    return rows


def _fill(rows: ByteRows, end: int, values: NDArray[np.generic]) -> None:
    """Replace the bytes before ``end``, which counts from the end of a row."""
    raw = np.ascontiguousarray(values).view(np.uint8).reshape(len(rows), -1)
    at = rows.shape[1] - end
    rows[:, at - raw.shape[1] : at] = raw


def _pack_doubles(
    stamps_ns: Times, frame_id: str, default: Sequence[float], values: FloatArray
) -> ByteRows:
    """Pack a header and the doubles ``default``, the first k replaced by ``values`` (n, k)."""
    rows = _repeat(cdr("hd", (0, frame_id), default), stamps_ns)
    _fill(rows, 8 * (len(default) - values.shape[1]), values.astype("<f8"))
    return rows


def pack_wrench(stamps_ns: Times, wrench: FloatArray) -> ByteRows:
    """Pack ``WrenchStamped``: ``wrench`` (n, 6) in N and N·m."""
    return _pack_doubles(stamps_ns, WRENCH_TOPIC.frame_id, [0.0] * 6, wrench)


def pack_pose(stamps_ns: Times, position_mm: FloatArray) -> ByteRows:
    """Pack ``PoseStamped`` without rotation: ``position_mm`` (n, 3) becomes metres."""
    default = [0.0] * 6 + [1.0]
    return _pack_doubles(stamps_ns, POSE_TOPIC.frame_id, default, position_mm / 1e3)


def pack_observation(stamps_ns: Times, values: NDArray[np.float32]) -> ByteRows:
    """Pack ``Observation``: ``values`` (n, channels) for the steps 0, 1, ... n - 1."""
    template = cdr("hIq", (0, OBSERVATION_TOPIC.frame_id), 0, np.zeros(values.shape[1], "<f4"))
    rows = _repeat(template, stamps_ns)
    _fill(rows, 4 + 4 * values.shape[1], np.arange(len(values), dtype="<u4"))
    _fill(rows, 0, values.astype("<f4"))
    return rows


def _by_axis(points: FloatArray) -> FloatArray:
    return np.moveaxis(points, -1, -2).reshape(len(points), -1).astype("<f8")


@dataclass(frozen=True, slots=True)
class MarkerRows:
    """Marker fields of one finger: positions and displacements (n, 63, 2) px, state (n, 63)."""

    position_px: FloatArray
    displacement_px: FloatArray
    state: NDArray[np.uint8]
    quality: FloatArray
    residual_px: FloatArray


def pack_markers(stamps_ns: Times, markers: MarkerRows, frame_id: str) -> ByteRows:
    """Pack ``MarkerField``, axis before marker: all u, then all v."""
    axes, seen = np.zeros(2 * MARKERS), np.zeros(MARKERS, np.uint8)
    layout = cdr("hHHqqqd", (0, frame_id), GRID_ROWS, GRID_COLS, axes, seen, axes, [0.0, 0.0])
    rows = _repeat(layout, stamps_ns)
    state = len(cdr("hHHqq", (0, frame_id), GRID_ROWS, GRID_COLS, axes, seen))
    _fill(rows, len(layout) - state, markers.state)
    _fill(rows, len(layout) - state + MARKERS + 4, _by_axis(markers.displacement_px))
    _fill(rows, 2 * 8, _by_axis(markers.position_px))
    _fill(rows, 0, np.stack([markers.quality, markers.residual_px], 1).astype("<f8"))
    return rows


def pack_points(stamps_ns: Times, markers: MarkerRows, frame_id: str, mm_per_px: float) -> ByteRows:
    """Pack ``PointCloud2`` in the frame of a tactile camera: x, y, z in m, displacement in px."""
    centred = (markers.position_px - np.divide(TACTILE_PX, 2)) * (mm_per_px / 1e3)
    depth = np.full((*centred.shape[:2], 1), GEL_DEPTH_MM / 1e3)
    moved = np.linalg.norm(markers.displacement_px, axis=2, keepdims=True)
    points = np.concatenate([centred, depth, moved], axis=2).astype("<f4")
    step = 4 * len(POINT_FIELDS)
    fields = [v for k, name in enumerate(POINT_FIELDS) for v in (name, 4 * k, 7, 1)]  # 7: float32
    rows = _repeat(
        cdr("hI" + "sIBI" * len(POINT_FIELDS) + "BIqB", (0, frame_id),
            [1, MARKERS, len(POINT_FIELDS)], *fields, 0, [step, step * MARKERS],
            bytes(step * MARKERS), 1),
        stamps_ns,
    )  # fmt: skip
    _fill(rows, 1, points)
    return rows


class Transform(NamedTuple):
    """Pose of the frame ``child`` in ``parent``: position in mm, unit quaternion (x, y, z, w)."""

    parent: str
    child: str
    position_mm: Sequence[float]
    rotation: Sequence[float] = (0.0, 0.0, 0.0, 1.0)


def pack_transforms(stamp_ns: int, transforms: Sequence[Transform]) -> bytes:
    """Pack one ``TFMessage``."""
    values = [
        value
        for parent, child, position_mm, rotation in transforms
        for value in ((stamp_ns, parent), child, np.divide(position_mm, 1e3), rotation)
    ]
    return cdr("I" + "hsdd" * len(transforms), len(transforms), *values)


def pack_hand(stamps_ns: Times, position_mm: FloatArray) -> ByteRows:
    """Pack ``TFMessage``: the hand at ``position_mm`` (n, 3), pointing straight down."""
    hand = Transform(POSE_TOPIC.frame_id, HAND_FRAME, (0.0, 0.0, 0.0))
    rows = _repeat(pack_transforms(0, [hand]), stamps_ns, _HEAD + 4)
    _fill(rows, 4 * 8, (position_mm / 1e3).astype("<f8"))
    return rows


def pack_camera(stamp_ns: int, frame_id: str, size_px: tuple[int, int], focal_px: float) -> bytes:
    """Pack ``CameraInfo`` of a pinhole camera, ``size_px`` (width, height) about its centre."""
    u, v = np.divide(size_px, 2)
    matrix = np.array([[focal_px, 0.0, u, 0.0], [0.0, focal_px, v, 0.0], [0.0, 0.0, 1.0, 0.0]])
    return cdr("hIsqdddIB", (stamp_ns, frame_id), size_px[::-1], "plumb_bob", np.zeros(5),
               matrix[:, :3], np.eye(3), matrix, [0] * 6, 0)  # fmt: skip


def pack_belief(stamp_ns: int, belief: BeliefMap) -> bytes:
    """Pack ``OccupancyGrid``: probability of support in percent, -1 where nothing was probed."""
    percent = np.where(belief.covered, np.rint(100.0 * belief.probability), -1.0).astype(np.int8)
    x, y = ((mm - 0.5 * belief.pitch_mm) / 1e3 for mm in belief.origin_mm)
    return cdr("hIfIdq", (stamp_ns, BELIEF_TOPIC.frame_id), [0, 0], belief.pitch_mm / 1e3,
               percent.shape[::-1], [x, y, 0.0, 0.0, 0.0, 0.0, 1.0], percent)  # fmt: skip


def pack_image(stamp_ns: int, frame_id: str, encoding: str, data: bytes) -> bytes:
    """Pack one ``CompressedImage``; ``encoding`` is "jpeg" or "png"."""
    return cdr("hsq", (stamp_ns, frame_id), encoding, data)


def pack_json(content: Mapping[str, object]) -> bytes:
    """Pack a JSON object as text in a ``std_msgs/String``."""
    return cdr("s", json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False))


def unpack_json(message: bytes | memoryview) -> dict[str, object]:
    """Unpack the message of ``pack_json``; raises ``ValueError`` for other content."""
    content = parse_json(CdrReader(message).text())
    if not isinstance(content, dict):
        raise ValueError("a JSON object is expected")
    return content


Messages = Sequence[bytes | memoryview]


def _stacked(messages: Messages) -> NDArray[np.uint8]:
    sizes = {len(message) for message in messages}
    if len(sizes) > 1:
        raise ValueError("messages of one topic differ in size")
    return np.frombuffer(b"".join(messages), np.uint8).reshape(len(messages), -1)


def stamps_ns(messages: Messages) -> Times:
    """Return (n,) header stamps of messages of any stamped type, in ns."""
    if not messages:
        return np.zeros(0, np.int64)
    heads = np.frombuffer(b"".join(bytes(m[4:12]) for m in messages), np.dtype("<i4,<u4"))
    stamps: Times = heads["f0"].astype(np.int64) * 1_000_000_000 + heads["f1"]
    return stamps


def _tail(messages: Messages, dtype: str, count: int) -> NDArray[np.generic]:
    width = np.dtype(dtype).itemsize * count
    if not messages:
        return np.zeros((0, count), dtype)
    rows = _stacked(messages)
    if rows.shape[1] < 12 + width:
        raise ValueError("a message is shorter than its type")
    return np.ascontiguousarray(rows[:, -width:]).view(dtype)


def unpack_wrench(messages: Messages) -> FloatArray:
    """Return (n, 6) in N and N·m."""
    return _tail(messages, "<f8", 6).astype(np.float64)


def unpack_pose_mm(messages: Messages) -> FloatArray:
    """Return (n, 3) positions in mm."""
    return _tail(messages, "<f8", 7).astype(np.float64)[:, :3] * 1e3


def unpack_observation(messages: Messages) -> NDArray[np.float32]:
    """Return (n, channels); raises ``ValueError`` unless the steps are 0, 1, ... n - 1."""
    if not messages:
        raise ValueError("the observation has no rows")
    reader = CdrReader(messages[0])
    reader.header()
    reader.integer("I")
    values = 4 * reader.sequence("<f4").size
    # All rows have the same layout: step, number of values, values.
    rows = _stacked(messages)
    heads = np.ascontiguousarray(rows[:, -values - 8 : rows.shape[1] - values]).view("<u4")
    if not (heads[:, 1] == values // 4).all():
        raise ValueError("the observation has rows of different length")
    if not np.array_equal(heads[:, 0], np.arange(len(rows))):
        raise ValueError("the steps of the observation are not in order")
    floats = np.ascontiguousarray(rows[:, rows.shape[1] - values :]).view("<f4")
    return np.asarray(floats, dtype=np.float32)


def _by_marker(values: NDArray[np.generic]) -> FloatArray:
    return np.ascontiguousarray(values.reshape(2, MARKERS).T, dtype=np.float64)


def unpack_markers(messages: Messages) -> MarkerRows:
    """Return the marker fields; raises ``ValueError`` for another grid."""
    position, displacement, state, figures = [], [], [], []
    for message in messages:
        reader = CdrReader(message)
        reader.header()
        if (reader.integer("H"), reader.integer("H")) != (GRID_ROWS, GRID_COLS):
            raise ValueError("the marker grid is not 7 x 9")
        displacement.append(_by_marker(reader.sequence("<f8")))
        state.append(reader.sequence("u1").astype(np.uint8))
        position.append(_by_marker(reader.sequence("<f8")))
        figures.append((reader.number("d"), reader.number("d")))
    quality = np.array(figures, dtype=np.float64).reshape(-1, 2)
    return MarkerRows(
        np.array(position).reshape(-1, MARKERS, 2),
        np.array(displacement).reshape(-1, MARKERS, 2),
        np.array(state, dtype=np.uint8).reshape(-1, MARKERS),
        quality[:, 0],
        quality[:, 1],
    )


def unpack_image(message: bytes | memoryview) -> tuple[str, bytes]:
    """Return (encoding, bytes) of a ``CompressedImage``."""
    reader = CdrReader(message)
    reader.header()
    return reader.text(), reader.sequence("u1").tobytes()

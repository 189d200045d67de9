"""Topics, schemas and messages of the episode files (data-and-labelling 2.4).

Messages that repeat at a fixed size are packed in one pass: ``(n, size)`` bytes for n messages.
ROS message types carry SI units, our own types mm and px.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.dataset.cdr import ENCAPSULATION, CdrReader, CdrWriter

ByteRows = NDArray[np.uint8]
Times = NDArray[np.int64]
Stamp = np.dtype([("sec", "<i4"), ("nsec", "<u4")])
_HEAD = len(ENCAPSULATION)


@dataclass(frozen=True, slots=True)
class Topic:
    """A channel of the file: its name, message type and constant ``frame_id``."""

    name: str
    schema: str
    frame_id: str = ""


OBS = Topic("/obs", "lab_msgs/msg/Observation", "obs")
LABEL = Topic("/episode/label", "std_msgs/msg/String")
EVENT = Topic("/episode/event", "std_msgs/msg/String")
WRENCH = Topic("/ft/tared", "geometry_msgs/msg/WrenchStamped", "ft")
POSE = Topic("/robot/pose", "geometry_msgs/msg/PoseStamped", "base")
COMMAND = Topic("/robot/command", "geometry_msgs/msg/PoseStamped", "base")
IMAGE = {
    "left": Topic("/tac/left/image", "sensor_msgs/msg/CompressedImage", "tac_left"),
    "right": Topic("/tac/right/image", "sensor_msgs/msg/CompressedImage", "tac_right"),
}
SCENE = Topic("/scene/image", "sensor_msgs/msg/CompressedImage", "scene")
MARKER = {
    "left": Topic("/tac/left/markers", "lab_msgs/msg/MarkerField", "tac_left"),
    "right": Topic("/tac/right/markers", "lab_msgs/msg/MarkerField", "tac_right"),
}


@lru_cache(maxsize=16)
def schema_text(name: str) -> bytes:
    """Return the ros2msg definition of ``name``, dependencies included."""
    file = files("resources").joinpath("schemas", name.replace("/", ".") + ".msg")
    return file.read_bytes()


def _repeat(template: bytes, stamps_ns: Times) -> ByteRows:
    rows = np.tile(np.frombuffer(template, np.uint8), (len(stamps_ns), 1))
    stamp = np.empty(len(stamps_ns), Stamp)
    stamp["sec"], stamp["nsec"] = stamps_ns // 1_000_000_000, stamps_ns % 1_000_000_000
    rows[:, _HEAD : _HEAD + 8] = stamp.view(np.uint8).reshape(-1, 8)
    return rows


def _fill(rows: ByteRows, offset: int, values: NDArray[np.generic]) -> None:
    raw = np.ascontiguousarray(values).view(np.uint8).reshape(len(rows), -1)
    rows[:, _HEAD + offset : _HEAD + offset + raw.shape[1]] = raw


def pack_wrench(stamps_ns: Times, wrench: FloatArray, frame_id: str = "ft") -> ByteRows:
    """Pack ``WrenchStamped``: ``wrench`` (n, 6) in N and N·m."""
    writer = CdrWriter()
    writer.header(0, frame_id)
    writer.align(8)
    offset = writer.size
    writer.numbers("d", [0.0] * 6)
    rows = _repeat(writer.finish(), stamps_ns)
    _fill(rows, offset, wrench.astype("<f8"))
    return rows


def pack_pose(stamps_ns: Times, position_mm: FloatArray, frame_id: str = "base") -> ByteRows:
    """Pack ``PoseStamped`` without rotation: ``position_mm`` (n, 3) becomes metres."""
    writer = CdrWriter()
    writer.header(0, frame_id)
    writer.align(8)
    offset = writer.size
    writer.numbers("d", [0.0] * 6 + [1.0])
    rows = _repeat(writer.finish(), stamps_ns)
    _fill(rows, offset, (position_mm / 1e3).astype("<f8"))
    return rows


def pack_observation(stamps_ns: Times, values: NDArray[np.float32]) -> ByteRows:
    """Pack ``Observation``: ``values`` (n, channels), step 0, 1, ... n - 1."""
    writer = CdrWriter()
    writer.header(0, OBS.frame_id)
    writer.align(4)
    step = writer.size
    writer.number("I", 0)
    offset = writer.sequence(np.zeros(values.shape[1], "<f4"))
    rows = _repeat(writer.finish(), stamps_ns)
    _fill(rows, step, np.arange(len(values), dtype="<u4"))
    _fill(rows, offset, values.astype("<f4"))
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
    writer = CdrWriter()
    writer.header(0, frame_id)
    writer.number("H", GRID_ROWS)
    writer.number("H", GRID_COLS)
    displacement = writer.sequence(np.zeros(2 * MARKERS, "<f8"))
    state = writer.sequence(np.zeros(MARKERS, np.uint8))
    position = writer.sequence(np.zeros(2 * MARKERS, "<f8"))
    writer.align(8)
    quality = writer.size
    writer.numbers("d", [0.0, 0.0])
    rows = _repeat(writer.finish(), stamps_ns)
    _fill(rows, displacement, _by_axis(markers.displacement_px))
    _fill(rows, state, markers.state)
    _fill(rows, position, _by_axis(markers.position_px))
    _fill(rows, quality, np.stack([markers.quality, markers.residual_px], 1).astype("<f8"))
    return rows


def pack_image(stamp_ns: int, frame_id: str, encoding: str, data: bytes) -> bytes:
    """Pack one ``CompressedImage``; ``encoding`` is "jpeg" or "png"."""
    writer = CdrWriter()
    writer.header(stamp_ns, frame_id)
    writer.text(encoding)
    writer.sequence(data)
    return writer.finish()


def pack_json(content: Mapping[str, object]) -> bytes:
    """Pack a JSON object as text in a ``std_msgs/String``."""
    writer = CdrWriter()
    writer.text(json.dumps(content, sort_keys=True, separators=(",", ":"), ensure_ascii=False))
    return writer.finish()


def unpack_json(message: bytes | memoryview) -> dict[str, object]:
    """Unpack ``pack_json``; raises ``ValueError`` if it is anything else."""
    content = json.loads(CdrReader(message).text())
    if not isinstance(content, dict):
        raise ValueError("a JSON object is expected")
    return content

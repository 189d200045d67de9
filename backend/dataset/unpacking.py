"""Arrays from the messages of the episode files, the way back of ``channels``."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.dataset.cdr import CdrReader
from backend.dataset.channels import MarkerRows, Times

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
    """Return (n, channels); raises ``ValueError`` unless the steps count 0, 1, ... n - 1."""
    if not messages:
        raise ValueError("the observation has no rows")
    reader = CdrReader(messages[0])
    reader.header()
    reader.integer("I")
    values = 4 * reader.sequence("<f4").size
    # All rows are packed alike: step, number of values and values end every one of them.
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

"""MCAP records as bytes. Source: foxglove/mcap, website/docs/spec (all integers little-endian)."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from backend.dataset.channels import ByteRows, Times

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
     ("log", "<u8"), ("publish", "<u8")]
)  # fmt: skip
INDEX_ENTRY = np.dtype([("log", "<u8"), ("offset", "<u8")])


class Op(IntEnum):
    """Record kinds."""

    HEADER = 1
    FOOTER = 2
    SCHEMA = 3
    CHANNEL = 4
    MESSAGE = 5
    CHUNK = 6
    MESSAGE_INDEX = 7
    CHUNK_INDEX = 8
    STATISTICS = 11
    METADATA = 12
    METADATA_INDEX = 13
    SUMMARY_OFFSET = 14
    DATA_END = 15


def text(value: str) -> bytes:
    """Return a length-prefixed string."""
    content = value.encode("utf-8")
    return struct.pack("<I", len(content)) + content


def text_map(values: Mapping[str, str]) -> bytes:
    """Return a map of strings."""
    content = b"".join(text(key) + text(value) for key, value in values.items())
    return struct.pack("<I", len(content)) + content


def number_map(values: Mapping[int, int]) -> bytes:
    """Return a map from u16 to u64."""
    content = b"".join(struct.pack("<HQ", key, value) for key, value in values.items())
    return struct.pack("<I", len(content)) + content


def record(op: Op, content: bytes) -> bytes:
    """Return a whole record."""
    return struct.pack("<BQ", op, len(content)) + content


@dataclass(frozen=True, slots=True)
class Block:
    """Messages of one channel: their records back to back, and where each starts in the block."""

    channel: int
    records: bytes
    log_ns: Times
    offsets: Times


def message_rows(channel: int, log_ns: Times, sequence: Times, rows: ByteRows) -> Block:
    """Make a block of n messages of equal size (``rows`` (n, size) uint8) in one pass."""
    head = np.zeros(len(rows), MESSAGE_HEAD)
    head["op"], head["channel"] = Op.MESSAGE, channel
    head["length"] = MESSAGE_HEAD.itemsize - 9 + rows.shape[1]
    head["sequence"], head["log"], head["publish"] = sequence, log_ns, log_ns
    whole = np.concatenate([head.view(np.uint8).reshape(len(rows), -1), rows], axis=1)
    offsets = np.arange(len(rows), dtype=np.int64) * whole.shape[1]
    return Block(channel, whole.tobytes(), log_ns, offsets)


def message_list(
    channel: int, log_ns: Iterable[int], sequence: Iterable[int], messages: Iterable[bytes]
) -> Block:
    """Make a block of messages of any size."""
    parts: list[bytes] = []
    offsets, times, at = [], [], 0
    for stamp, number, message in zip(log_ns, sequence, messages, strict=True):
        head = struct.pack("<HIQQ", channel, number, stamp, stamp)
        parts.append(record(Op.MESSAGE, head + message))
        offsets.append(at)
        times.append(stamp)
        at += len(parts[-1])
    return Block(channel, b"".join(parts), np.array(times, np.int64), np.array(offsets, np.int64))


def walk(content: bytes | memoryview, where: str) -> Iterator[tuple[int, memoryview]]:
    """Yield (kind, content) of every record; raises ``ValueError`` if one is cut short."""
    view = memoryview(content)
    at = 0
    while at < len(view):
        if at + 9 > len(view):
            raise ValueError(f"{where} ends inside a record")
        op, length = struct.unpack_from("<BQ", view, at)
        at += 9
        if length > len(view) - at:
            raise ValueError(f"{where} ends inside a record")
        yield op, view[at : at + length]
        at += length

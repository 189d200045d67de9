"""Write MCAP files whose every chunk repeats its schemas and channels, so that it decodes alone.

The reference library writes schemas into the first chunk only; a torn file that lost it cannot be
read. It also needs some 16 µs per message, which the blocks of ``records`` avoid.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import zstandard

from backend.core.files import make_folder, sync_folder
from backend.dataset.channels import Topic, schema_text
from backend.dataset.records import (
    INDEX_ENTRY,
    MAGIC,
    Block,
    Op,
    number_map,
    record,
    text,
    text_map,
)

LIBRARY = "touchdown"


class McapWriter:
    """One file under a temporary name; it appears under its own name when closed without error.

    Channel ids are the positions of ``topics`` counted from 1.
    """

    def __init__(self, path: Path, topics: Sequence[Topic]) -> None:
        self.path = path
        self.part = path.with_name(f".{path.name}.part")
        make_folder(path.parent)
        self.channel = {topic.name: number for number, topic in enumerate(topics, start=1)}
        self._schemas, self._channels = _definitions(topics)
        self._schema_count = len({topic.schema for topic in topics})
        self._counts = dict.fromkeys(self.channel.values(), 0)
        self._chunk_indexes: list[bytes] = []
        self._metadata_indexes: list[bytes] = []
        self._span_ns: tuple[int, int] | None = None
        self._zstd = zstandard.ZstdCompressor(level=1)
        self._crc = 0
        self._file = self.part.open("wb")
        self._put(MAGIC + record(Op.HEADER, text("ros2") + text(LIBRARY)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written per topic."""
        return {name: self._counts[number] for name, number in self.channel.items()}

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record."""
        start = self._file.tell()
        whole = record(Op.METADATA, text(name) + text_map(values))
        self._put(whole)
        entry = struct.pack("<QQ", start, len(whole)) + text(name)
        self._metadata_indexes.append(record(Op.METADATA_INDEX, entry))

    def add_chunk(self, blocks: Sequence[Block], *, compress: bool) -> None:
        """Append one self-contained chunk of ``blocks`` (at least one message in all)."""
        content = b"".join([self._schemas, self._channels, *(block.records for block in blocks)])
        times = np.concatenate([block.log_ns for block in blocks])
        first, last = int(times.min()), int(times.max())
        stored = self._zstd.compress(content) if compress else content
        kind = "zstd" if compress else ""
        head = struct.pack("<QQQI", first, last, len(content), zlib.crc32(content)) + text(kind)
        start = self._file.tell()
        chunk = record(Op.CHUNK, head + struct.pack("<Q", len(stored)) + stored)
        self._put(chunk)
        index_start = self._file.tell()
        where = self._add_message_indexes(blocks)
        index_length = self._file.tell() - index_start
        entry = struct.pack("<QQQQ", first, last, start, len(chunk)) + number_map(where)
        entry += struct.pack("<Q", index_length) + text(kind)
        entry += struct.pack("<QQ", len(stored), len(content))
        self._chunk_indexes.append(record(Op.CHUNK_INDEX, entry))
        old = self._span_ns or (first, last)
        self._span_ns = (min(first, old[0]), max(last, old[1]))

    def _add_message_indexes(self, blocks: Sequence[Block]) -> dict[int, int]:
        at = len(self._schemas) + len(self._channels)
        where: dict[int, int] = {}
        for block in blocks:
            entries = np.zeros(len(block.log_ns), INDEX_ENTRY)
            entries["log"], entries["offset"] = block.log_ns, block.offsets + at
            at += len(block.records)
            where[block.channel] = self._file.tell()
            head = struct.pack("<HI", block.channel, entries.nbytes)
            self._put(record(Op.MESSAGE_INDEX, head + entries.tobytes()))
            self._counts[block.channel] += len(block.log_ns)
        return where

    def _put(self, content: bytes) -> None:
        self._file.write(content)
        self._crc = zlib.crc32(content, self._crc)

    def finish(self) -> dict[str, int]:
        """Write the summary and make the unnamed file durable; returns the counts per topic."""
        if not self._file.closed:
            self._file.write(record(Op.DATA_END, struct.pack("<I", self._crc)))
            self._file.write(self._summary(self._file.tell()) + MAGIC)
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
        return self.counts

    def close(self) -> None:
        """Finish the file and give it its name; if the disk refuses, nothing of it stays."""
        try:
            self.finish()
            self.part.replace(self.path)
            sync_folder(self.path.parent)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Close and delete the unfinished file."""
        # Closing writes what is still in the buffer, which a full disk refuses once more.
        with contextlib.suppress(OSError):
            self._file.close()
        self.part.unlink(missing_ok=True)

    def _statistics(self) -> bytes:
        first, last = self._span_ns or (0, 0)
        counts = sum(self._counts.values()), self._schema_count, len(self._counts), 0
        head = struct.pack("<QHII", *counts)
        head += struct.pack("<II", len(self._metadata_indexes), len(self._chunk_indexes))
        body = struct.pack("<QQ", first, last) + number_map(self._counts)
        return record(Op.STATISTICS, head + body)

    def _summary(self, start: int) -> bytes:
        groups = [
            (Op.SCHEMA, self._schemas),
            (Op.CHANNEL, self._channels),
            (Op.STATISTICS, self._statistics()),
            (Op.CHUNK_INDEX, b"".join(self._chunk_indexes)),
            (Op.METADATA_INDEX, b"".join(self._metadata_indexes)),
        ]
        at, offsets = start, b""
        for op, content in groups:
            offsets += record(Op.SUMMARY_OFFSET, struct.pack("<BQQ", op, at, len(content)))
            at += len(content)
        summary = b"".join(content for _, content in groups) + offsets
        head = struct.pack("<BQQQ", Op.FOOTER, 20, start, at)
        return summary + head + struct.pack("<I", zlib.crc32(summary + head))


def _definitions(topics: Sequence[Topic]) -> tuple[bytes, bytes]:
    numbers: dict[str, int] = {}
    schemas, channels = b"", b""
    for channel, topic in enumerate(topics, start=1):
        if topic.schema not in numbers:
            numbers[topic.schema] = len(numbers) + 1
            body = text(topic.schema) + text("ros2msg")
            content = schema_text(topic.schema)
            body += struct.pack("<I", len(content)) + content
            schemas += record(Op.SCHEMA, struct.pack("<H", numbers[topic.schema]) + body)
        body = struct.pack("<HH", channel, numbers[topic.schema]) + text(topic.name)
        body += text("cdr") + text_map({"offered_qos_profiles": ""})
        channels += record(Op.CHANNEL, body)
    return schemas, channels

"""Reader and writer of MCAP files.

Source: foxglove/mcap, website/docs/spec (all integers little-endian). Every chunk repeats its
schemas and channels, so it can be decoded alone. All damage is raised as one ``InputError`` with
the path of the file.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import IntEnum
from hashlib import sha256
from pathlib import Path
from typing import Self

import numpy as np
import zstandard
from numpy.typing import ArrayLike

from touchdown.backend.core import InputError, make_folder, sync_folder
from touchdown.backend.episodes.messages import ByteRows, Times, Topic, schema_text

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEAD = np.dtype(
    [("op", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"),
     ("log", "<u8"), ("publish", "<u8")]
)  # fmt: skip
INDEX_ENTRY = np.dtype([("log", "<u8"), ("offset", "<u8")])
START_KEY = "clock_start_ns"  # wall clock at the zero of the bench clock, ns since 1970


class Opcode(IntEnum):
    """Record types."""

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


def encode_text(value: str) -> bytes:
    """Return a length-prefixed string."""
    content = value.encode("utf-8")
    return struct.pack("<I", len(content)) + content


def encode_text_map(values: Mapping[str, str]) -> bytes:
    """Return a map of strings."""
    content = b"".join(encode_text(key) + encode_text(value) for key, value in values.items())
    return struct.pack("<I", len(content)) + content


def encode_number_map(values: Mapping[int, int]) -> bytes:
    """Return a map from u16 to u64."""
    content = b"".join(struct.pack("<HQ", key, value) for key, value in values.items())
    return struct.pack("<I", len(content)) + content


def encode_record(op: Opcode, content: bytes) -> bytes:
    """Return a complete record."""
    return struct.pack("<BQ", op, len(content)) + content


@dataclass(frozen=True, slots=True)
class MessageBlock:
    """Messages of one channel: consecutive records, and the offset of each in the block."""

    channel: int
    records: bytes
    log_ns: Times
    offsets: Times


def message_rows(channel: int, log_ns: Times, sequence: Times, rows: ByteRows) -> MessageBlock:
    """Build a block of n messages of equal size from ``rows`` (n, size) uint8."""
    head = np.zeros(len(rows), MESSAGE_HEAD)
    head["op"], head["channel"] = Opcode.MESSAGE, channel
    head["length"] = MESSAGE_HEAD.itemsize - 9 + rows.shape[1]
    head["sequence"], head["log"], head["publish"] = sequence, log_ns, log_ns
    whole = np.concatenate([head.view(np.uint8).reshape(len(rows), -1), rows], axis=1)
    offsets = np.arange(len(rows), dtype=np.int64) * whole.shape[1]
    return MessageBlock(channel, whole.tobytes(), log_ns, offsets)


def message_list(
    channel: int, log_ns: Iterable[int], sequence: Iterable[int], messages: Iterable[bytes]
) -> MessageBlock:
    """Build a block of messages of any size."""
    parts: list[bytes] = []
    offsets, times, at = [], [], 0
    for stamp, number, message in zip(log_ns, sequence, messages, strict=True):
        head = struct.pack("<HIQQ", channel, number, stamp, stamp)
        parts.append(encode_record(Opcode.MESSAGE, head + message))
        offsets.append(at)
        times.append(stamp)
        at += len(parts[-1])
    return MessageBlock(
        channel, b"".join(parts), np.array(times, np.int64), np.array(offsets, np.int64)
    )


def iter_records(content: bytes | memoryview, where: str) -> Iterator[tuple[int, memoryview]]:
    """Yield (opcode, content) of every record; raises ``ValueError`` if one is incomplete."""
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


MAX_CHUNK_BYTES = 256_000_000
MAX_FILE_BYTES = 1_000_000_000
DATA_END_BYTES = 13
DAMAGE = (ValueError, LookupError, TypeError, ArithmeticError, RecursionError, struct.error,
          zstandard.ZstdError)  # fmt: skip
DAMAGED_FILE_FIX = "Use another copy of the file, or record or simulate it again."


@dataclass(slots=True)
class ChunkContents:
    """Metadata by name and messages by topic of one chunk, in file order."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: dict[str, list[memoryview]] = field(default_factory=dict)
    sequence: dict[str, list[int]] = field(default_factory=dict)
    log_ns: list[int] = field(default_factory=list)  # of all messages
    schemas: dict[str, str] = field(default_factory=dict)  # message types by topic


@dataclass(frozen=True, slots=True)
class StoredChunk:
    """One chunk record of a file: position, plain records, contents with the metadata before."""

    offset: int
    length: int
    records: bytes
    contents: ChunkContents

    @property
    def sha256(self) -> str:
        """Hash of the records, hexadecimal."""
        return sha256(self.records).hexdigest()


@contextmanager
def input_errors(path: Path) -> Iterator[None]:
    """Convert errors from a damaged or foreign file to an ``InputError`` with its path."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or "unreadable"
        fix = "Check the path."
        raise InputError(f"Cannot read the file: {reason}.", str(path), fix) from error
    except DAMAGE as error:
        fix = DAMAGED_FILE_FIX
        raise InputError(f"The file is damaged or foreign: {error}.", str(path), fix) from error


def read_bytes(path: Path) -> bytes:
    """Return the bytes of a file; raises ``ValueError`` if it is larger than any episode file."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_FILE_BYTES:
            raise ValueError(f"{size} bytes are more than any episode file has")
        return file.read(size)


def read_first(path: Path) -> ChunkContents:
    """Return the first chunk and the metadata before it, without reading the rest of the file.

    It contains the observation. The CRC of the chunk is checked, the end of the file is not.
    """
    with input_errors(path), path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it is not an MCAP file")
        group = ChunkContents()
        while not group.messages:
            op, length = struct.unpack("<BQ", file.read(9))
            if length > min(size - file.tell(), MAX_CHUNK_BYTES):
                raise ValueError("the file ends inside a record")
            content = memoryview(file.read(length))
            if op == Opcode.METADATA:
                group.metadata.update([read_metadata(content)])
            elif op == Opcode.CHUNK:
                _read_messages(read_chunk_records(content), group)
        return group


def read_chunk(path: Path, offset: int, length: int) -> ChunkContents:
    """Return the messages of the chunk record at ``offset``; its CRC is checked."""
    with input_errors(path), path.open("rb") as file:
        if not 9 <= length <= MAX_CHUNK_BYTES:
            raise ValueError("a chunk has an impossible size")
        file.seek(offset)
        data = file.read(length)
        op, size = struct.unpack_from("<BQ", data)
        if (op, size) != (Opcode.CHUNK, len(data) - 9) or len(data) != length:
            raise ValueError("there is no chunk where one was expected")
        group = ChunkContents()
        _read_messages(read_chunk_records(memoryview(data)[9:]), group)
        return group


def read_chunks(path: Path) -> Iterator[StoredChunk]:
    """Yield every chunk of a complete file; raises ``InputError`` if it is damaged.

    Checks both magics and the CRC of data, summary and every chunk. All chunks share one dictionary
    of the metadata read so far.
    """
    with input_errors(path):
        data = read_bytes(path)
        _check_ends(data)
        at, metadata = len(MAGIC), dict[str, dict[str, str]]()
        for op, content in iter_records(memoryview(data)[at : -len(MAGIC)], "the file"):
            if op == Opcode.METADATA:
                metadata.update([read_metadata(content)])
            elif op == Opcode.CHUNK:
                plain, group = read_chunk_records(content), ChunkContents(metadata)
                _read_messages(plain, group)
                yield StoredChunk(at, 9 + len(content), plain, group)
            elif op == Opcode.DATA_END:
                break
            at += 9 + len(content)


def read_whole(path: Path) -> ChunkContents:
    """Return all metadata and messages of a file in one ``ChunkContents``."""
    whole = ChunkContents()
    for chunk in read_chunks(path):
        whole.metadata = chunk.contents.metadata
        whole.log_ns += chunk.contents.log_ns
        whole.schemas |= chunk.contents.schemas
        for topic, messages in chunk.contents.messages.items():
            whole.messages.setdefault(topic, []).extend(messages)
            whole.sequence.setdefault(topic, []).extend(chunk.contents.sequence[topic])
    return whole


def check_counts(path: Path, expected: Mapping[str, int]) -> None:
    """Read back a new file; raises ``OSError`` unless it holds the expected messages."""
    try:
        whole = read_whole(path)
    except InputError as error:
        raise OSError(f"the episode could not be read back: {error.what}") from error
    found = {topic: len(messages) for topic, messages in whole.messages.items()}
    if found != {topic: count for topic, count in expected.items() if count}:
        raise OSError("the episode read back differs from what was written")


def _check_ends(data: bytes) -> None:
    if not data.startswith(MAGIC):
        raise ValueError("it is not an MCAP file")
    if len(data) < 75 or not data.endswith(MAGIC):
        raise ValueError("it is cut short")
    footer = len(data) - len(MAGIC) - 29
    op, length, start, _, crc = struct.unpack_from("<BQQQI", data, footer)
    if (op, length) != (Opcode.FOOTER, 20) or start > footer:
        raise ValueError("it has no footer")
    if crc and start and zlib.crc32(memoryview(data)[start : footer + 25]) != crc:
        raise ValueError("the checksum of its summary is wrong")
    end = max((start or footer) - DATA_END_BYTES, 0)
    op, length, crc = struct.unpack_from("<BQI", data, end)
    if (op, length) != (Opcode.DATA_END, 4):
        raise ValueError("its data has no end")
    if crc and zlib.crc32(memoryview(data)[:end]) != crc:
        raise ValueError("the checksum of its data is wrong")


def read_metadata(content: memoryview) -> tuple[str, dict[str, str]]:
    """Return (name, values) of a metadata record."""
    name, at = read_text(content, 0)
    (length,) = struct.unpack_from("<I", content, at)
    at, end = at + 4, at + 4 + length
    values: dict[str, str] = {}
    while at < end:
        key, at = read_text(content, at)
        values[key], at = read_text(content, at)
    return name, values


def read_chunk_records(content: memoryview) -> bytes:
    """Return the records of a chunk; raises ``ValueError`` if size or CRC are wrong."""
    size, crc = struct.unpack_from("<QI", content, 16)
    compression, at = read_text(content, 28)
    (stored,) = struct.unpack_from("<Q", content, at)
    records = content[at + 8 : at + 8 + stored]
    if size > MAX_CHUNK_BYTES or len(records) != stored:
        raise ValueError("a chunk has an impossible size")
    if compression == "zstd":
        # The decompressor allocates the size given in the frame and ignores any limit.
        if zstandard.frame_content_size(records) not in (-1, size):
            raise ValueError("a chunk has an impossible size")
        plain = zstandard.ZstdDecompressor().decompress(records, max_output_size=size)
    elif compression == "":
        plain = bytes(records)
    else:
        raise ValueError(f"unknown compression '{compression}'")
    if len(plain) != size or (crc and zlib.crc32(plain) != crc):
        raise ValueError("the checksum of a chunk is wrong")
    return plain


def _read_messages(plain: bytes, group: ChunkContents) -> None:
    topics, schemas = dict[int, str](), dict[int, str]()
    for op, content in iter_records(plain, "a chunk"):
        if op == Opcode.SCHEMA:
            schemas[struct.unpack_from("<H", content)[0]] = read_text(content, 2)[0]
        elif op == Opcode.CHANNEL:
            channel, schema = struct.unpack_from("<HH", content, 0)
            topics[channel] = read_text(content, 4)[0]
            group.schemas[topics[channel]] = schemas[schema]
        elif op == Opcode.MESSAGE:
            channel, sequence, log_ns = struct.unpack_from("<HIQ", content, 0)
            group.log_ns.append(log_ns)
            topic = topics[channel]
            group.messages.setdefault(topic, []).append(content[22:])
            group.sequence.setdefault(topic, []).append(sequence)


def read_text(content: memoryview, at: int) -> tuple[str, int]:
    """Return (text, end) of a length-prefixed string at ``at``."""
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ValueError("a text is longer than its record")
    return str(content[at + 4 : end], "utf-8"), end


LIBRARY = "touchdown"


class McapWriter:
    """Writer of one file under a temporary name; closing without error renames it.

    Channel ids are the positions of ``topics``, counted from 1.
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
        self.start_ns = 0  # added to the stamps of messages to get their log times
        self._zstd = zstandard.ZstdCompressor(level=1)
        self._crc = 0
        self._file = self.part.open("wb")
        self._put(MAGIC + encode_record(Opcode.HEADER, encode_text("ros2") + encode_text(LIBRARY)))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    @property
    def counts(self) -> dict[str, int]:
        """Messages written per topic."""
        return {name: self._counts[number] for name, number in self.channel.items()}

    def logged(self, stamps_ns: ArrayLike) -> Times:
        """Return the log times of messages with these stamps."""
        return np.asarray(stamps_ns, dtype=np.int64) + self.start_ns

    def add_metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Append a metadata record."""
        start = self._file.tell()
        whole = encode_record(Opcode.METADATA, encode_text(name) + encode_text_map(values))
        self._put(whole)
        entry = struct.pack("<QQ", start, len(whole)) + encode_text(name)
        self._metadata_indexes.append(encode_record(Opcode.METADATA_INDEX, entry))

    def add_chunk(self, blocks: Sequence[MessageBlock], *, compress: bool) -> None:
        """Append one self-contained chunk of ``blocks`` (at least one message in total)."""
        content = b"".join([self._schemas, self._channels, *(block.records for block in blocks)])
        times = np.concatenate([block.log_ns for block in blocks])
        first, last = int(times.min()), int(times.max())
        stored = self._zstd.compress(content) if compress else content
        kind = "zstd" if compress else ""
        head = struct.pack("<QQQI", first, last, len(content), zlib.crc32(content)) + encode_text(
            kind
        )
        start = self._file.tell()
        chunk = encode_record(Opcode.CHUNK, head + struct.pack("<Q", len(stored)) + stored)
        self._put(chunk)
        index_start = self._file.tell()
        where = self._add_message_indexes(blocks)
        index_length = self._file.tell() - index_start
        entry = struct.pack("<QQQQ", first, last, start, len(chunk)) + encode_number_map(where)
        entry += struct.pack("<Q", index_length) + encode_text(kind)
        entry += struct.pack("<QQ", len(stored), len(content))
        self._chunk_indexes.append(encode_record(Opcode.CHUNK_INDEX, entry))
        old = self._span_ns or (first, last)
        self._span_ns = (min(first, old[0]), max(last, old[1]))

    def block(
        self, topic: Topic, stamps_ns: ArrayLike, sequence: ArrayLike, messages: Iterable[bytes]
    ) -> MessageBlock:
        """Build a block of messages of ``topic``; of equal size where they are a ``ByteRows``."""
        channel, log_ns, numbers = (
            self.channel[topic.name],
            self.logged(stamps_ns),
            np.asarray(sequence),
        )
        if isinstance(messages, np.ndarray):
            return message_rows(channel, log_ns, numbers, messages)
        return message_list(channel, log_ns.tolist(), numbers.tolist(), messages)

    def _add_message_indexes(self, blocks: Sequence[MessageBlock]) -> dict[int, int]:
        at = len(self._schemas) + len(self._channels)
        where: dict[int, int] = {}
        for block in blocks:
            entries = np.zeros(len(block.log_ns), INDEX_ENTRY)
            entries["log"], entries["offset"] = block.log_ns, block.offsets + at
            at += len(block.records)
            where[block.channel] = self._file.tell()
            head = struct.pack("<HI", block.channel, entries.nbytes)
            self._put(encode_record(Opcode.MESSAGE_INDEX, head + entries.tobytes()))
            self._counts[block.channel] += len(block.log_ns)
        return where

    def _put(self, content: bytes) -> None:
        self._file.write(content)
        self._crc = zlib.crc32(content, self._crc)

    def finish(self) -> dict[str, int]:
        """Write the summary and make the file durable; return the counts per topic."""
        if not self._file.closed:
            self._file.write(encode_record(Opcode.DATA_END, struct.pack("<I", self._crc)))
            self._file.write(self._summary(self._file.tell()) + MAGIC)
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
        return self.counts

    def close(self) -> None:
        """Finish and rename the file; remove it if the disk fails."""
        try:
            self.finish()
            self.part.replace(self.path)
            sync_folder(self.path.parent)
        except BaseException:
            self.discard()
            raise

    def discard(self) -> None:
        """Close and delete the unfinished file."""
        # Closing flushes the buffer, which a full disk refuses again.
        with contextlib.suppress(OSError):
            self._file.close()
        self.part.unlink(missing_ok=True)

    def _statistics(self) -> bytes:
        first, last = self._span_ns or (0, 0)
        counts = sum(self._counts.values()), self._schema_count, len(self._counts), 0
        head = struct.pack("<QHII", *counts)
        head += struct.pack("<II", len(self._metadata_indexes), len(self._chunk_indexes))
        body = struct.pack("<QQ", first, last) + encode_number_map(self._counts)
        return encode_record(Opcode.STATISTICS, head + body)

    def _summary(self, start: int) -> bytes:
        groups = [
            (Opcode.SCHEMA, self._schemas),
            (Opcode.CHANNEL, self._channels),
            (Opcode.STATISTICS, self._statistics()),
            (Opcode.CHUNK_INDEX, b"".join(self._chunk_indexes)),
            (Opcode.METADATA_INDEX, b"".join(self._metadata_indexes)),
        ]
        at, offsets = start, b""
        for op, content in groups:
            offsets += encode_record(
                Opcode.SUMMARY_OFFSET, struct.pack("<BQQ", op, at, len(content))
            )
            at += len(content)
        summary = b"".join(content for _, content in groups) + offsets
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, at)
        return summary + head + struct.pack("<I", zlib.crc32(summary + head))


def _definitions(topics: Sequence[Topic]) -> tuple[bytes, bytes]:
    numbers: dict[str, int] = {}
    schemas, channels = b"", b""
    for channel, topic in enumerate(topics, start=1):
        if topic.schema not in numbers:
            numbers[topic.schema] = len(numbers) + 1
            body = encode_text(topic.schema) + encode_text("ros2msg")
            content = schema_text(topic.schema)
            body += struct.pack("<I", len(content)) + content
            schemas += encode_record(Opcode.SCHEMA, struct.pack("<H", numbers[topic.schema]) + body)
        body = struct.pack("<HH", channel, numbers[topic.schema]) + encode_text(topic.name)
        body += encode_text("cdr") + encode_text_map({"offered_qos_profiles": topic.qos})
        channels += encode_record(Opcode.CHANNEL, body)
    return schemas, channels

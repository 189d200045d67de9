"""Read MCAP files chunk by chunk; whatever is wrong becomes one ``InputError`` naming the file."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from hashlib import sha256
from pathlib import Path

import zstandard

from backend.core.faults import InputError
from backend.dataset.records import MAGIC, Op, walk

MAX_CHUNK_BYTES = 256_000_000
MAX_FILE_BYTES = 1_000_000_000
DATA_END_BYTES = 13
DAMAGE = (ValueError, LookupError, TypeError, ArithmeticError, RecursionError, struct.error,
          zstandard.ZstdError)  # fmt: skip
FIX = "Use another copy of the file, or record or simulate it again."


@dataclass(slots=True)
class Contents:
    """What lies between two ends of a group: metadata by name, messages by topic in file order."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    messages: dict[str, list[memoryview]] = field(default_factory=dict)
    sequence: dict[str, list[int]] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class StoredChunk:
    """One chunk record of a file: where it is, the hash of its records, and what they hold."""

    offset: int
    length: int
    sha256: str
    contents: Contents


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what a damaged or foreign file raises into an ``InputError`` naming it."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise InputError(
            f"Cannot read the file: {reason}.", str(path), "Check the path."
        ) from error
    except DAMAGE as error:
        raise InputError(f"The file is damaged or foreign: {error}.", str(path), FIX) from error


def read_groups(path: Path) -> Iterator[Contents]:
    """Yield one ``Contents`` per chunk, with the metadata records before it.

    Checks both magics and the CRC of data, summary and every chunk; raises ``InputError``.
    """
    with explained(path):
        data = read_bytes(path)
        _check_ends(data)
        yield from _groups(memoryview(data)[len(MAGIC) : -len(MAGIC)])


def read_bytes(path: Path) -> bytes:
    """Return a file's bytes; raises ``ValueError`` for more than an episode file can have."""
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_FILE_BYTES:
            raise ValueError(f"{size} bytes are more than any episode file has")
        return file.read(size)


def read_first(path: Path) -> Contents:
    """Return the first chunk and the metadata before it, without reading the rest of the file.

    Enough for what a model is given; ends are not checked, the chunk's CRC is.
    """
    with explained(path), path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if file.read(len(MAGIC)) != MAGIC:
            raise ValueError("it is not an MCAP file")
        group = Contents()
        while not group.messages:
            op, length = struct.unpack("<BQ", file.read(9))
            if length > min(size - file.tell(), MAX_CHUNK_BYTES):
                raise ValueError("the file ends inside a record")
            content = memoryview(file.read(length))
            if op == Op.METADATA:
                name, values = read_metadata(content)
                group.metadata[name] = values
            elif op == Op.CHUNK:
                _read_messages(open_chunk(content), group)
        return group


def read_chunk(path: Path, offset: int, length: int) -> Contents:
    """Return the messages of the one chunk record at ``offset``; its CRC is checked."""
    with explained(path), path.open("rb") as file:
        if not 9 <= length <= MAX_CHUNK_BYTES:
            raise ValueError("a chunk has an impossible size")
        file.seek(offset)
        data = file.read(length)
        op, size = struct.unpack_from("<BQ", data)
        if (op, size) != (Op.CHUNK, len(data) - 9) or len(data) != length:
            raise ValueError("there is no chunk where one was expected")
        group = Contents()
        _read_messages(open_chunk(memoryview(data)[9:]), group)
        return group


def read_chunks(path: Path) -> Iterator[StoredChunk]:
    """Yield every chunk of a complete file; raises ``InputError`` where it is damaged."""
    with explained(path):
        data = read_bytes(path)
        _check_ends(data)
        at = len(MAGIC)
        for op, content in walk(memoryview(data)[at : -len(MAGIC)], "the file"):
            if op == Op.CHUNK:
                plain, group = open_chunk(content), Contents()
                _read_messages(plain, group)
                yield StoredChunk(at, 9 + len(content), sha256(plain).hexdigest(), group)
            at += 9 + len(content)


def read_whole(path: Path) -> Contents:
    """Return all metadata and messages of a file in one ``Contents``."""
    whole = Contents()
    for part in read_groups(path):
        whole.metadata.update(part.metadata)
        for topic, messages in part.messages.items():
            whole.messages.setdefault(topic, []).extend(messages)
            whole.sequence.setdefault(topic, []).extend(part.sequence[topic])
    return whole


def check_counts(path: Path, expected: Mapping[str, int]) -> None:
    """Read a file just written; raises ``OSError`` unless it holds the expected messages."""
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
    if (op, length) != (Op.FOOTER, 20) or start > footer:
        raise ValueError("it has no footer")
    if crc and start and zlib.crc32(memoryview(data)[start : footer + 25]) != crc:
        raise ValueError("the checksum of its summary is wrong")
    _check_data(memoryview(data), (start or footer) - DATA_END_BYTES)


def _check_data(data: memoryview, end: int) -> None:
    op, length, crc = struct.unpack_from("<BQI", data, max(end, 0))
    if (op, length) != (Op.DATA_END, 4):
        raise ValueError("its data has no end")
    if crc and zlib.crc32(data[:end]) != crc:
        raise ValueError("the checksum of its data is wrong")


def _groups(body: memoryview) -> Iterator[Contents]:
    group = Contents()
    for op, content in walk(body, "the file"):
        if op == Op.METADATA:
            name, values = read_metadata(content)
            group.metadata[name] = values
        elif op == Op.CHUNK:
            _read_messages(open_chunk(content), group)
            yield group
            group = Contents()
        elif op == Op.DATA_END:
            break
    if group.metadata:
        yield group


def read_metadata(content: memoryview) -> tuple[str, dict[str, str]]:
    """Return (name, values) of a metadata record."""
    name, at = read_text(content, 0)
    return name, _text_map(content, at)


def open_chunk(content: memoryview) -> bytes:
    """Return the records within a chunk; raises ``ValueError`` unless size and CRC are right."""
    size, crc = struct.unpack_from("<QI", content, 16)
    compression, at = read_text(content, 28)
    (stored,) = struct.unpack_from("<Q", content, at)
    records = content[at + 8 : at + 8 + stored]
    if size > MAX_CHUNK_BYTES or len(records) != stored:
        raise ValueError("a chunk has an impossible size")
    if compression == "zstd":
        # The decompressor allocates what the frame claims, whatever limit it is given.
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


def _read_messages(plain: bytes, group: Contents) -> None:
    topics: dict[int, str] = {}
    for op, content in walk(plain, "a chunk"):
        if op == Op.CHANNEL:
            (channel,) = struct.unpack_from("<H", content, 0)
            topics[channel] = read_text(content, 4)[0]
        elif op == Op.MESSAGE:
            channel, sequence = struct.unpack_from("<HI", content, 0)
            topic = topics[channel]
            group.messages.setdefault(topic, []).append(content[22:])
            group.sequence.setdefault(topic, []).append(sequence)


def read_text(content: memoryview, at: int) -> tuple[str, int]:
    """Return (text, where it ends) of a length-prefixed string at ``at``."""
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ValueError("a text is longer than its record")
    return str(content[at + 4 : end], "utf-8"), end


def _text_map(content: memoryview, at: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", content, at)
    at, end = at + 4, at + 4 + length
    values: dict[str, str] = {}
    while at < end:
        key, at = read_text(content, at)
        values[key], at = read_text(content, at)
    return values

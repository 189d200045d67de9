"""Save what a torn episode file still holds: every complete chunk whose checksum is right.

A chunk of ours carries its own schemas and channels, so that any of them decodes alone. Metadata
records have no checksum; they are taken as they stand. The torn file itself is never changed.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path

from backend.core.faults import InputError
from backend.core.files import write_atomically
from backend.dataset.channels import Topic, schema_text
from backend.dataset.container import McapWriter
from backend.dataset.contents import (
    DAMAGE,
    open_chunk,
    read_bytes,
    read_metadata,
    read_text,
    read_whole,
)
from backend.dataset.records import MAGIC, Block, Op, message_list, walk


@dataclass(frozen=True, slots=True)
class Salvaged:
    """What was saved: ``path`` is None if nothing was; ``reason`` says where reading ended."""

    path: Path | None
    chunks: int
    messages: dict[str, int]
    reason: str


@dataclass(slots=True)
class _Good:
    """The readable head of a torn file: its channels, metadata and chunks (blocks, compressed)."""

    topics: list[Topic] = field(default_factory=list)
    metadata: list[tuple[str, dict[str, str]]] = field(default_factory=list)
    chunks: list[tuple[list[Block], bool]] = field(default_factory=list)
    reason: str = "the file is complete"


def salvage(torn: Path, target: Path) -> Salvaged:
    """Copy the good chunks of ``torn`` into a new file ``target``, re-opened and counted.

    A report lies beside it as ``<target>.json``. Raises ``OSError`` if the disk refuses, or if
    what was written does not read back.
    """
    good = _read_good(torn)
    counts: dict[str, int] = {}
    path = None
    if good.chunks:
        counts = _write(good, target)
        path = target
    saved = Salvaged(path, len(good.chunks), counts, good.reason)
    report = {"from": torn.name, "bytes": torn.stat().st_size, **asdict(saved)}
    report["path"] = path and path.name
    text = json.dumps(report, indent=1, sort_keys=True)
    write_atomically(target.with_name(f"{target.name}.json"), text.encode())
    return saved


def _read_good(torn: Path) -> _Good:
    good = _Good()
    try:
        data = read_bytes(torn)
        if not data.startswith(MAGIC):
            raise ValueError("it is not an MCAP file")
        for op, content in walk(memoryview(data)[len(MAGIC) :], "the file"):
            if op == Op.METADATA:
                good.metadata.append(read_metadata(content))
            elif op == Op.CHUNK:
                _take_chunk(content, good)
            elif op == Op.DATA_END:
                break
    except DAMAGE as error:
        good.reason = str(error)
    return good


def _take_chunk(content: memoryview, good: _Good) -> None:
    (crc,) = struct.unpack_from("<I", content, 24)
    if not crc:
        raise ValueError("a chunk has no checksum")
    plain = open_chunk(content)
    topics = list(_topics(plain))
    if len({topic.name for topic in topics}) != len(topics):
        raise ValueError("two channels of a chunk have one name")
    if good.topics and topics != good.topics:
        raise ValueError("a chunk belongs to another file")
    good.topics = topics
    blocks = _blocks(plain, len(topics))
    if blocks:
        good.chunks.append((blocks, read_text(content, 28)[0] == "zstd"))


def _topics(plain: bytes) -> Iterator[Topic]:
    schemas: dict[int, str] = {}
    expected = 1
    for op, content in walk(plain, "a chunk"):
        if op == Op.SCHEMA:
            schemas[struct.unpack_from("<H", content)[0]] = read_text(content, 2)[0]
        elif op == Op.CHANNEL:
            channel, schema = struct.unpack_from("<HH", content)
            if channel != expected:
                raise ValueError("the channels of a chunk are not those of an episode")
            expected += 1
            yield _known(Topic(read_text(content, 4)[0], schemas[schema]))


def _known(topic: Topic) -> Topic:
    try:
        schema_text(topic.schema)
    except OSError as error:
        raise ValueError(f"unknown message type '{topic.schema[:60]}'") from error
    return topic


def _blocks(plain: bytes, channels: int) -> list[Block]:
    """Return the messages, one block per channel, in file order within each."""
    messages: dict[int, list[tuple[int, int, bytes]]] = {}
    for op, content in walk(plain, "a chunk"):
        if op == Op.MESSAGE:
            channel, sequence, log_ns = struct.unpack_from("<HIQ", content)
            if not 0 < channel <= channels:
                raise ValueError("a message belongs to no channel")
            messages.setdefault(channel, []).append((log_ns, sequence, bytes(content[22:])))
    return [message_list(channel, *zip(*rows, strict=True)) for channel, rows in messages.items()]


def _write(good: _Good, target: Path) -> dict[str, int]:
    with McapWriter(target, good.topics) as writer:
        for name, values in good.metadata:
            writer.add_metadata(name, values)
        for blocks, compressed in good.chunks:
            writer.add_chunk(blocks, compress=compressed)
    counts = {topic: count for topic, count in writer.counts.items() if count}
    try:
        whole = read_whole(target)
    except InputError as error:
        raise OSError(f"what was salvaged cannot be read back: {error.what}") from error
    if {topic: len(messages) for topic, messages in whole.messages.items()} != counts:
        raise OSError("what was salvaged reads back with other messages")
    return counts

"""Packs of simulated episodes as entries of a dataset: each chunk is one episode.

A chunk is named by its content, so that the same pack is the same episodes wherever it lies. One
series stands for one pack; its ``bench`` holds name and size, by which a start knows it again.
"""

from __future__ import annotations

import json
import sqlite3
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from backend.catalogue import episodes, heads, operations
from backend.catalogue.findings import Finding, Store
from backend.catalogue.raw_files import is_readable, label_of, set_aside
from backend.catalogue.salvage import salvage
from backend.catalogue.uuid7 import from_parts
from backend.catalogue.values import PROGRAM, Content
from backend.core.faults import InputError
from backend.core.flow import Episode, EpisodeQuality
from backend.dataset.channels import LABEL, OBS, unpack_json
from backend.dataset.contents import FIX, StoredChunk, explained, read_chunk, read_chunks
from backend.dataset.unpacking import unpack_observation
from backend.objects.catalogue import Catalogue, load_catalogue

PACKS = "packs"
MODE = "mass"
GOOD = EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
"""Simulated episodes that fail a check are drawn again before they are packed."""
RANDOM_BITS = 74


@dataclass(frozen=True, slots=True)
class Packed:
    """One episode of a pack: its id, where it stands, and its label message."""

    uuid: str
    chunk: StoredChunk
    label: Mapping[str, Any]


def check_packs(where: Store, *, whole: bool) -> Iterator[Finding]:
    """Yield what is out of order in the folder ``packs``; ``whole`` reads every chunk again."""
    folder = where.folder / PACKS
    known = _known_packs(where)
    found: set[str] = set()
    for path in sorted(folder.glob("*.mcap")) if folder.is_dir() else ():
        if path.name.startswith("."):
            continue
        name = where.name(path)
        found.add(name)
        if known.get(name) == path.stat().st_size and not whole:
            continue
        try:
            listed = list(read_pack_chunks(path))
        except InputError as error:
            if is_readable(path):
                yield Finding("not-adopted", name, f"{name} is no pack: {error.what}")
            else:
                yield _torn(where, path, error)
            continue
        yield from _compare(where, path, listed, found)
    for name in sorted(set(known) - found):
        yield from _gone(where, name)


def read_pack_chunks(path: Path) -> Iterator[Packed]:
    """Yield the episodes of a complete pack; raises ``InputError`` if it is damaged or foreign."""
    for chunk in read_chunks(path):
        messages = chunk.contents.messages.get(LABEL.name)
        if not messages or "episode" in chunk.contents.metadata:
            raise InputError("The file is not a pack of episodes.", str(path), FIX)
        with explained(path):
            label = unpack_json(messages[0])
            label_of(label)
            yield Packed(uuid_of(chunk), chunk, label)


def read_packed(path: Path, chunk: tuple[int, int]) -> Episode:
    """Read one episode of a pack: what the model sees and the commanded offset, no recording."""
    group = read_chunk(path, *chunk)
    with explained(path):
        label = unpack_json(group.messages[LABEL.name][0])
        observation = unpack_observation(group.messages[OBS.name])
        name, piece = str(label["episode"]), str(label["piece"])
        return Episode(name, piece, observation, label_of(label).offset_mm, 0.0, GOOD)


def uuid_of(chunk: StoredChunk) -> str:
    """Return the id of a packed episode: from its content, at the beginning of time."""
    return from_parts(0, int(chunk.sha256, 16) >> (256 - RANDOM_BITS))


def _known_packs(where: Store) -> dict[str, int]:
    rows = where.database.rows("SELECT bench FROM series WHERE mode = ?", (MODE,))
    facts = [json.loads(bench) for (bench,) in rows]
    return {fact["pack"]: fact["bytes"] for fact in facts if "pack" in fact}


def _compare(where: Store, path: Path, listed: list[Packed], found: set[str]) -> Iterator[Finding]:
    """Yield what to do with a complete pack that is new, or not as it was.

    The former name of a renamed pack joins ``found``.
    """
    name = where.name(path)
    marks = ", ".join("?" * len(listed))
    rows = where.database.rows(
        f"SELECT uuid, path, chunk_off, state FROM episode WHERE path = ? OR uuid IN ({marks})",  # noqa: S608
        [name, *(packed.uuid for packed in listed)],
    )
    there = {uuid: (at, offset, state) for uuid, at, offset, state in rows}
    elsewhere = {there[p.uuid][0] for p in listed if p.uuid in there} - {name}
    if any((where.folder / other).exists() for other in elsewhere):
        said = f"{name} holds episodes of {min(elsewhere)} again: moved to quarantine."
        yield Finding("double", name, said, lambda _: _aside(where, path))
        return
    found |= elsewhere
    changed = [p for p in listed if there.get(p.uuid) != (name, p.chunk.offset, "complete")]
    lost = [u for u, row in there.items() if row[0] == name and row[2] == "complete"]
    lost = sorted(set(lost) - {p.uuid for p in listed})
    if lost:
        said = f"{len(lost)} episodes of {name} are gone or changed: marked as damaged."
        yield Finding("damaged", name, said, lambda c: _mark(c, lost, "damaged"))
    if changed:
        new = sum(p.uuid not in there for p in changed)
        said = f"{len(changed)} episodes of {name} entered ({new} of them new)."
        yield Finding("adopt", name, said, lambda c: enter_pack(c, where, path, changed))


def enter_pack(
    connection: sqlite3.Connection, where: Store, path: Path, listed: list[Packed]
) -> None:
    """Enter rows and first labels of packed episodes, as one operation; known ones are moved."""
    catalogue = load_catalogue()
    name, size = where.name(path), path.stat()
    series = from_parts(0, int(listed[0].chunk.sha256[:16], 16))
    bench = json.dumps({"pack": name, "bytes": size.st_size})
    connection.execute("DELETE FROM series WHERE uuid = ?", (series,))
    values = (series, size.st_mtime_ns, "", "", MODE, bench)
    connection.execute("INSERT INTO series VALUES (?, ?, ?, ?, ?, ?)", values)
    revisions = []
    for packed in listed:
        known = connection.execute("SELECT 1 FROM episode WHERE uuid = ?", (packed.uuid,))
        if known.fetchone():
            _move(connection, name, packed)
            continue
        geometry = _pair(where, catalogue, packed.label, path)
        row = _row(packed, series, name, size.st_mtime_ns, geometry)
        episodes.insert(connection, row)
        if not _has_label(connection, packed.uuid):
            label, source = label_of(packed.label), str(packed.label.get("source", "commanded"))
            content = Content(label, source, geometry)
            revisions.append(operations.new_revision(packed.uuid, None, content, "draft"))
    touched = {packed.uuid for packed in listed}
    if revisions:
        draft = operations.Draft(revs=revisions)
        operations.append(connection, where.site, PROGRAM, "adopt", draft)
    heads.refresh(connection, touched)


def _row(packed: Packed, series: str, name: str, recorded_ns: int, geometry: str) -> dict[str, Any]:
    label, chunk = packed.label, packed.chunk
    words = ("piece", "bottom", "grip_id", "mounting_id", "person")
    return {
        **{word: str(label[word]) for word in words},
        "uuid": packed.uuid,
        "series": series,
        "campaign": "",
        "plan_item": None,
        "kind": "pack",
        "path": name,
        "chunk_off": chunk.offset,
        "chunk_len": chunk.length,
        "crc": None,
        "sha256": chunk.sha256,
        "bytes": chunk.length,
        "recorded_ns": recorded_ns,
        "geometry": geometry,
        "mode": MODE,
        "quality": json.dumps(asdict(GOOD)),
        "accepted": 1,
        "keep_frames": "none",
        "state": "complete",
        "adopted": 1,
    }


def _pair(where: Store, catalogue: Catalogue, label: Mapping[str, Any], path: Path) -> str:
    """Store the geometry that a packed label was computed with; returns the hash of the pair."""
    piece, bottom = catalogue.piece(label["piece"]), catalogue.piece(label["bottom"])
    if piece.sha256 != label["geometry"]:
        raise InputError(
            f"The piece '{piece.name}' was changed since this pack was simulated.",
            str(path),
            "Simulate it again, or bring the former piece file back.",
        )
    return where.geometry.store_pair(piece, bottom)


def _has_label(connection: sqlite3.Connection, uuid: str) -> bool:
    sql = "SELECT 1 FROM label_rev WHERE episode = ? LIMIT 1"
    return connection.execute(sql, (uuid,)).fetchone() is not None


def _move(connection: sqlite3.Connection, name: str, packed: Packed) -> None:
    connection.execute(
        "UPDATE episode SET path = ?, chunk_off = ?, chunk_len = ?, bytes = ?, state = 'complete'"
        " WHERE uuid = ?",
        (name, packed.chunk.offset, packed.chunk.length, packed.chunk.length, packed.uuid),
    )


def _mark(connection: sqlite3.Connection, uuids: list[str], state: str) -> None:
    rows = [(state, uuid) for uuid in uuids]
    connection.executemany("UPDATE episode SET state = ? WHERE uuid = ?", rows)


def _gone(where: Store, name: str) -> Iterator[Finding]:
    sql = "SELECT uuid FROM episode WHERE path = ? AND state = 'complete'"
    uuids = [uuid for (uuid,) in where.database.rows(sql, (name,))]
    if uuids:

        def mend(connection: sqlite3.Connection) -> None:
            _mark(connection, uuids, "missing")
            # Of no size, so that it is read again when it comes back.
            values = (json.dumps({"pack": name, "bytes": 0}), uuids[0])
            sql = "UPDATE series SET bench = ? WHERE uuid = (SELECT series FROM episode"
            connection.execute(f"{sql} WHERE uuid = ?)", values)

        said = f"The pack {name} with {len(uuids)} episodes is missing; their labels are kept."
        yield Finding("missing", name, said, mend)


def _torn(where: Store, path: Path, error: InputError) -> Finding:
    name = where.name(path)

    def mend(connection: sqlite3.Connection) -> None:
        repaired = where.quarantine / f"{path.stem}.repaired.mcap"
        where.quarantine.mkdir(exist_ok=True)
        saved = salvage(path, repaired)
        set_aside(where, path)
        if saved.path is not None:
            repaired.replace(path)
            listed = list(read_pack_chunks(path))
            enter_pack(connection, where, path, listed)
            kept = {packed.uuid for packed in listed}
        else:
            kept = set()
        rows = connection.execute("SELECT uuid FROM episode WHERE path = ?", (name,)).fetchall()
        _mark(connection, [uuid for (uuid,) in rows if uuid not in kept], "damaged")

    said = f"The pack {name} is damaged: {error.what} Its whole episodes were saved."
    return Finding("torn", name, said, mend)


def _aside(where: Store, path: Path) -> None:
    set_aside(where, path)

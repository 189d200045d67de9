"""Consistency of episode and pack files with the index: adopt, mark, salvage, quarantine.

No file that holds data is deleted. Each chunk of a pack is one episode of the dataset.
"""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from hashlib import file_digest, sha256
from pathlib import Path
from typing import Any, NamedTuple

from touchdown.backend import core, episodes
from touchdown.backend.annotations import episode_index, operation_log, review
from touchdown.backend.annotations.consistency import (
    ConsistencyProblem,
    DatasetParts,
    leftover,
    stamp_of,
)
from touchdown.backend.annotations.values import (
    PROGRAM_ACTOR,
    Label,
    LabelContent,
    uuid7_from_parts,
)
from touchdown.backend.geometry import PieceLibrary, load_pieces

PART = ".part"


class EpisodeFileRow(NamedTuple):
    """Catalogue row of one file; a named tuple, as there are many."""

    uuid: str
    path: str
    bytes: int
    sha256: str
    state: str


@dataclass(frozen=True, slots=True)
class CompleteFile:
    """Row and label message of a complete file."""

    row: dict[str, Any]
    message: Mapping[str, Any]


def check_episode_files(parts: DatasetParts, *, whole: bool) -> Iterator[ConsistencyProblem]:
    """Yield the problems below ``raw``; ``whole`` also compares every hash.

    Folders that were checked before and did not change are skipped unless ``whole``.
    """
    now_ns = time.time_ns()
    known = {} if whole else parts.checked.unchanged(parts.folder)
    names = list(_folders(parts, episode_index.RAW, known))
    rows = _folder_rows(parts, known, {*names, *parts.checked.looks} - set(known))
    if rows is None:
        known, names = {}, list(_folders(parts, episode_index.RAW, {}))
        rows = _folder_rows(parts, known, set()) or []
    folders = [name for name in names if name not in known]
    stamps = {name: stamp_of(parts.folder / name) for name in folders}
    parts.checked.looks = {name: parts.checked.looks[name] for name in known}
    disorder: set[str] = set()
    for finding, folder in _compare_files(parts, folders, rows, whole=whole):
        disorder.add(folder)
        yield finding
    counts = Counter(row.path.rpartition("/")[0] for row in rows)
    # Folders with subfolders are always read.
    outer = {name.rpartition("/")[0] for name in names}
    for name in set(folders) - disorder - outer:
        parts.checked.remember(name, stamps[name], counts[name], now_ns)


def _folder_rows(
    parts: DatasetParts, known: Mapping[str, int], folders: set[str]
) -> list[EpisodeFileRow] | None:
    """Return the rows of ``folders``, or all rows if no folder is ``known``.

    None if they and the rows of the known folders are not complete: then no folder may be skipped.
    """
    sql = "SELECT uuid, path, bytes, sha256, state FROM episode WHERE kind = 'file'"
    if not known:
        return [EpisodeFileRow._make(row) for row in parts.database.rows(sql)]
    # Files of the folder itself, without its subfolders; '0' follows '/' in the sort order. The
    # index on paths is searched first, since most folders have no rows.
    sql += (
        " AND uuid IN (SELECT uuid FROM episode WHERE path >= ? || '/' AND path < ? || '0'"
        " AND NOT instr(substr(path, ?), '/'))"
    )
    rows = [
        EpisodeFileRow._make(row)
        for name in sorted(folders)
        for row in parts.database.rows(sql, (name, name, len(name) + 2))
    ]
    # ``kind`` has no index: everything outside of packs is a file.
    count_sql = "SELECT count(*) FROM episode WHERE NOT (path >= 'packs/' AND path < 'packs0')"
    (count,) = parts.database.one(count_sql)
    return rows if count == len(rows) + sum(known.values()) else None


def _compare_files(
    parts: DatasetParts, folders: Sequence[str], rows: Sequence[EpisodeFileRow], *, whole: bool
) -> Iterator[tuple[ConsistencyProblem, str]]:
    """Yield problems, each with the folder that it concerns."""
    by_path = {row.path: row for row in rows}
    index = _RowIndex(parts, {row.uuid: row for row in rows})
    found: set[str] = set()
    for folder in folders:
        for name, size in _files(parts.folder / folder, folder):
            parts.progress("Episode files", len(found), len(rows))
            row = by_path.get(name)
            if row is not None:
                found.add(name)
                if not whole and size == row.bytes and row.state == "complete":
                    continue
                findings = _check_known_file(parts, parts.folder / name, size, row, whole=whole)
            elif name.endswith(PART):
                findings = _leftover(parts, parts.folder / name, by_path)
            else:
                findings = _unknown(parts, parts.folder / name, index)
            for finding in findings:
                if finding.kind == "moved":
                    found.add(index[finding.target].path)
                yield finding, folder
    for row in rows:
        if row.path not in found and row.state == "complete":
            message = f"The file of episode {row.uuid} is missing; its label is kept."
            yield _state(row, "missing", message), row.path.rpartition("/")[0]


class _RowIndex(dict[str, EpisodeFileRow]):
    """Rows by uuid; rows that were not preloaded are queried."""

    def __init__(self, parts: DatasetParts, rows: Mapping[str, EpisodeFileRow]) -> None:
        super().__init__(rows)
        self._database = parts.database

    def find(self, uuid: str) -> EpisodeFileRow | None:
        """Return the row of an episode file, or None."""
        if uuid not in self:
            sql = "SELECT uuid, path, bytes, sha256, state FROM episode WHERE uuid = ?"
            row = self._database.first(f"{sql} AND kind = 'file'", (uuid,))
            if row is None:
                return None
            self[uuid] = EpisodeFileRow._make(row)
        return self[uuid]


def _folders(parts: DatasetParts, name: str, known: Mapping[str, int]) -> Iterator[str]:
    """Yield ``name`` and all folders below it, in order; known folders are not entered."""
    if not (parts.folder / name).is_dir():
        return
    yield name
    if name in known:
        return
    with os.scandir(parts.folder / name) as entries:
        below = sorted(e.name for e in entries if e.is_dir(follow_symlinks=False))
    for each in below:
        yield from _folders(parts, f"{name}/{each}", known)


def _files(folder: Path, name: str) -> Iterator[tuple[str, int]]:
    """Yield episode files and leftovers in ``folder``, called ``name``, with their sizes.

    Yields texts: constructing 100,000 ``Path`` objects takes longer than reading the folder.
    """
    with os.scandir(folder) as entries:
        listed = sorted(entries, key=lambda entry: entry.name)
    for entry in listed:
        if entry.name.endswith((".mcap", PART)) and entry.is_file(follow_symlinks=False):
            yield f"{name}/{entry.name}", entry.stat(follow_symlinks=False).st_size


def _check_known_file(
    parts: DatasetParts, path: Path, size: int, row: EpisodeFileRow, *, whole: bool
) -> Iterator[ConsistencyProblem]:
    same = size == row.bytes
    if same and (whole or row.state != "complete"):
        same = file_sha256(path) == row.sha256
    if same and row.state != "complete":
        yield _state(row, "complete", f"The file of episode {row.uuid} is back, unchanged.")
    elif not same and row.state == "complete":
        if size != row.bytes and not is_readable(path):
            yield _torn_file(parts, path, row)
        else:
            message = (
                f"The file of episode {row.uuid} was changed: marked as damaged, left in place."
            )
            yield _state(row, "damaged", message)


def _unknown(parts: DatasetParts, path: Path, by_uuid: _RowIndex) -> Iterator[ConsistencyProblem]:
    try:
        complete = read_complete(path, parts.folder)
    except core.InputError as error:
        if is_readable(path):
            message = f"{parts.name(path)} is no episode of a dataset: {error.what}"
            yield ConsistencyProblem("not-adopted", parts.name(path), message)
        else:
            yield _torn_file(parts, path, None)
        return
    uuid = complete.row["uuid"]
    row = by_uuid.find(uuid)
    if row is None:
        names = EpisodeFileRow._fields
        by_uuid[uuid] = EpisodeFileRow(**{name: complete.row[name] for name in names})
        message = f"Episode {uuid} was on disk without a row: adopted."
        yield ConsistencyProblem("adopt", uuid, message, lambda c: adopt_file(c, parts, complete))
    else:
        yield _second_file(parts, path, row)


def read_complete(path: Path, root: Path) -> CompleteFile:
    """Read an episode file with all checksums; raises ``InputError`` if it is incomplete."""
    contents = episodes.read_whole(path)
    messages = contents.messages.get(episodes.LABEL_TOPIC.name, [])
    if "episode" not in contents.metadata or not messages:
        fix = episodes.DAMAGED_FILE_FIX
        raise core.InputError("The file has no label message to adopt it by.", str(path), fix)
    with episodes.input_errors(path):
        facts, message = contents.metadata["episode"], episodes.unpack_json(messages[-1])
        quality = core.parse_json(facts["quality"])
        quality["reasons"] = tuple(quality["reasons"])
        if facts["uuid"] != message["episode"]:
            raise ValueError("its label belongs to another episode")
        label_of(message)
        keep = facts["keep_frames"]
        row = episode_index.episode_row(message, core.EpisodeQuality(**quality), keep, path, root)
        return CompleteFile(row | {"adopted": 1}, message)


def label_of(message: Mapping[str, Any]) -> Label:
    """Return the label of a label message; raises ``ValueError`` unless all values are integers."""
    values = [message.get(name) for name in ("x_um", "y_um", "theta_mdeg", "sigma_um")]
    if any(value is not None and type(value) is not int for value in values):
        raise ValueError("its label is not in whole µm and mdeg")
    return Label(*values)


def adopt_file(connection: sqlite3.Connection, parts: DatasetParts, complete: CompleteFile) -> None:
    """Insert the row of a complete file, and its first label if the log has none."""
    row, message = complete.row, complete.message
    if _has_label(connection, row["uuid"]):
        episode_index.insert_episode(connection, row)
        review.refresh_heads(connection, [row["uuid"]])
        return
    content = LabelContent(label_of(message), str(message["source"]), str(message["geometry"]))
    episode_index.enter_episode(connection, parts.site, row, content, "adopt")


def _has_label(connection: sqlite3.Connection, uuid: str) -> bool:
    sql = "SELECT 1 FROM label_rev WHERE episode = ? LIMIT 1"
    return connection.execute(sql, (uuid,)).fetchone() is not None


def _second_file(parts: DatasetParts, path: Path, row: EpisodeFileRow) -> ConsistencyProblem:
    """Handle two files with one uuid: the file with the hash of the row stays."""
    kept = parts.folder / row.path
    if file_sha256(path) != row.sha256 or (kept.exists() and file_sha256(kept) == row.sha256):
        message = f"{parts.name(path)} is a second file of episode {row.uuid}: moved to quarantine."
        return ConsistencyProblem(
            "double", row.uuid, message, lambda _: quarantine_file(parts, path)
        )

    def repair(connection: sqlite3.Connection) -> None:
        if kept.exists():
            quarantine_file(parts, kept)
        sql = "UPDATE episode SET path = ?, state = 'complete' WHERE uuid = ?"
        connection.execute(sql, (parts.name(path), row.uuid))

    message = f"The file of episode {row.uuid} was moved to {parts.name(path)}."
    return ConsistencyProblem("moved", row.uuid, message, repair)


def _torn_file(parts: DatasetParts, path: Path, row: EpisodeFileRow | None) -> ConsistencyProblem:
    def repair(connection: sqlite3.Connection) -> None:
        aside = quarantine_file(parts, path)
        episodes.salvage_file(aside, aside.with_name(f"{path.stem}.salvaged.mcap"))
        if row is not None:
            _mark(connection, [row.uuid], "quarantined")

    message = (
        f"{parts.name(path)} is torn: moved to quarantine, its complete chunks saved beside it."
    )
    target = parts.name(path) if row is None else row.uuid
    return ConsistencyProblem("torn", target, message, repair)


def _leftover(
    parts: DatasetParts, part: Path, by_path: dict[str, EpisodeFileRow]
) -> Iterator[ConsistencyProblem]:
    final = part.with_name(part.name.removeprefix(".").removesuffix(PART))
    row = by_path.get(parts.name(final))

    target, name = parts.quarantine / final.name, parts.name(part)
    if part.stat().st_size == 0:
        yield leftover(parts, part, "was empty")
    elif final.exists():
        if row is not None and file_sha256(final) == row.sha256:
            yield leftover(parts, part, "was left beside its finished file")
    elif not _is_reported(target, part):
        message = f"{name} was never finished: its complete chunks are in quarantine."
        yield ConsistencyProblem(
            "unfinished", name, message, lambda _: episodes.salvage_file(part, target)
        )


def _is_reported(target: Path, part: Path) -> bool:
    try:
        report = core.parse_json(target.with_name(f"{target.name}.json").read_text("utf-8"))
        return bool(report["bytes"] == part.stat().st_size)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def quarantine_file(parts: DatasetParts, path: Path) -> Path:
    """Move a file to the quarantine under a free name; return its new path."""
    core.make_folder(parts.quarantine)
    target, number = parts.quarantine / path.name, 1
    while target.exists():
        number += 1
        target = parts.quarantine / f"{path.stem}-{number}{path.suffix}"
    path.replace(target)
    core.sync_folder(parts.quarantine)
    core.sync_folder(path.parent)
    return target


def _state(row: EpisodeFileRow, state: str, message: str) -> ConsistencyProblem:
    kind = "back" if state == "complete" else state
    return ConsistencyProblem(kind, row.uuid, message, lambda c: _mark(c, [row.uuid], state))


def is_readable(path: Path) -> bool:
    """Return True if all checksums of an MCAP file are right."""
    try:
        episodes.read_whole(path)
    except core.InputError:
        return False
    return True


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        return file_digest(file, "sha256").hexdigest()


# What became of a recording, by the state of its row.
LOSSES = {
    "missing": "is missing",
    "damaged": "was changed or is damaged",
    "quarantined": "was torn and is in quarantine",
}


def check_losses(parts: DatasetParts, *, whole: bool) -> Iterator[ConsistencyProblem]:
    """Yield the recordings that are known to be lost, until their file is back or they are deleted.

    ``whole`` also finds labels whose episode has neither row nor file, as after a rebuild.
    """
    rows = parts.database.rows(
        "SELECT e.state, e.path, e.kind, min(e.uuid), count(*) FROM episode e"
        " JOIN label_head h ON h.episode = e.uuid WHERE e.state != 'complete' AND NOT h.deleted"
        " GROUP BY e.state, e.path ORDER BY min(e.uuid)"
    )
    for state, path, kind, uuid, count in rows:
        who = f"episode {uuid}" if kind == "file" else f"{count} episodes of a pack"
        message = f"The file {path} of {who} {LOSSES[state]}: {_PUT_BACK}"
        target = uuid if kind == "file" else path
        yield ConsistencyProblem(state, target, message, lasting=True)
    sql = (
        "SELECT h.episode FROM label_head h LEFT JOIN episode e ON e.uuid = h.episode"
        " WHERE e.uuid IS NULL AND NOT h.deleted ORDER BY h.episode"
    )
    for (uuid,) in parts.database.rows(sql) if whole else ():
        message = f"Episode {uuid} has a label but no file: {_PUT_BACK}"
        yield ConsistencyProblem("missing", uuid, message, lasting=True)


_PUT_BACK = "put a good copy there, or delete the episode on the Label page."

PACKS = "packs"
MODE = "mass"
# Simulated episodes that fail a check are redrawn before they are packed.
GOOD = core.EpisodeQuality(True, (), 0, 0.0, 0, 0.0, 0.0)
GOOD_TEXT = json.dumps(asdict(GOOD))
RANDOM_BITS = 74


@dataclass(frozen=True, slots=True)
class PackEntry:
    """One episode of a pack: id, position, hash and label message."""

    uuid: str
    offset: int
    length: int
    sha256: str
    label: Mapping[str, Any]


def check_packs(parts: DatasetParts, *, whole: bool) -> Iterator[ConsistencyProblem]:
    """Yield the problems of the folder ``packs``; ``whole`` reads every chunk again."""
    folder = parts.folder / PACKS
    rows = parts.database.rows("SELECT bench FROM series WHERE mode = ?", (MODE,))
    facts = [core.parse_json(bench) for (bench,) in rows]
    known = {fact["pack"]: fact["bytes"] for fact in facts if "pack" in fact}
    found: set[str] = set()
    for path in sorted(folder.glob("*.mcap")) if folder.is_dir() else ():
        if path.name.startswith("."):
            continue
        name = parts.name(path)
        found.add(name)
        if known.get(name) == path.stat().st_size and not whole:
            continue
        try:
            listed = list(read_pack_chunks(path))
        except core.InputError as error:
            if is_readable(path):
                yield ConsistencyProblem("not-adopted", name, f"{name} is no pack: {error.what}")
            else:
                yield _torn_pack(parts, path, error)
            continue
        yield from _compare_pack(parts, path, listed, found)
    for name in sorted(set(known) - found):
        yield from _missing_pack(parts, name)


def read_pack_chunks(path: Path) -> Iterator[PackEntry]:
    """Yield the episodes of a complete pack; raises ``InputError`` if it is damaged or foreign."""
    for chunk in episodes.read_chunks(path):
        messages = chunk.contents.messages.get(episodes.LABEL_TOPIC.name)
        if not messages or "episode" in chunk.contents.metadata:
            fix = episodes.DAMAGED_FILE_FIX
            raise core.InputError("The file is not a pack of episodes.", str(path), fix)
        with episodes.input_errors(path):
            label = episodes.unpack_json(messages[0])
            label_of(label)
            yield PackEntry(_packed_uuid(chunk), chunk.offset, chunk.length, chunk.sha256, label)


def read_packed(path: Path, chunk: tuple[int, int]) -> core.Episode:
    """Read one episode of a pack: observation and commanded offset, without recording."""
    group = episodes.read_chunk(path, *chunk)
    with episodes.input_errors(path):
        label = episodes.unpack_json(group.messages[episodes.LABEL_TOPIC.name][0])
        observation = episodes.unpack_observation(group.messages[episodes.OBSERVATION_TOPIC.name])
        name, piece = str(label["episode"]), str(label["piece"])
        return core.Episode(name, piece, observation, label_of(label).offset_mm, 0.0, GOOD)


def _packed_uuid(chunk: episodes.StoredChunk) -> str:
    """Return the id of a packed episode, derived from its content without its log times."""
    digest = chunk.sha256
    if episodes.START_KEY in chunk.contents.metadata.get("pack", {}):
        topics = sorted(chunk.contents.messages.items())
        digest = sha256(b"".join(row for _, rows in topics for row in rows)).hexdigest()
    return uuid7_from_parts(0, int(digest, 16) >> (256 - RANDOM_BITS))


def _compare_pack(
    parts: DatasetParts, path: Path, listed: list[PackEntry], found: set[str]
) -> Iterator[ConsistencyProblem]:
    """Yield the repair of a complete pack that is new or was changed.

    The former name of a renamed pack is added to ``found``.
    """
    name = parts.name(path)
    marks = ", ".join("?" * len(listed))
    rows = parts.database.rows(
        f"SELECT uuid, path, chunk_off, state FROM episode WHERE path = ? OR uuid IN ({marks})",  # noqa: S608
        [name, *(packed.uuid for packed in listed)],
    )
    there = {uuid: (at, offset, state) for uuid, at, offset, state in rows}
    elsewhere = {there[p.uuid][0] for p in listed if p.uuid in there} - {name}
    if any((parts.folder / other).exists() for other in elsewhere):
        message = f"{name} holds episodes of {min(elsewhere)} again: moved to quarantine."
        yield ConsistencyProblem("double", name, message, lambda _: quarantine_file(parts, path))
        return
    found |= elsewhere
    changed = [p for p in listed if there.get(p.uuid) != (name, p.offset, "complete")]
    lost = [u for u, row in there.items() if row[0] == name and row[2] == "complete"]
    lost = sorted(set(lost) - {p.uuid for p in listed})
    if lost:
        message = f"{len(lost)} episodes of {name} are gone or changed: marked as damaged."
        yield ConsistencyProblem("damaged", name, message, lambda c: _mark(c, lost, "damaged"))
    if changed:
        new = sum(p.uuid not in there for p in changed)
        message = f"{len(changed)} episodes of {name} entered ({new} of them new)."
        yield ConsistencyProblem(
            "adopt", name, message, lambda c: enter_pack(c, parts, path, changed)
        )


def enter_pack(
    connection: sqlite3.Connection, parts: DatasetParts, path: Path, listed: list[PackEntry]
) -> None:
    """Insert rows and first labels of packed episodes as one operation; known ones are moved."""
    catalogue = load_pieces()
    name, size = parts.name(path), path.stat()
    series = uuid7_from_parts(0, int(listed[0].sha256[:16], 16))
    bench = json.dumps({"pack": name, "bytes": size.st_size})
    connection.execute("DELETE FROM series WHERE uuid = ?", (series,))
    values = (series, size.st_mtime_ns, "", "", MODE, bench)
    connection.execute("INSERT INTO series VALUES (?, ?, ?, ?, ?, ?)", values)
    pairs, revisions = dict[tuple[str, ...], str](), []
    for packed in listed:
        moved = connection.execute(
            "UPDATE episode SET path = ?, chunk_off = ?, chunk_len = ?, bytes = ?,"
            " state = 'complete' WHERE uuid = ?",
            (name, packed.offset, packed.length, packed.length, packed.uuid),
        )
        if moved.rowcount:
            continue
        names = tuple(str(packed.label[word]) for word in ("piece", "bottom", "geometry"))
        if names not in pairs:
            pairs[names] = _pair(parts, catalogue, packed.label, path)
        geometry = pairs[names]
        row = _packed_row(packed, series, name, size.st_mtime_ns, geometry)
        episode_index.insert_episode(connection, row)
        if not _has_label(connection, packed.uuid):
            label, source = label_of(packed.label), str(packed.label.get("source", "commanded"))
            content = LabelContent(label, source, geometry)
            revisions.append(operation_log.new_revision(packed.uuid, None, content, "draft"))
    touched = {packed.uuid for packed in listed}
    if revisions:
        draft = operation_log.OperationDraft(revs=revisions)
        operation_log.append_operation(connection, parts.site, PROGRAM_ACTOR, "adopt", draft)
    review.refresh_heads(connection, touched)


def _packed_row(
    packed: PackEntry, series: str, name: str, recorded_ns: int, geometry: str
) -> dict[str, Any]:
    label = packed.label
    words = ("piece", "bottom", "grip_id", "mounting_id", "person")
    return {
        **{word: str(label[word]) for word in words},
        "uuid": packed.uuid,
        "series": series,
        "campaign": "",
        "kind": "pack",
        "path": name,
        "chunk_off": packed.offset,
        "chunk_len": packed.length,
        "sha256": packed.sha256,
        "bytes": packed.length,
        "recorded_ns": recorded_ns,
        "geometry": geometry,
        "mode": MODE,
        "quality": GOOD_TEXT,
        "accepted": 1,
        "keep_frames": "none",
        "state": "complete",
        "adopted": 1,
    }


def _pair(
    parts: DatasetParts, catalogue: PieceLibrary, label: Mapping[str, Any], path: Path
) -> str:
    """Store the geometry of a packed label; return the hash of the pair."""
    piece, bottom = catalogue.piece(label["piece"]), catalogue.piece(label["bottom"])
    if piece.sha256 != label["geometry"]:
        what = f"The piece '{piece.name}' was changed since this pack was simulated."
        fix = "Simulate it again, or bring the former piece file back."
        raise core.InputError(what, str(path), fix)
    return parts.geometry.store_pair(piece, bottom)


def _mark(connection: sqlite3.Connection, uuids: list[str], state: str) -> None:
    rows = [(state, uuid) for uuid in uuids]
    connection.executemany("UPDATE episode SET state = ? WHERE uuid = ?", rows)


def _missing_pack(parts: DatasetParts, name: str) -> Iterator[ConsistencyProblem]:
    sql = "SELECT uuid FROM episode WHERE path = ? AND state = 'complete'"
    uuids = [uuid for (uuid,) in parts.database.rows(sql, (name,))]
    if uuids:

        def repair(connection: sqlite3.Connection) -> None:
            _mark(connection, uuids, "missing")
            # size 0, so that the pack is read again when it comes back
            values = (json.dumps({"pack": name, "bytes": 0}), uuids[0])
            sql = "UPDATE series SET bench = ? WHERE uuid = (SELECT series FROM episode"
            connection.execute(f"{sql} WHERE uuid = ?)", values)

        message = f"The pack {name} with {len(uuids)} episodes is missing; their labels are kept."
        yield ConsistencyProblem("missing", name, message, repair)


def _torn_pack(parts: DatasetParts, path: Path, error: core.InputError) -> ConsistencyProblem:
    name = parts.name(path)

    def repair(connection: sqlite3.Connection) -> None:
        repaired, listed = parts.quarantine / f"{path.stem}.repaired.mcap", list[PackEntry]()
        parts.quarantine.mkdir(exist_ok=True)
        saved = episodes.salvage_file(path, repaired)
        quarantine_file(parts, path)
        if saved.path is not None:
            repaired.replace(path)
            listed += read_pack_chunks(path)
            enter_pack(connection, parts, path, listed)
        kept = {packed.uuid for packed in listed}
        rows = connection.execute("SELECT uuid FROM episode WHERE path = ?", (name,)).fetchall()
        _mark(connection, [uuid for (uuid,) in rows if uuid not in kept], "damaged")

    message = f"The pack {name} is damaged: {error.what} Its whole episodes were saved."
    return ConsistencyProblem("torn", name, message, repair)

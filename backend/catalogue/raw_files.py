"""Episode files against their rows: adopt, mark, move aside. No file is deleted that holds data."""

from __future__ import annotations

import json
import os
import sqlite3
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from backend.catalogue import episodes, heads, recording
from backend.catalogue.checked_folders import stamp_of
from backend.catalogue.findings import Finding, Store
from backend.catalogue.salvage import salvage
from backend.catalogue.values import Content, Label
from backend.core.faults import InputError
from backend.core.files import make_folder, sync_folder
from backend.core.flow import EpisodeQuality
from backend.dataset.channels import LABEL, unpack_json
from backend.dataset.contents import FIX, explained, read_whole

PART = ".part"


class Row(NamedTuple):
    """What the catalogue says of one file (a named tuple: a hundred thousand are made at once)."""

    uuid: str
    path: str
    bytes: int
    sha256: str
    state: str


@dataclass(frozen=True, slots=True)
class Complete:
    """A file that was read whole: everything its row needs."""

    path: Path
    uuid: str
    message: dict[str, Any]
    quality: EpisodeQuality
    keep_frames: str


def check_files(where: Store, *, whole: bool) -> Iterator[Finding]:
    """Yield what is out of order below ``raw``; ``whole`` compares every hash, too.

    Folders that are known to be in order, and look as they did, are passed over unless ``whole``.
    """
    now_ns = time.time_ns()
    known = {} if whole else where.checked.unchanged(where.folder)
    names = list(_folders(where, recording.RAW, known))
    rows = _rows(where, known, {*names, *where.checked.looks} - set(known))
    if rows is None:
        known, names = {}, list(_folders(where, recording.RAW, {}))
        rows = _rows(where, known, set()) or []
    folders = [name for name in names if name not in known]
    stamps = {name: stamp_of(where.folder / name) for name in folders}
    where.checked.forget(set(where.checked.looks) - set(known))
    disorder: set[str] = set()
    for finding, folder in _compare(where, folders, rows, whole=whole):
        disorder.add(folder)
        yield finding
    counts = Counter(row.path.rpartition("/")[0] for row in rows)
    # One that has folders in it is always looked into.
    outer = {name.rpartition("/")[0] for name in names}
    for name in set(folders) - disorder - outer:
        where.checked.remember(name, stamps[name], counts[name], now_ns)


def _rows(where: Store, known: Mapping[str, int], folders: set[str]) -> list[Row] | None:
    """Return the rows of ``folders``, or of all where nothing is ``known``.

    None if they and those of the known folders are not all there are: none must be passed over.
    """
    sql = "SELECT uuid, path, bytes, sha256, state FROM episode WHERE kind = 'file'"
    if not known:
        return [Row._make(row) for row in where.database.rows(sql)]
    # '0' follows '/'. Of a folder's own files alone: those further below have one of their own.
    # Asked of the index by path first, and of the rows then: most folders have none to read.
    sql += (
        " AND uuid IN (SELECT uuid FROM episode WHERE path >= ? || '/' AND path < ? || '0'"
        " AND NOT instr(substr(path, ?), '/'))"
    )
    rows = [
        Row._make(row)
        for name in sorted(folders)
        for row in where.database.rows(sql, (name, name, len(name) + 2))
    ]
    # Not by kind, which is in no index: what is not in a pack is a file.
    count_sql = "SELECT count(*) FROM episode WHERE NOT (path >= 'packs/' AND path < 'packs0')"
    (count,) = where.database.one(count_sql)
    return rows if count == len(rows) + sum(known.values()) else None


def _compare(
    where: Store, folders: Sequence[str], rows: Sequence[Row], *, whole: bool
) -> Iterator[tuple[Finding, str]]:
    """Yield findings, each with the folder that it is about."""
    by_path = {row.path: row for row in rows}
    index = _Index(where, {row.uuid: row for row in rows})
    found: set[str] = set()
    for folder in folders:
        for name, size in _files(where.folder / folder, folder):
            row = by_path.get(name)
            if row is not None:
                found.add(name)
                if not whole and size == row.bytes and row.state == "complete":
                    continue
                findings = _known(where, where.folder / name, size, row, whole=whole)
            elif name.endswith(PART):
                findings = _left_over(where, where.folder / name, by_path)
            else:
                findings = _unknown(where, where.folder / name, index)
            for finding in findings:
                if finding.kind == "moved":
                    found.add(index[finding.target].path)
                yield finding, folder
    for row in rows:
        if row.path not in found and row.state == "complete":
            said = f"The file of episode {row.uuid} is missing; its label is kept."
            yield _state(row, "missing", said), row.path.rpartition("/")[0]


class _Index(dict[str, Row]):
    """Rows by uuid; those that were not read before are looked up."""

    def __init__(self, where: Store, rows: Mapping[str, Row]) -> None:
        super().__init__(rows)
        self._database = where.database

    def find(self, uuid: str) -> Row | None:
        """Return the row of an episode file, or None."""
        if uuid not in self:
            sql = "SELECT uuid, path, bytes, sha256, state FROM episode WHERE uuid = ?"
            row = self._database.first(f"{sql} AND kind = 'file'", (uuid,))
            if row is None:
                return None
            self[uuid] = Row._make(row)
        return self[uuid]


def _folders(where: Store, name: str, known: Mapping[str, int]) -> Iterator[str]:
    """Yield ``name`` and all folders below, in order; none is looked for below a known one."""
    if not (where.folder / name).is_dir():
        return
    yield name
    if name in known:
        return
    with os.scandir(where.folder / name) as entries:
        below = sorted(e.name for e in entries if e.is_dir(follow_symlinks=False))
    for each in below:
        yield from _folders(where, f"{name}/{each}", known)


def _files(folder: Path, name: str) -> Iterator[tuple[str, int]]:
    """Yield episode files and leftovers in ``folder``, called ``name``, with their sizes.

    Texts, not paths: a hundred thousand paths take longer to make than to read from the disk.
    """
    with os.scandir(folder) as entries:
        listed = sorted(entries, key=lambda entry: entry.name)
    for entry in listed:
        if entry.name.endswith((".mcap", PART)) and entry.is_file(follow_symlinks=False):
            yield f"{name}/{entry.name}", entry.stat(follow_symlinks=False).st_size


def _known(where: Store, path: Path, size: int, row: Row, *, whole: bool) -> Iterator[Finding]:
    same = size == row.bytes
    if same and (whole or row.state != "complete"):
        same = digest(path) == row.sha256
    if same and row.state != "complete":
        yield _state(row, "complete", f"The file of episode {row.uuid} is back, unchanged.")
    elif not same and row.state == "complete":
        if size != row.bytes and not is_readable(path):
            yield _torn(where, path, row)
        else:
            said = f"The file of episode {row.uuid} was changed: marked as damaged, left in place."
            yield _state(row, "damaged", said)


def _unknown(where: Store, path: Path, by_uuid: _Index) -> Iterator[Finding]:
    try:
        complete = read_complete(path)
    except InputError as error:
        if is_readable(path):
            said = f"{where.name(path)} is no episode of a dataset: {error.what}"
            yield Finding("not-adopted", where.name(path), said)
        else:
            yield _torn(where, path, None)
        return
    row = by_uuid.find(complete.uuid)
    if row is None:
        size, name = path.stat().st_size, where.name(path)
        by_uuid[complete.uuid] = Row(complete.uuid, name, size, digest(path), "complete")
        said = f"Episode {complete.uuid} was on disk without a row: adopted."
        yield Finding("adopt", complete.uuid, said, lambda c: adopt(c, where, complete))
    else:
        yield _double(where, path, row)


def read_complete(path: Path) -> Complete:
    """Read an episode file whole, all checksums included; ``InputError`` if it is no such file."""
    contents = read_whole(path)
    messages = contents.messages.get(LABEL.name, [])
    if "episode" not in contents.metadata or not messages:
        raise InputError("The file has no label message to adopt it by.", str(path), FIX)
    with explained(path):
        facts, message = contents.metadata["episode"], unpack_json(messages[-1])
        quality = json.loads(facts["quality"])
        quality["reasons"] = tuple(quality["reasons"])
        if facts["uuid"] != message["episode"]:
            raise ValueError("its label belongs to another episode")
        episodes.row_of(message, EpisodeQuality(**quality), facts["keep_frames"], path, path.parent)
        label_of(message)
        return Complete(
            path, facts["uuid"], message, EpisodeQuality(**quality), facts["keep_frames"]
        )


def label_of(message: Mapping[str, Any]) -> Label:
    """Return the label of a label message; raises ``ValueError`` unless it is in whole numbers."""
    values = [message.get(name) for name in ("x_um", "y_um", "theta_mdeg", "sigma_um")]
    if any(value is not None and type(value) is not int for value in values):
        raise ValueError("its label is not in whole µm and mdeg")
    return Label(*values)


def adopt(connection: sqlite3.Connection, where: Store, complete: Complete) -> None:
    """Enter the row of a complete file, and its first label unless the log has one already."""
    args = (complete.message, complete.quality, complete.keep_frames, complete.path, where.folder)
    row = {**episodes.row_of(*args), "adopted": 1}
    has_label = "SELECT 1 FROM label_rev WHERE episode = ? LIMIT 1"
    if connection.execute(has_label, (complete.uuid,)).fetchone():
        episodes.insert(connection, row)
        heads.refresh(connection, [complete.uuid])
        return
    label, source = label_of(complete.message), str(complete.message["source"])
    content = Content(label, source, str(complete.message["geometry"]))
    recording.enter(connection, where.site, row, content, "adopt")


def _double(where: Store, path: Path, row: Row) -> Finding:
    """Two files have one uuid: the one that the row's hash names stays."""
    kept = where.folder / row.path
    if digest(path) != row.sha256 or (kept.exists() and digest(kept) == row.sha256):
        said = f"{where.name(path)} is a second file of episode {row.uuid}: moved to quarantine."
        return Finding("double", row.uuid, said, lambda _: _aside(where, path))

    def mend(connection: sqlite3.Connection) -> None:
        if kept.exists():
            set_aside(where, kept)
        sql = "UPDATE episode SET path = ?, state = 'complete' WHERE uuid = ?"
        connection.execute(sql, (where.name(path), row.uuid))

    said = f"The file of episode {row.uuid} was moved to {where.name(path)}."
    return Finding("moved", row.uuid, said, mend)


def _torn(where: Store, path: Path, row: Row | None) -> Finding:
    def mend(connection: sqlite3.Connection) -> None:
        aside = set_aside(where, path)
        salvage(aside, aside.with_name(f"{path.stem}.salvaged.mcap"))
        if row is not None:
            sql = "UPDATE episode SET state = 'quarantined' WHERE uuid = ?"
            connection.execute(sql, (row.uuid,))

    said = f"{where.name(path)} is torn: moved to quarantine, its whole chunks saved beside it."
    return Finding("torn", where.name(path), said, mend)


def _left_over(where: Store, part: Path, by_path: dict[str, Row]) -> Iterator[Finding]:
    """Yield what to do with ``.<episode>.mcap.part``."""
    final = part.with_name(part.name.removeprefix(".").removesuffix(PART))
    row = by_path.get(where.name(final))
    if part.stat().st_size == 0:
        said = f"{where.name(part)} was empty: deleted."
        yield Finding("left-over", where.name(part), said, lambda _: part.unlink(missing_ok=True))
        return
    if final.exists():
        if row is not None and digest(final) == row.sha256:
            said = f"{where.name(part)} was left beside its finished file: deleted."
            mend = lambda _: part.unlink(missing_ok=True)  # noqa: E731
            yield Finding("left-over", where.name(part), said, mend)
        return
    target = where.quarantine / final.name
    if not _is_reported(target, part):
        said = f"{where.name(part)} was never finished: its whole chunks are in quarantine."
        yield Finding("unfinished", where.name(part), said, lambda _: _save(part, target))


def _save(part: Path, target: Path) -> None:
    salvage(part, target)


def _is_reported(target: Path, part: Path) -> bool:
    try:
        report = json.loads(target.with_name(f"{target.name}.json").read_text("utf-8"))
        return bool(report["bytes"] == part.stat().st_size)
    except (OSError, ValueError, KeyError, TypeError):
        return False


def set_aside(where: Store, path: Path) -> Path:
    """Move a file to the quarantine under a free name; returns where it is."""
    make_folder(where.quarantine)
    target, number = where.quarantine / path.name, 1
    while target.exists():
        number += 1
        target = where.quarantine / f"{path.stem}-{number}{path.suffix}"
    path.replace(target)
    sync_folder(where.quarantine)
    sync_folder(path.parent)
    return target


def _aside(where: Store, path: Path) -> None:
    set_aside(where, path)


def _state(row: Row, state: str, said: str) -> Finding:
    def mend(connection: sqlite3.Connection) -> None:
        connection.execute("UPDATE episode SET state = ? WHERE uuid = ?", (state, row.uuid))

    return Finding("back" if state == "complete" else state, row.uuid, said, mend)


def is_readable(path: Path) -> bool:
    """Whether all checksums of an MCAP file are right."""
    try:
        read_whole(path)
    except InputError:
        return False
    return True


def digest(path: Path) -> str:
    """Return the SHA-256 of a file."""
    with path.open("rb") as file:
        found = sha256()
        while block := file.read(1 << 20):
            found.update(block)
    return found.hexdigest()

"""Rows of the index of episodes: written when one is recorded or adopted, listed by filters."""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from backend.catalogue.database import Database
from backend.catalogue.values import (
    FLAG,
    EpisodeContext,
    EpisodeEntry,
    EpisodeFilter,
    Label,
    Source,
)
from backend.core.flow import Episode, EpisodeQuality

COLUMNS = (
    "e.uuid, e.series, e.campaign, e.plan_item, e.path, e.recorded_ns, e.piece, e.bottom,"
    " e.geometry, e.grip_id, e.mounting_id, e.person, e.mode, e.quality, e.keep_frames, e.sha256,"
    " e.bytes, e.state, e.adopted, h.state, h.conflict, h.flagged, h.deleted"
)
TABLES = "episode e JOIN label_head h ON h.episode = e.uuid"


def label_message(
    episode: Episode, label: Label, source: Source, context: EpisodeContext, recorded_ns: int
) -> dict[str, object]:
    """Return the label message of an episode file: everything its row needs, for adoption."""
    return {
        "episode": episode.episode_id,
        "x_um": label.x_um,
        "y_um": label.y_um,
        "theta_mdeg": label.theta_mdeg,
        "sigma_um": label.sigma_um,
        "source": source,
        "geometry": context.geometry,
        "plan_item": context.plan_item,
        "piece": episode.piece,
        "bottom": context.bottom,
        "series": context.series,
        "campaign": context.campaign,
        "grip_id": context.grip_id,
        "mounting_id": context.mounting_id,
        "person": context.person,
        "mode": context.mode,
        "seed": context.seed,
        "recorded_ns": recorded_ns,
    }


def row_of(
    message: Mapping[str, Any], quality: EpisodeQuality, keep_frames: str, path: Path, root: Path
) -> dict[str, Any]:
    """Return the row of a complete episode file ``path`` below ``root`` from its label message."""
    content = path.read_bytes()
    names = ("series", "campaign", "plan_item", "piece", "bottom", "geometry", "grip_id")
    return {
        **{name: message[name] for name in (*names, "mounting_id", "person", "mode")},
        "uuid": message["episode"],
        "recorded_ns": message["recorded_ns"],
        "kind": "file",
        "path": path.relative_to(root).as_posix(),
        "chunk_off": None,
        "chunk_len": None,
        "crc": None,
        "sha256": sha256(content).hexdigest(),
        "bytes": len(content),
        "quality": json.dumps(dataclasses.asdict(quality)),
        "accepted": int(quality.accepted),
        "keep_frames": keep_frames,
        "state": "complete",
        "adopted": 0,
    }


def insert(connection: sqlite3.Connection, row: Mapping[str, Any]) -> None:
    """Insert one row; raises ``sqlite3.IntegrityError`` if the uuid is there already."""
    names = ", ".join(row)
    values = ", ".join(f":{name}" for name in row)
    connection.execute(f"INSERT INTO episode ({names}) VALUES ({values})", row)  # noqa: S608
    started = (row["series"], row["recorded_ns"], row["person"], row["campaign"], row["mode"])
    connection.execute("INSERT OR IGNORE INTO series VALUES (?, ?, ?, ?, ?, '{}')", started)


def find(database: Database, wanted: EpisodeFilter) -> list[EpisodeEntry]:
    """Return the entries that pass the filter, oldest first."""
    where, values = _conditions(wanted)
    sql = f"SELECT {COLUMNS} FROM {TABLES} WHERE {where} ORDER BY e.uuid"  # noqa: S608
    if wanted.limit is not None:
        sql += " LIMIT ?"
        values.append(wanted.limit)
    return [as_entry(row) for row in database.rows(sql, values)]


def entry(database: Database, uuid: str) -> EpisodeEntry | None:
    """Return one entry, or None."""
    sql = f"SELECT {COLUMNS} FROM {TABLES} WHERE e.uuid = ?"  # noqa: S608
    row = database.first(sql, (uuid,))
    return None if row is None else as_entry(row)


def as_entry(row: tuple[Any, ...]) -> EpisodeEntry:
    """Return the entry of a row of ``COLUMNS``."""
    (
        uuid, series, campaign, plan_item, path, recorded_ns, piece, bottom, geometry, grip_id,
        mounting_id, person, mode, quality, keep_frames, digest, size, file_state, adopted, state,
        conflict, flagged, deleted,
    ) = row  # fmt: skip
    found = json.loads(quality)
    found["reasons"] = tuple(found["reasons"])
    return EpisodeEntry(
        uuid, series, campaign, plan_item, path, recorded_ns, piece, bottom, geometry, grip_id,
        mounting_id, person, mode, EpisodeQuality(**found), keep_frames, digest, size, file_state,
        bool(adopted), state, bool(conflict), bool(flagged), bool(deleted),
    )  # fmt: skip


def _conditions(wanted: EpisodeFilter) -> tuple[str, list[Any]]:
    equal = {
        "e.piece": wanted.piece,
        "e.bottom": wanted.bottom,
        "e.series": wanted.series,
        "e.campaign": wanted.campaign,
        "e.person": wanted.person,
        "e.accepted": wanted.accepted,
        "h.conflict": wanted.conflict,
        "h.deleted": wanted.deleted,
    }
    terms = [f"{column} = ?" for column, value in equal.items() if value is not None]
    values: list[Any] = [value for value in equal.values() if value is not None]
    if wanted.states:
        terms.append(f"h.state IN ({', '.join('?' * len(wanted.states))})")
        values += wanted.states
    # Few episodes bear a mark: start from those, not from all.
    for name in filter(None, (FLAG if wanted.flagged else None, wanted.tag)):
        terms.append("e.uuid IN (SELECT episode FROM mark WHERE name = ? AND present)")
        values.append(name)
    if wanted.flagged is False:
        terms.append("NOT h.flagged")
    if wanted.after is not None:
        terms.append("e.uuid > ?")
        values.append(wanted.after)
    return " AND ".join(terms) or "1", values

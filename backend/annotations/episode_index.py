"""Index of episodes: durable recording, queries by filter, campaigns, split tags.

Recording writes the file first, the row second and the journal last, so the state after a crash can
always be recovered.
"""

from __future__ import annotations

import dataclasses
import json
import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from touchdown.backend.annotations import operation_log, review
from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.storage import DISK_FULL_ERRNOS
from touchdown.backend.annotations.values import (
    DELETED,
    FLAG,
    PROGRAM_ACTOR,
    EpisodeContext,
    EpisodeEntry,
    EpisodeFilter,
    Label,
    LabelContent,
    LabelState,
    Operation,
    Source,
    is_uuid7,
    uuid7,
)
from touchdown.backend.core import Episode, EpisodeQuality, Fault, FaultError
from touchdown.backend.episodes import KeepFrames, write_episode

COLUMNS = (
    "e.uuid, e.series, e.campaign, e.plan_item, e.path, e.recorded_ns, e.piece, e.bottom,"
    " e.geometry, e.grip_id, e.mounting_id, e.person, e.mode, e.quality, e.keep_frames, e.sha256,"
    " e.bytes, e.state, e.adopted, h.state, h.conflict, h.flagged, h.deleted"
)
TABLES = "episode e JOIN label_head h ON h.episode = e.uuid"
PAGE = 1000  # entries read at once


def label_message(
    episode: Episode, label: Label, source: Source, context: EpisodeContext, recorded_ns: int
) -> dict[str, object]:
    """Return the label message of an episode file, with everything its row needs."""
    circumstances = dataclasses.asdict(context)
    del circumstances["bench"]
    return {
        **dataclasses.asdict(label),
        **circumstances,
        "episode": episode.episode_id,
        "piece": episode.piece,
        "source": source,
        "recorded_ns": recorded_ns,
    }


def episode_row(
    message: Mapping[str, Any], quality: EpisodeQuality, keep_frames: str, path: Path, root: Path
) -> dict[str, Any]:
    """Return the row of the complete episode file ``path`` below ``root``."""
    content = path.read_bytes()
    names = ("series", "campaign", "plan_item", "piece", "bottom", "geometry", "grip_id")
    return {
        **{name: message[name] for name in (*names, "mounting_id", "person", "mode")},
        "uuid": message["episode"],
        "recorded_ns": message["recorded_ns"],
        "kind": "file",
        "path": path.relative_to(root).as_posix(),
        "sha256": sha256(content).hexdigest(),
        "bytes": len(content),
        "quality": json.dumps(dataclasses.asdict(quality)),
        "accepted": int(quality.accepted),
        "keep_frames": keep_frames,
        "state": "complete",
        "adopted": 0,
    }


def insert_episode(connection: sqlite3.Connection, row: Mapping[str, Any]) -> None:
    """Insert one row; raises ``sqlite3.IntegrityError`` if the uuid exists."""
    names = ", ".join(row)
    values = ", ".join(f":{name}" for name in row)
    connection.execute(f"INSERT INTO episode ({names}) VALUES ({values})", row)  # noqa: S608
    started = (row["series"], row["recorded_ns"], row["person"], row["campaign"], row["mode"])
    connection.execute("INSERT OR IGNORE INTO series VALUES (?, ?, ?, ?, ?, '{}')", started)


def find_episodes(database: Database, wanted: EpisodeFilter) -> list[EpisodeEntry]:
    """Return the entries that pass the filter, oldest first."""
    where, values = _conditions(wanted)
    sql = f"SELECT {COLUMNS} FROM {TABLES} WHERE {where} ORDER BY e.uuid"  # noqa: S608
    if wanted.limit is not None:
        sql += " LIMIT ?"
        values.append(wanted.limit)
    return [row_to_entry(row) for row in database.rows(sql, values)]


class PairCount(NamedTuple):
    """Number of episodes of a pair in one state; ``conflicts`` of them have two labels."""

    piece: str
    bottom: str
    state: str
    file_state: str
    episodes: int
    conflicts: int


def row_to_entry(row: tuple[Any, ...]) -> EpisodeEntry:
    """Return the entry of a row of ``COLUMNS``."""
    *facts, quality, keep_frames, digest, size, file_state, adopted, state = row[:-3]
    stored = (_quality(quality), keep_frames, digest, size, file_state, bool(adopted), state)
    values = (*facts, *stored, *map(bool, row[-3:]))
    return EpisodeEntry(*values)


@lru_cache(maxsize=10_000)
def _quality(text: str) -> EpisodeQuality:
    found = json.loads(text)
    return EpisodeQuality(**found | {"reasons": tuple(found["reasons"])})


def _conditions(wanted: EpisodeFilter) -> tuple[str, list[Any]]:
    equal = {
        "e.piece": wanted.piece,
        "e.bottom": wanted.bottom,
        "e.series": wanted.series,
        "e.campaign": wanted.campaign,
        "e.grip_id": wanted.grip_id,
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
    # Few episodes have a mark, so the query starts from the marks.
    for name in filter(None, (FLAG if wanted.flagged else None, wanted.tag)):
        terms.append("e.uuid IN (SELECT episode FROM mark WHERE name = ? AND present)")
        values.append(name)
    if wanted.flagged is False:
        terms.append("NOT h.flagged")
    if wanted.after is not None:
        terms.append("e.uuid > ?")
        values.append(wanted.after)
    return " AND ".join(terms) or "1", values


RAW = "raw"


def with_uuid(episode: Episode) -> Episode:
    """Return the episode with an id of the dataset; its former id moves to the metadata."""
    if is_uuid7(episode.episode_id):
        return episode
    pairs = (*episode.metadata, ("recorded_as", episode.episode_id))
    return replace(episode, episode_id=uuid7(), metadata=pairs)


def write_episode_file(
    root: Path,
    episode: Episode,
    message: Mapping[str, object],
    context: EpisodeContext,
    keep_frames: KeepFrames,
) -> dict[str, Any]:
    """Write the episode file, verify it and give it its final name; return its row.

    After a write error the file is written once more under a new name, unless the disk is full. The
    same file is never synced twice, since the system may have dropped its pages. Raises
    ``FaultError``.
    """
    path = root / RAW / context.series / f"{episode.episode_id}.mcap"
    bench = {"mode": context.mode, "seed": "" if context.seed is None else str(context.seed)}
    for attempt in (1, 2):
        try:
            write_episode(path, episode, message, {**bench, **context.bench}, keep_frames)
            return episode_row(message, episode.quality, keep_frames, path, root)
        except OSError as error:
            if error.errno in DISK_FULL_ERRNOS or attempt == 2:
                raise FaultError(_not_recorded(error)) from error
    raise AssertionError("unreachable")


def enter_episode(
    connection: sqlite3.Connection,
    site: str,
    row: Mapping[str, Any],
    content: LabelContent,
    verb: str,
) -> Operation:
    """Insert row, operation, first revision and head within the caller's transaction.

    ``verb``: ``record``, or ``adopt`` for a file found on disk.
    """
    insert_episode(connection, row)
    state: LabelState = "draft" if content.label.is_set else "unlabelled"
    revision = operation_log.new_revision(row["uuid"], None, content, state)
    draft, actor = operation_log.OperationDraft(revs=[revision]), row["person"] or PROGRAM_ACTOR
    operation, touched = operation_log.append_operation(connection, site, actor, verb, draft)
    review.refresh_heads(connection, touched)
    return operation


def _not_recorded(error: OSError) -> Fault:
    full = error.errno in DISK_FULL_ERRNOS
    return Fault(
        code="DISK-FULL" if full else "EPISODE-WRITE",
        what="The disk is full." if full else f"An episode could not be written: {error}.",
        consequence="This episode is not recorded; everything recorded before is safe.",
        next_step="Make room, then record it again."
        if full
        else "Check the disk, then record it again.",
    )


@dataclass(frozen=True, slots=True)
class CampaignEntry:
    """One campaign: completed items (accepted, not deleted) and all episodes."""

    uuid: str
    piece: str
    bottom: str
    episodes: int
    done: int


def items_deleted(database: Database, campaign: str, reason: str) -> set[int]:
    """Return the items of a campaign with an episode deleted for exactly this reason."""
    sql = (
        "SELECT e.plan_item FROM episode e JOIN mark m ON m.episode = e.uuid"
        " WHERE e.campaign = ? AND e.plan_item IS NOT NULL AND m.name = ? AND m.present"
        " AND m.note = ?"
    )
    return {item for (item,) in database.rows(sql, (campaign, DELETED, reason))}


def list_campaigns(database: Database) -> list[CampaignEntry]:
    """Return the campaigns that have episodes, newest last."""
    sql = (
        "SELECT e.campaign, min(e.piece), min(e.bottom), count(*),"  # noqa: S608
        " count(DISTINCT CASE WHEN e.accepted AND NOT h.deleted THEN e.plan_item END)"
        f" FROM {TABLES} WHERE e.campaign != '' AND e.plan_item IS NOT NULL"
        " GROUP BY e.campaign ORDER BY min(e.recorded_ns)"
    )
    return [CampaignEntry(*row) for row in database.rows(sql)]


SPLIT_TAG = "split:"


def tagged_sides(database: Database) -> dict[str, str]:
    """Return the side of every tagged episode."""
    rows = database.rows(
        "SELECT episode, name FROM mark WHERE present AND name LIKE ?", (f"{SPLIT_TAG}%",)
    )
    return {episode: name.removeprefix(SPLIT_TAG) for episode, name in rows}

"""Make one episode durable: file first, row second, journal last (in this order for every crash).

A file without its row is adopted at the next start; a row without its file cannot arise.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from backend.catalogue import episodes, heads, operations
from backend.catalogue.diskspace import NO_ROOM
from backend.catalogue.uuid7 import is_uuid7, uuid7
from backend.catalogue.values import PROGRAM, Content, EpisodeContext, LabelState, Operation
from backend.core.faults import Fault, FaultError
from backend.core.flow import Episode
from backend.dataset.episode_file import write_episode
from backend.dataset.pictures import KeepFrames

RAW = "raw"


@dataclass(frozen=True, slots=True)
class Written:
    """An episode file that is complete and durable, and the row that describes it."""

    path: Path
    row: Mapping[str, Any]


def with_uuid(episode: Episode) -> Episode:
    """Return the episode under an id of the dataset; its former id goes to its metadata."""
    if is_uuid7(episode.episode_id):
        return episode
    pairs = (*episode.metadata, ("recorded_as", episode.episode_id))
    return replace(episode, episode_id=uuid7(), metadata=pairs)


def write_file(
    root: Path,
    episode: Episode,
    message: Mapping[str, object],
    context: EpisodeContext,
    keep_frames: KeepFrames,
) -> Written:
    """Write the episode file, read it back and give it its name; raises ``FaultError``.

    A disk that refuses is tried once more with a new file (never a second sync of the same one:
    the system may have dropped its pages already); a full disk is not.
    """
    path = root / RAW / context.series / f"{episode.episode_id}.mcap"
    bench = {"mode": context.mode, "seed": "" if context.seed is None else str(context.seed)}
    for attempt in (1, 2):
        try:
            write_episode(path, episode, message, {**bench, **context.bench}, keep_frames)
            row = episodes.row_of(message, episode.quality, keep_frames, path, root)
        except OSError as error:
            if error.errno in NO_ROOM or attempt == 2:
                raise FaultError(_not_recorded(error)) from error
        else:
            return Written(path, row)
    raise AssertionError("unreachable")


def enter(
    connection: sqlite3.Connection,
    site: str,
    row: Mapping[str, Any],
    content: Content,
    verb: str,
) -> Operation:
    """Enter row, operation, first revision and head, within the caller's transaction.

    ``verb``: ``record``, or ``adopt`` for a file found on disk.
    """
    episodes.insert(connection, row)
    state: LabelState = "draft" if content.label.is_set else "unlabelled"
    revision = operations.new_revision(row["uuid"], None, content, state)
    draft, actor = operations.Draft(revs=[revision]), row["person"] or PROGRAM
    operation, touched = operations.append(connection, site, actor, verb, draft)
    heads.refresh(connection, touched)
    return operation


def _not_recorded(error: OSError) -> Fault:
    full = error.errno in NO_ROOM
    return Fault(
        code="DISK-FULL" if full else "EPISODE-WRITE",
        what="The disk is full." if full else f"An episode could not be written: {error}.",
        consequence="This episode is not recorded; everything recorded before is safe.",
        next_step="Make room, then record it again."
        if full
        else "Check the disk, then record it again.",
    )

"""Fill a catalogue with many rows and no files, as fast as SQLite goes, for queues and figures."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np

from touchdown.backend.annotations import episode_index, operation_log, review
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import OperationDraft, new_revision
from touchdown.backend.annotations.values import Label, LabelContent, uuid7
from touchdown.backend.core.values import EpisodeQuality

QUALITY = json.dumps(asdict(EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.0)))
BOTTOMS = ("circle15", "circle25", "square15")


def fill(dataset: Dataset, count: int, approved: int = 0, batch: int = 1000) -> list[str]:
    """Enter ``count`` episodes in batches of one operation; ann and bob approve the first ones."""
    rng = np.random.default_rng(1)
    made: list[str] = []
    with dataset.database.transaction() as connection:
        for start in range(0, count, batch):
            rows = [_row(k) for k in range(start, min(start + batch, count))]
            offsets = rng.integers(-12000, 12000, (len(rows), 2)).tolist()
            revs = []
            for row, (x, y) in zip(rows, offsets, strict=True):
                episode_index.insert_episode(connection, row)
                content = LabelContent(Label(x, y, 0, 150), "commanded", "g")
                revs.append(new_revision(str(row["uuid"]), None, content, "draft"))
            site = dataset.description.site
            _, touched = operation_log.append_operation(
                connection, site, "cleo", "record", OperationDraft(revs=revs)
            )
            review.refresh_heads(connection, touched)
            made += [str(row["uuid"]) for row in rows]
    for actor, verb, state in (("ann", "bulk", "submitted"), ("bob", "bulk", "approved")):
        for start in range(0, approved, batch):
            _pass_on(dataset, made[start : min(start + batch, approved)], actor, verb, state)
    return made


def _pass_on(dataset: Dataset, uuids: list[str], actor: str, verb: str, state: str) -> None:
    with dataset.database.transaction() as connection:
        revs = []
        for uuid in uuids:
            row = connection.execute("SELECT rev_uuid FROM label_head WHERE episode = ?", (uuid,))
            head = operation_log.read_revision(connection, row.fetchone()[0])
            content = LabelContent.of(head)
            revs.append(new_revision(uuid, head.rev_uuid, content, state))
        site = dataset.description.site
        _, touched = operation_log.append_operation(
            connection, site, actor, verb, OperationDraft(revs=revs)
        )
        review.refresh_heads(connection, touched)


def _row(number: int) -> dict[str, object]:
    uuid = uuid7()
    return {
        "uuid": uuid, "series": f"series-{number // 500}", "campaign": "c", "plan_item": number,
        "piece": ("pot", "barrel")[number % 2], "bottom": BOTTOMS[number % 3], "geometry": "g",
        "grip_id": f"grip-{number // 50}", "mounting_id": "m", "person": "cleo", "mode": "stepped",
        "recorded_ns": 1_700_000_000_000_000_000 + number, "kind": "file",
        "path": f"raw/series-{number // 500}/{uuid}.mcap", "chunk_off": None, "chunk_len": None,
        "crc": None, "sha256": f"{number:064x}", "bytes": 1000, "quality": QUALITY, "accepted": 1,
        "keep_frames": "none", "state": "complete", "adopted": 0,
    }  # fmt: skip


def make_files(dataset: Dataset) -> None:
    """Make a file of the right size (a hole) for every episode of ``fill``."""
    for path, size in dataset.database.rows("SELECT path, bytes FROM episode"):
        file = dataset.folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb") as handle:
            handle.truncate(size)

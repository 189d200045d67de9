"""What people did to gold, as the log keeps it: step for step and apart from the labels."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from dataclasses import asdict, replace

from backend.catalogue.operations import REVISION, Draft, as_revision
from backend.catalogue.uuid7 import uuid7
from backend.catalogue.values import NO_LABEL, Operation, Revision, Step

_STEPS = (
    f"SELECT {REVISION}, r.copy_of, r.deleted, r.skipped, r.beside"  # noqa: S608
    " FROM apart r JOIN op o USING (op_uuid) WHERE o.actor = ?"
)
_IN_ORDER = " ORDER BY o.lamport, o.site, o.seq"


def steps_of(connection: sqlite3.Connection, person: str, uuid: str) -> list[Step]:
    """Return the steps of ``person`` on one episode, oldest first."""
    rows = connection.execute(f"{_STEPS} AND r.episode = ?{_IN_ORDER}", (person, uuid))
    return list(_steps(rows))


def last_steps(connection: sqlite3.Connection, person: str) -> dict[str, Step]:
    """Return what ``person`` sees of each gold episode that they did anything to."""
    rows = connection.execute(_STEPS + _IN_ORDER, (person,))
    return {step.version.episode: step for step in _steps(rows)}


def _steps(rows: sqlite3.Cursor) -> Iterator[Step]:
    for row in rows:
        copy_of, deleted, skipped, beside = row[16:]
        yield Step(as_revision(row[:16]), copy_of, deleted, bool(skipped), beside)


def recorded(connection: sqlite3.Connection, uuid: str) -> Revision:
    """Return the label that an episode was recorded with."""
    row = connection.execute(
        f"SELECT {REVISION} FROM label_rev r JOIN op o USING (op_uuid)"  # noqa: S608
        " WHERE r.episode = ? ORDER BY o.lamport, o.site, r.rev_uuid LIMIT 1",
        (uuid,),
    ).fetchone()
    return as_revision(row)


def add(draft: Draft, step: Step) -> None:
    """Write a step; what is decided by it is an opinion as well."""
    r = step.version
    draft.apart.append({
        "episode": r.episode, "rev_uuid": r.rev_uuid, "parent": r.parent, **asdict(r.label),
        "source": r.source, "state": r.state, "reason": r.reason, "verdict": r.verdict,
        "geometry": r.geometry, "note": r.note, "copy_of": step.copy_of, "deleted": step.deleted,
        "skipped": step.skipped, "shown_ns": 0, "beside": step.beside,
    })  # fmt: skip
    if step.answer is not None:
        draft.opinions.append({"episode": r.episode, "verdict": r.verdict} | asdict(step.answer))


def take_back(
    connection: sqlite3.Connection, draft: Draft, operation: Operation, uuid: str
) -> None:
    """Write the step that takes one of ``operation`` back; an opinion goes or comes with it."""
    steps = steps_of(connection, operation.actor, uuid)
    at = [step.version.op_uuid for step in steps].index(operation.op_uuid)
    done, now = steps[at], steps[-1]
    before = steps[at - 1] if at else replace(
        done, version=recorded(connection, uuid), copy_of=None, deleted="", skipped=False
    )  # fmt: skip
    if done.version.rev_uuid == before.version.rev_uuid:
        step = replace(now, deleted=before.deleted, skipped=before.skipped)
    else:
        old = before.version
        version = replace(old, rev_uuid=uuid7(), parent=now.version.rev_uuid)
        step = replace(now, version=version, copy_of=old.rev_uuid)
    add(draft, step)
    if step.answer is not None:
        draft.extra |= _looked(connection, before)
    elif now.answer is not None:
        draft.opinions.append({"episode": uuid, "verdict": None} | asdict(NO_LABEL))


def _looked(connection: sqlite3.Connection, step: Step) -> dict[str, object]:
    """Return how the person had come to the answer of a step."""
    seen_ms, blind = connection.execute(
        "SELECT json_extract(body, '$.seen_ms'), json_extract(body, '$.blind') FROM op"
        " WHERE op_uuid = ?",
        (step.version.op_uuid,),
    ).fetchone()
    return {} if seen_ms is None else {"seen_ms": seen_ms, "blind": bool(blind)}

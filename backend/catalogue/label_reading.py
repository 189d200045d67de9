"""Labels as they stand: heads, histories, marks, and the log of who did what."""

from __future__ import annotations

import math
import sqlite3
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from backend.catalogue import apart, heads
from backend.catalogue.database import Database
from backend.catalogue.operations import (
    COLUMNS,
    REVISION,
    as_operation,
    as_revision,
    newest_of,
    read_revision,
)
from backend.catalogue.review import Standing
from backend.catalogue.values import Operation, Revision, Step
from backend.core.faults import InputError
from backend.core.flow import FloatArray

TOGETHER = 500
"""So many episodes are asked for in one query."""


class LabelReader:
    """Reads the labels of one dataset."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def head(self, uuid: str) -> Revision:
        """Return the revision that holds; raises ``InputError`` if there is no such episode."""
        row = self._database.first(
            f"SELECT {REVISION} FROM label_head h JOIN label_rev r USING (rev_uuid)"  # noqa: S608
            " JOIN op o USING (op_uuid) WHERE h.episode = ?",
            (uuid,),
        )
        if row is None:
            raise _unknown(uuid)
        return as_revision(row)

    def offsets_mm(self, uuids: Sequence[str]) -> FloatArray:
        """Return (n, 2) displacements of the heads of known episodes, NaN where there is none."""
        found: dict[str, tuple[float, float]] = {}
        for start in range(0, len(uuids), TOGETHER):
            some = uuids[start : start + TOGETHER]
            marks = ", ".join("?" * len(some))
            sql = (
                "SELECT h.episode, r.x_um, r.y_um FROM label_head h JOIN label_rev r"  # noqa: S608
                f" USING (rev_uuid) WHERE r.x_um NOTNULL AND h.episode IN ({marks})"
            )
            for uuid, x_um, y_um in self._database.rows(sql, some):
                found[uuid] = x_um / 1e3, y_um / 1e3
        nowhere = (math.nan, math.nan)
        places = [found.get(uuid, nowhere) for uuid in uuids]
        return np.array(places, dtype=np.float64).reshape(-1, 2)

    def history(self, uuid: str) -> list[Revision]:
        """Return all revisions of an episode, oldest first, the branches of a merge included.

        An approved revision that a later approved one replaced reads ``superseded``.
        """
        rows = self._database.rows(
            f"SELECT {REVISION} FROM label_rev r JOIN op o USING (op_uuid)"  # noqa: S608
            " WHERE r.episode = ? ORDER BY o.lamport, o.site, r.rev_uuid",
            (uuid,),
        )
        with self._database.reading() as connection:
            nodes, closed = heads.read_nodes(connection, uuid)
        head = heads.head_of(nodes, closed)
        old = heads.superseded(nodes, head.counting) if head else set[str]()
        found = [as_revision(row) for row in rows]
        return [replace(r, state="superseded") if r.rev_uuid in old else r for r in found]

    def standing(self, uuid: str) -> Standing:
        """Return what decides which actions an episode allows."""
        with self._database.reading() as connection:
            return standing_of(connection, uuid)

    def conflicting(self, uuid: str) -> list[Revision]:
        """Return the leaves of an episode, the head last; more than one is a conflict."""
        with self._database.reading() as connection:
            leaves = heads.leaves_of(*heads.read_nodes(connection, uuid))
            return [read_revision(connection, leaf.rev_uuid) for leaf in leaves]

    def marks(self, uuid: str) -> dict[str, str]:
        """Return the marks on an episode (flag, deleted, tags) and the note of each."""
        sql = "SELECT name, note FROM mark WHERE episode = ? AND present ORDER BY name"
        return dict(self._database.rows(sql, (uuid,)))

    def steps_apart(self, person: str, uuid: str) -> list[Step]:
        """Return what ``person`` did to an episode as gold, oldest first."""
        with self._database.reading() as connection:
            return apart.steps_of(connection, person, uuid)

    def left_apart(self, person: str) -> dict[str, Step]:
        """Return what ``person`` did last to each episode that was gold to them."""
        with self._database.reading() as connection:
            return apart.last_steps(connection, person)

    def counting(self, uuid: str) -> Revision | None:
        """Return the approved revision that training uses, or None."""
        row = self._database.first(
            "SELECT counting FROM label_head WHERE episode = ? AND NOT conflict AND NOT deleted",
            (uuid,),
        )
        if row is None or row[0] is None:
            return None
        with self._database.reading() as connection:
            return read_revision(connection, row[0])

    def log(self, *, actor: str | None = None, episode: str | None = None,
            text: str = "", limit: int = 500) -> list[Operation]:  # fmt: skip
        """Return operations, newest first: of one person, on one episode, holding ``text``."""
        terms, values = ["1"], list[object]()
        if actor is not None:
            terms.append("actor = ?")
            values.append(actor)
        for needle in filter(None, (episode, text)):
            terms.append("instr(body || ' ' || verb || ' ' || actor, ?) > 0")
            values.append(needle)
        rows = self._database.rows(
            f"SELECT {COLUMNS} FROM op WHERE {' AND '.join(terms)}"  # noqa: S608
            " ORDER BY lamport DESC, site DESC, seq DESC LIMIT ?",
            (*values, limit),
        )
        return [as_operation(row) for row in rows]

    def people(self) -> list[str]:
        """Return the names of all who acted."""
        return [name for (name,) in self._database.rows("SELECT DISTINCT actor FROM op ORDER BY 1")]

    def chain_heads(self) -> dict[str, str]:
        """Return the newest hash of every site, for backups, manifests and training runs."""
        with self._database.reading() as connection:
            return {site: digest for site, (_, digest) in newest_of(connection).items()}


def standing_of(connection: sqlite3.Connection, uuid: str) -> Standing:
    """Return what decides about actions; raises ``InputError`` if there is no such episode."""
    row = connection.execute(
        "SELECT state, authors, counting, conflict, deleted FROM label_head WHERE episode = ?",
        (uuid,),
    ).fetchone()
    if row is None:
        raise _unknown(uuid)
    state, authors, counting, conflict, deleted = row
    return Standing(
        state, heads.as_names(authors), counting is not None, bool(conflict), bool(deleted)
    )


def _unknown(uuid: str) -> InputError:
    return InputError("There is no such episode.", uuid, "List the episodes of the dataset.")

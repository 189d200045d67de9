"""Review queues: ordered lists of episodes, reproducible from labels and scores.

Scores are computed by a job about episodes; models also suggest offsets.
"""

from __future__ import annotations

import json
import shlex
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from hashlib import blake2b
from typing import NamedTuple

from touchdown.backend.annotations import operation_log
from touchdown.backend.annotations.database import Database
from touchdown.backend.annotations.values import Label, Revision
from touchdown.backend.core import InputError

# ``doubt``: increase of the likelihood of the signals a few mm away. ``duplicates``: distance of
# the label to those of the most similar signals, relative to the usual distance.
SCORES = ("doubt", "disagreement", "training", "duplicates")

MODEL_PREFIX = "model:"


@dataclass(frozen=True, slots=True)
class Suggestion:
    """Offset predicted by a model; ``source`` is ``model:<sha256 of its weights>``."""

    label: Label
    source: str
    at_ns: int


class ScoredLabel(NamedTuple):
    """Present label of an episode, the offset that a model predicts, and a score of both."""

    label: Label
    model: Label | None
    score: float | None


class ScoreStore:
    """Scores and suggestions of one dataset; the newest of each kind per episode."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def put(self, name: str, values: Mapping[str, float], model: str) -> None:
        """Store a score of many episodes, computed by ``model`` for their present labels."""
        if name not in SCORES:
            raise InputError(f"There is no score '{name}'.", "score", f"Use {', '.join(SCORES)}.")
        now = time.time_ns()
        rows = [(name, value, model, now, episode) for episode, value in values.items()]
        with self._database.transaction() as connection:
            connection.executemany(
                "INSERT OR REPLACE INTO score (name, episode, value, model, rev_uuid, at_ns)"
                " SELECT ?, h.episode, ?, ?, h.rev_uuid, ? FROM label_head h WHERE h.episode = ?",
                rows,
            )

    def of_revision(self, name: str, uuid: str) -> tuple[str, float] | None:
        """Return a score and the revision it was computed for, None if there is none."""
        row = self._database.first(
            "SELECT rev_uuid, value FROM score WHERE name = ? AND episode = ?", (name, uuid)
        )
        return None if row is None else (str(row[0]), float(row[1]))

    def suggest(self, labels: Mapping[str, Label], model: str) -> None:
        """Store the offsets predicted by ``model`` (hash of its weights), with their sigma."""
        now = time.time_ns()
        rows = [
            (uuid, label.x_um, label.y_um, label.theta_mdeg, label.sigma_um, model, now)
            for uuid, label in labels.items()
        ]
        with self._database.transaction() as connection:
            connection.executemany(
                "INSERT OR REPLACE INTO suggestion VALUES (?, ?, ?, ?, ?, ?, ?)", rows
            )

    def suggestion(self, uuid: str) -> Suggestion | None:
        """Return the suggestion of a model for an episode, or None."""
        row = self._database.first(
            "SELECT x_um, y_um, theta_mdeg, sigma_um, model, at_ns FROM suggestion"
            " WHERE episode = ?",
            (uuid,),
        )
        return (
            None if row is None else Suggestion(Label(*row[:4]), f"{MODEL_PREFIX}{row[4]}", row[5])
        )

    def beside(self, uuids: Sequence[str], score: str) -> dict[str, ScoredLabel]:
        """Return label, suggestion and score ``score`` of these episodes."""
        sql = (
            "SELECT h.episode, s.value, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, m.x_um, m.y_um,"  # noqa: S608
            " m.theta_mdeg, m.sigma_um FROM label_head h JOIN label_rev r USING (rev_uuid)"
            f" LEFT JOIN suggestion m ON m.episode = h.episode LEFT JOIN {_VALID_SCORE}"
            " WHERE h.episode IN (SELECT value FROM json_each(:uuids))"
        )
        rows = self._database.rows(sql, {"uuids": json.dumps(list(uuids)), "score": score})
        return {
            uuid: ScoredLabel(Label(*both[:4]), Label(*both[4:]) if both[7] else None, value)
            for uuid, value, *both in rows
        }


def disagreement(head: Revision, suggestion: Suggestion) -> float | None:
    """Return the distance of label and suggestion in standard uncertainties, or None."""
    a, b = head.label, suggestion.label
    if a.x_um is None or a.y_um is None or b.x_um is None or b.y_um is None:
        return None
    sigma = ((a.sigma_um or 0) ** 2 + (b.sigma_um or 0) ** 2) ** 0.5
    if not sigma:
        return None
    return float(((a.x_um - b.x_um) ** 2 + (a.y_um - b.y_um) ** 2) ** 0.5 / sigma)


QUEUES = (
    "unlabelled", "review", "returned", "doubt", "disagreement", "training", "coverage",
    "duplicates", "conflicts", "audit", "gold", "all",
)  # fmt: skip

AUDIT_SHARE = 0.05  # share of submitted and approved labels in a random audit

BIN_UM = 2000  # coverage is counted in squares of this size, per pair of pieces


_ORDERS = {
    "newest": "e.recorded_ns DESC",
    "oldest": "e.recorded_ns",
    "pair": "e.piece, e.bottom",
    "state": "h.state",
    "person": "e.person",
    "distance": "r.x_um * r.x_um + r.y_um * r.y_um DESC",
    **dict.fromkeys(SCORES, "s.value DESC"),
}
_MARKS = {"flagged": "h.flagged", "conflict": "h.conflict", "refused": "NOT e.accepted"}
_FIELDS = {
    "piece": "e.piece = {}",
    "bottom": "e.bottom = {}",
    "state": "h.state = {}",
    "person": "(e.person = {0} OR instr(h.authors, char(10) || {0} || char(10)) > 0)",
    "since": "e.recorded_ns >= {}",
    "until": "e.recorded_ns < {}",
    **dict.fromkeys(SCORES, "s.value >= {}"),
}
FILTER_HELP = (
    f"Use words, and {':, '.join(_FIELDS)}: with a value, state: also with {', '.join(_MARKS)}, "
    f"days such as 2026-11-30, and sort: with {', '.join(_ORDERS)}. One score at a time."
)


class QueueFilter(NamedTuple):
    """Condition and order of SQL, and the score that they are about ("" for none)."""

    where: str
    values: dict[str, object]
    order: str
    score: str


def parse_filter(text: str) -> QueueFilter:
    """Return the filter of words and ``key:value`` pairs, as ``FILTER_HELP`` lists them.

    Raises ``InputError`` that names the wrong word.
    """
    terms, order, scores, word = ["NOT h.deleted"], "newest", set[str](), text
    values: dict[str, object] = {}
    try:
        for number, word in enumerate(shlex.split(text)):
            (key, colon, value), name = word.partition(":"), f"v{number}"
            scores |= {key, value if key == "sort" else ""}.intersection(SCORES)
            if key == "sort":
                order = {found: found for found in _ORDERS}[value]
            elif key == "state" and value in _MARKS:
                terms.append(_MARKS[value])
            elif colon:
                terms.append(_FIELDS[key].format(f":{name}"))
                values[name] = _value(key, value)
            else:
                terms.append(f"instr({_TEXT}, :{name}) > 0")
                values[name] = word.lower()
        (score,) = scores or {""}
    except (KeyError, ValueError, OverflowError):
        raise InputError(f"'{word}' is no filter.", "filter", FILTER_HELP) from None
    return QueueFilter(" AND ".join(terms), {**values, "score": score}, _ORDERS[order], score)


def _value(key: str, text: str) -> object:
    """Return a value as SQLite compares it: local days as the ns of their start or end."""
    if key in SCORES:
        return float(text)
    if key not in ("since", "until"):
        return text
    begin = datetime.strptime(text, "%Y-%m-%d") + timedelta(days=key == "until")
    # Whole numbers of SQLite have 64 bits, which end in the year 2262.
    return max(0, min(int(begin.timestamp()) * 1_000_000_000, 2**63 - 1))


def episode_queue(
    database: Database,
    name: str,
    person: str,
    *,
    seed: int = 0,
    wanted: str = "",
    limit: int | None = None,
) -> list[str]:
    """Return the first ``limit`` episodes of a queue for ``person``, in order, none deleted.

    - unlabelled: not yet accepted, oldest first, skipped ones last
    - review: submitted by others; returned: own labels and probes that were rejected
    - doubt, disagreement, duplicates: highest score first. Labels that changed since the score was
      computed are left out
    - training: not yet accepted, highest score first, whatever the label
    - coverage: not yet approved, squares with the fewest approved labels first
    - conflicts: two labels since a merge; audit: a share drawn by ``seed``
    - gold: control items, a share of the approved labels of others, answered blind and once each;
      undone answers are asked again
    - all: every episode that passes the filter ``wanted`` (see ``parse_filter``)
    """
    if name not in QUEUES:
        raise InputError(f"There is no queue '{name}'.", "queue", f"Use {', '.join(QUEUES)}.")
    if name == "all":
        where, values, order, _ = parse_filter(wanted)
        revision = "JOIN label_rev r USING (rev_uuid)" if " r." in f"{where} {order}" else ""
        scored = f"LEFT JOIN {_VALID_SCORE}" if values["score"] else ""
        sql = (
            "SELECT e.uuid FROM episode e JOIN label_head h ON h.episode = e.uuid"  # noqa: S608
            f" {revision} {scored} WHERE {where} ORDER BY {order}, e.uuid LIMIT :limit"
        )
        rows = database.rows(sql, {**values, "limit": -1 if limit is None else limit})
        return [uuid for (uuid,) in rows]
    if name == "coverage":
        return _coverage(database)[:limit]
    if name in ("audit", "gold"):
        found = _drawn(_ids(database, name, person), seed)
        answered = _answered(database, person) if name == "gold" else ()
        return [uuid for uuid in found if uuid not in answered][:limit]
    return _ids(database, name, person, limit)


def _ids(database: Database, name: str, person: str, limit: int | None = None) -> list[str]:
    values: dict[str, object] = {"person": person, "author": f"\n{person}\n", "name": name}
    values["limit"] = -1 if limit is None else limit
    return [uuid for (uuid,) in database.rows(f"{_QUERIES[name]} LIMIT :limit", values)]


def _coverage(database: Database) -> list[str]:
    rows = database.rows(
        "SELECT h.episode, h.stage, e.piece, e.bottom, r.x_um, r.y_um FROM label_head h"
        " JOIN label_rev r USING (rev_uuid) JOIN episode e ON e.uuid = h.episode"
        " WHERE h.stage IN ('unlabelled', 'review', 'approved') AND r.x_um IS NOT NULL"
        " AND r.y_um IS NOT NULL ORDER BY h.episode"
    )
    where = {row[0]: (row[2], row[3], row[4] // BIN_UM, row[5] // BIN_UM) for row in rows}
    approved = Counter(where[row[0]] for row in rows if row[1] == "approved")
    waiting = (row[0] for row in rows if row[1] != "approved")
    return sorted(waiting, key=lambda uuid: (approved[where[uuid]], uuid))


def _answered(database: Database, person: str) -> set[str]:
    """Return the episodes with an opinion of ``person`` that was not undone."""
    sql = (
        "SELECT episode FROM opinion JOIN op USING (op_uuid) WHERE actor = ?"
        " AND NOT EXISTS (SELECT 1 FROM apart a WHERE a.op_uuid = opinion.op_uuid)"
    )
    with database.reading() as connection:
        steps = operation_log.last_steps(connection, person)
    decided = {uuid for uuid, step in steps.items() if step.answer is not None}
    return decided.union(uuid for (uuid,) in database.rows(sql, (person,)))


def _drawn(uuids: list[str], seed: int) -> list[str]:
    """Return a share of ``uuids`` in random order; a draw depends on ``seed`` and its id only."""
    key = seed.to_bytes(16, "little", signed=True)

    def die(uuid: str) -> int:
        return int.from_bytes(blake2b(uuid.encode(), digest_size=8, key=key).digest(), "little")

    thrown = sorted((die(uuid), uuid) for uuid in uuids)
    return [uuid for value, uuid in thrown if value < AUDIT_SHARE * 2**64]


# A score counts while the label is the one it was computed for; training needs no label.
_VALID_SCORE = (
    "score s ON s.episode = h.episode AND s.name = :score"
    " AND (s.rev_uuid = h.rev_uuid OR s.name = 'training')"
)
_TEXT = (
    "lower(e.piece || ' ' || e.bottom || ' ' || e.person || ' ' || e.grip_id || ' ' || h.authors"
    " || e.series || ' ' || e.campaign || ' ' || e.uuid || ' ' || r.note || ' '"
    " || coalesce(r.reason, ''))"
)
_IN_ORDER = "SELECT episode FROM label_head WHERE {} ORDER BY skipped, episode"
_BY_SCORE = (
    "SELECT s.episode FROM score s JOIN label_head h USING (episode)"
    " WHERE s.name = :name AND {} ORDER BY s.value DESC, s.episode"
)
_SAME_LABEL = _BY_SCORE.format(
    "h.stage IN ('unlabelled', 'review', 'approved') AND h.rev_uuid = s.rev_uuid"
)
_QUERIES = {
    "unlabelled": _IN_ORDER.format("stage = 'unlabelled'"),
    "review": _IN_ORDER.format("stage = 'review' AND instr(authors, :author) = 0"),
    "returned": _IN_ORDER.format(
        "stage = 'rejected' AND (instr(authors, :author) > 0 OR authors = char(10)"
        " AND actor = :person)"
    ),
    "doubt": _SAME_LABEL,
    "disagreement": _SAME_LABEL,
    "training": _BY_SCORE.format("h.stage = 'unlabelled'"),
    "duplicates": _SAME_LABEL,
    "conflicts": _IN_ORDER.format("stage = 'conflicts'"),
    "audit": _IN_ORDER.format("stage IN ('review', 'approved')"),
    "gold": _IN_ORDER.format("stage = 'approved' AND instr(authors, :author) = 0"),
}

"""Tables of the catalogue.

Append-only tables refuse UPDATE and DELETE, and REPLACE as well: SQLite deletes the replaced row
without firing delete triggers, so a trigger before the insert has to find the key first.
``label_rev``, ``closed``, ``mark``, ``review`` and ``opinion`` say what the operations say;
``label_head`` follows from them. So does ``apart``: what one person did to gold, which is no label.
"""

from __future__ import annotations

APPLICATION_ID = 0x546F7563
SCHEMA_VERSION = 4

TABLES = """
CREATE TABLE series (
    uuid TEXT PRIMARY KEY, started_ns INTEGER NOT NULL, person TEXT NOT NULL,
    campaign TEXT NOT NULL, mode TEXT NOT NULL, bench TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE episode (
    uuid TEXT PRIMARY KEY, series TEXT NOT NULL, campaign TEXT NOT NULL, plan_item INTEGER,
    kind TEXT NOT NULL CHECK (kind IN ('file', 'pack')), path TEXT NOT NULL,
    chunk_off INTEGER, chunk_len INTEGER, crc INTEGER,
    sha256 TEXT NOT NULL, bytes INTEGER NOT NULL, recorded_ns INTEGER NOT NULL,
    piece TEXT NOT NULL, bottom TEXT NOT NULL, geometry TEXT NOT NULL, grip_id TEXT NOT NULL,
    mounting_id TEXT NOT NULL, person TEXT NOT NULL, mode TEXT NOT NULL, quality TEXT NOT NULL,
    accepted INTEGER NOT NULL, keep_frames TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN ('complete', 'missing', 'damaged', 'quarantined')),
    adopted INTEGER NOT NULL
) WITHOUT ROWID;
CREATE INDEX episode_pair ON episode (piece, bottom, uuid);
CREATE INDEX episode_series ON episode (series, uuid);
CREATE INDEX episode_campaign ON episode (campaign, plan_item);
CREATE INDEX episode_path ON episode (path);
CREATE INDEX episode_sha256 ON episode (sha256);
CREATE TABLE op (
    op_uuid TEXT PRIMARY KEY, site TEXT NOT NULL, seq INTEGER NOT NULL, lamport INTEGER NOT NULL,
    at_ns INTEGER NOT NULL, actor TEXT NOT NULL, verb TEXT NOT NULL, target_op TEXT,
    body TEXT NOT NULL, prev_hash TEXT NOT NULL, hash TEXT NOT NULL, UNIQUE (site, seq)
);
CREATE INDEX op_lamport ON op (lamport);
CREATE INDEX op_actor ON op (actor, lamport);
CREATE TABLE label_rev (
    rev_uuid TEXT PRIMARY KEY, op_uuid TEXT NOT NULL REFERENCES op (op_uuid),
    episode TEXT NOT NULL, parent TEXT, x_um INTEGER, y_um INTEGER, theta_mdeg INTEGER,
    sigma_um INTEGER, source TEXT NOT NULL, state TEXT NOT NULL, reason TEXT, verdict TEXT,
    geometry TEXT NOT NULL, note TEXT NOT NULL, copy_of TEXT
);
CREATE INDEX label_rev_episode ON label_rev (episode);
CREATE INDEX label_rev_op ON label_rev (op_uuid);
CREATE TABLE closed (
    rev_uuid TEXT NOT NULL, op_uuid TEXT NOT NULL REFERENCES op (op_uuid),
    PRIMARY KEY (rev_uuid, op_uuid)
) WITHOUT ROWID;
CREATE TABLE label_head (
    episode TEXT PRIMARY KEY, rev_uuid TEXT NOT NULL, conflict INTEGER NOT NULL,
    stage TEXT NOT NULL, state TEXT NOT NULL, counting TEXT, authors TEXT NOT NULL,
    actor TEXT NOT NULL, flagged INTEGER NOT NULL, skipped INTEGER NOT NULL,
    deleted INTEGER NOT NULL
) WITHOUT ROWID;
CREATE INDEX label_head_stage ON label_head (stage, skipped, episode);
CREATE TABLE mark (
    episode TEXT NOT NULL, name TEXT NOT NULL, present INTEGER NOT NULL, note TEXT NOT NULL,
    op_uuid TEXT NOT NULL REFERENCES op (op_uuid), lamport INTEGER NOT NULL, site TEXT NOT NULL,
    owner TEXT NOT NULL, PRIMARY KEY (episode, name)
) WITHOUT ROWID;
CREATE INDEX mark_name ON mark (name, present, episode);
CREATE TABLE review (
    op_uuid TEXT NOT NULL REFERENCES op (op_uuid), rev_uuid TEXT NOT NULL, reviewer TEXT NOT NULL,
    decision TEXT NOT NULL, reason TEXT, seen_ms INTEGER, blind INTEGER,
    PRIMARY KEY (op_uuid, rev_uuid)
);
CREATE TABLE opinion (
    op_uuid TEXT NOT NULL REFERENCES op (op_uuid), episode TEXT NOT NULL, x_um INTEGER,
    y_um INTEGER, theta_mdeg INTEGER, sigma_um INTEGER, verdict TEXT,
    PRIMARY KEY (op_uuid, episode)
);
CREATE INDEX opinion_episode ON opinion (episode);
CREATE TABLE event (
    id INTEGER PRIMARY KEY, at_ns INTEGER NOT NULL, actor TEXT NOT NULL, verb TEXT NOT NULL,
    target TEXT NOT NULL, body TEXT NOT NULL
);
CREATE TABLE score (
    name TEXT NOT NULL, episode TEXT NOT NULL, value REAL NOT NULL, model TEXT NOT NULL,
    rev_uuid TEXT NOT NULL, at_ns INTEGER NOT NULL, PRIMARY KEY (name, episode)
) WITHOUT ROWID;
CREATE INDEX score_value ON score (name, value);
CREATE TABLE suggestion (
    episode TEXT PRIMARY KEY, x_um INTEGER NOT NULL, y_um INTEGER NOT NULL,
    theta_mdeg INTEGER, sigma_um INTEGER NOT NULL, model TEXT NOT NULL, at_ns INTEGER NOT NULL
) WITHOUT ROWID;
"""

RUNS = """
CREATE TABLE run (
    uuid TEXT PRIMARY KEY, kind TEXT NOT NULL,
    state TEXT NOT NULL CHECK (state IN
        ('queued', 'running', 'finished', 'failed', 'cancelled', 'interrupted')),
    started_ns INTEGER NOT NULL, ended_ns INTEGER, reason TEXT NOT NULL, program TEXT NOT NULL,
    seed INTEGER NOT NULL, hardware TEXT NOT NULL, environment TEXT NOT NULL,
    manifest TEXT NOT NULL, chain TEXT NOT NULL, mark TEXT NOT NULL, read_bytes INTEGER NOT NULL
) WITHOUT ROWID;
CREATE INDEX run_started ON run (started_ns);
CREATE TABLE param (
    run TEXT NOT NULL REFERENCES run (uuid), key TEXT NOT NULL, value TEXT NOT NULL,
    PRIMARY KEY (run, key)
) WITHOUT ROWID;
CREATE TABLE metric (
    run TEXT NOT NULL REFERENCES run (uuid), name TEXT NOT NULL, step INTEGER NOT NULL,
    value REAL, at_ns INTEGER NOT NULL, PRIMARY KEY (run, name, step)
) WITHOUT ROWID;
CREATE TABLE artifact (
    run TEXT NOT NULL REFERENCES run (uuid), name TEXT NOT NULL, path TEXT NOT NULL,
    sha256 TEXT NOT NULL, bytes INTEGER NOT NULL, PRIMARY KEY (run, name)
) WITHOUT ROWID;
CREATE VIEW plan_item AS
    SELECT e.campaign, e.plan_item AS item, e.uuid AS episode, e.piece, e.bottom, e.recorded_ns,
        e.accepted AND NOT h.deleted AS done
    FROM episode e JOIN label_head h ON h.episode = e.uuid
    WHERE e.campaign != '' AND e.plan_item IS NOT NULL;
CREATE VIEW campaign AS
    SELECT campaign AS uuid, min(piece) AS piece, min(bottom) AS bottom,
        min(recorded_ns) AS began_ns, max(recorded_ns) AS last_ns, count(*) AS episodes,
        count(DISTINCT CASE WHEN done THEN item END) AS done
    FROM plan_item GROUP BY campaign;
CREATE TABLE schema_migration (
    from_version INTEGER NOT NULL, to_version INTEGER PRIMARY KEY, at_ns INTEGER NOT NULL,
    program TEXT NOT NULL
) WITHOUT ROWID;
"""
"""Of a run its folder is the truth, of a campaign its file: these say the same to queries.

``mark`` and ``read_bytes``: which state of the run's files the rows show. A campaign needs no rows
of its own: what is done of it is what its episodes are.
"""

CHECKED = """
CREATE TABLE checked_folder (
    path TEXT PRIMARY KEY, stamp TEXT NOT NULL, rows INTEGER NOT NULL, at_ns INTEGER NOT NULL
) WITHOUT ROWID;
"""


def _guards(table: str, key: str) -> str:
    stop = f"BEGIN SELECT RAISE(ABORT, '{table} is append-only'); END;\n"
    known = f"EXISTS (SELECT 1 FROM {table} WHERE {key})"  # noqa: S608 - names of this module
    return (
        f"CREATE TRIGGER {table}_no_update BEFORE UPDATE ON {table} {stop}"
        f"CREATE TRIGGER {table}_no_delete BEFORE DELETE ON {table} {stop}"
        f"CREATE TRIGGER {table}_no_replace BEFORE INSERT ON {table} WHEN {known} {stop}"
    )


APART = """
CREATE TABLE apart (
    op_uuid TEXT NOT NULL REFERENCES op (op_uuid), episode TEXT NOT NULL, rev_uuid TEXT NOT NULL,
    parent TEXT, x_um INTEGER, y_um INTEGER, theta_mdeg INTEGER, sigma_um INTEGER,
    source TEXT NOT NULL, state TEXT NOT NULL, reason TEXT, verdict TEXT, geometry TEXT NOT NULL,
    note TEXT NOT NULL, copy_of TEXT, deleted TEXT NOT NULL, skipped INTEGER NOT NULL,
    shown_ns INTEGER NOT NULL, beside TEXT NOT NULL, PRIMARY KEY (op_uuid, episode)
);
CREATE INDEX apart_episode ON apart (episode);
""" + _guards("apart", "op_uuid = NEW.op_uuid AND episode = NEW.episode")
"""Of each step on gold what the person sees after it, and where the episode is shown.

``shown_ns`` is always 0: it held an invented time of recording.
"""

KEYS = {
    "op": "op_uuid = NEW.op_uuid OR (site = NEW.site AND seq = NEW.seq)",
    "label_rev": "rev_uuid = NEW.rev_uuid",
    "review": "op_uuid = NEW.op_uuid AND rev_uuid = NEW.rev_uuid",
    "opinion": "op_uuid = NEW.op_uuid AND episode = NEW.episode",
    "event": "id = NEW.id",
}
"""The append-only tables of ``TABLES`` and what makes a row of them the same row."""


def statements() -> str:
    """Return everything a new catalogue needs."""
    guards = "".join(_guards(table, key) for table, key in KEYS.items())
    return TABLES + guards + RUNS + CHECKED + APART

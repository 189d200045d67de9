-- Tables of the catalogue of a dataset. Triggers of append-only tables are added by the program.
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
CREATE TABLE checked_folder (
    path TEXT PRIMARY KEY, stamp TEXT NOT NULL, rows INTEGER NOT NULL, at_ns INTEGER NOT NULL
) WITHOUT ROWID;
-- Steps on control items: the label as the person sees it, and its position in the queue.
-- shown_ns is always 0; older versions stored a synthetic recording time.
CREATE TABLE apart (
    op_uuid TEXT NOT NULL REFERENCES op (op_uuid), episode TEXT NOT NULL, rev_uuid TEXT NOT NULL,
    parent TEXT, x_um INTEGER, y_um INTEGER, theta_mdeg INTEGER, sigma_um INTEGER,
    source TEXT NOT NULL, state TEXT NOT NULL, reason TEXT, verdict TEXT, geometry TEXT NOT NULL,
    note TEXT NOT NULL, copy_of TEXT, deleted TEXT NOT NULL, skipped INTEGER NOT NULL,
    shown_ns INTEGER NOT NULL, beside TEXT NOT NULL, PRIMARY KEY (op_uuid, episode)
);
CREATE INDEX apart_episode ON apart (episode);

"""Value types of the annotations: labels, operations, episode entries, identifiers, hashes.

Identifiers are UUID version 7 (RFC 9562), which sort by time; Python 3.11 has no generator.
Operations are hashed as canonical JSON and chained, one chain per site.
"""

from __future__ import annotations

import json
import secrets
import time
import uuid
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from hashlib import sha256
from threading import Lock
from typing import Any, Literal

import numpy as np

from touchdown.backend.core import EpisodeQuality, FloatArray

RANDOM_BITS = 74
_lock = Lock()
_last = (0, 0)


def uuid7() -> str:
    """Return a new id, greater than all earlier ones of this process."""
    global _last
    with _lock:
        ms, random = time.time_ns() // 1_000_000, secrets.randbits(RANDOM_BITS - 1)
        if ms <= _last[0]:
            # Within one millisecond (or after the clock was set back) the last id is incremented.
            ms, random = _last[0], _last[1] + 1 + secrets.randbits(32)
        _last = (ms, random)
    return uuid7_from_parts(ms, random)


def follow_uuid(text: str) -> None:
    """Make all later ids of this process greater than ``text``.

    Keeps the order of ids if the clock was set back. Ignores a text that is not an id.
    """
    global _last
    if is_uuid7(text):
        value = uuid.UUID(text).int
        random = (value >> 64 & 0xFFF) << 62 | value & ((1 << 62) - 1)
        ms = value >> 80
        # Near the end of a millisecond the random bits could overflow.
        parts = (ms, random) if random < 1 << (RANDOM_BITS - 1) else (ms + 1, 0)
        with _lock:
            _last = max(_last, parts)


def uuid7_from_parts(ms: int, random: int) -> str:
    """Return the id of a Unix time in ms (48 bit) and 74 random bits."""
    high, low = random >> 62, random & ((1 << 62) - 1)
    return str(uuid.UUID(int=ms << 80 | 0x7 << 76 | high << 64 | 0b10 << 62 | low))


def is_uuid7(text: str) -> bool:
    """Return True if ``text`` is a UUID version 7 in lower-case notation."""
    try:
        value = uuid.UUID(text)
    except ValueError:
        return False
    return value.version == 7 and str(value) == text


# ``commanded``, ``measured``, ``human`` or ``model:<sha256 of the weights>``; of several models
# the hashes are joined by ``+``.
Source = str

LabelState = Literal["unlabelled", "draft", "submitted", "approved", "rejected", "superseded"]
Verdict = Literal["stable", "unstable", "unsure"]
FileState = Literal["complete", "missing", "damaged", "quarantined"]

# Actor of operations by the program. It may store drafts, never submit or review them.
PROGRAM_ACTOR = "program"

FLAG, SKIPPED, DELETED = "flag", "skipped", "deleted"
GEOMETRY_CHANGED = "geometry-changed"


@dataclass(frozen=True, slots=True)
class Label:
    """Offset of the grasped face from the bottom: x, y in µm, rotation in mdeg.

    ``sigma_um``: standard uncertainty of x and of y. All None: unlabelled.
    """

    x_um: int | None = None
    y_um: int | None = None
    theta_mdeg: int | None = None
    sigma_um: int | None = None

    @property
    def is_set(self) -> bool:
        """True if there is an offset."""
        return self.x_um is not None and self.y_um is not None

    @property
    def offset_mm(self) -> FloatArray:
        """Offset (2,) in mm; NaN if there is none."""
        pair = [np.nan if value is None else value / 1e3 for value in (self.x_um, self.y_um)]
        return np.array(pair, dtype=np.float64)


NO_LABEL = Label()


@dataclass(frozen=True, slots=True)
class Revision:
    """One immutable version of the label of one episode.

    ``parent``: the previous revision. ``state`` is as written; ``superseded`` appears only in a
    history, for an approved revision that a later approved one replaced. ``geometry``: hash of the
    pair record. ``reason``: why it was rejected.
    """

    rev_uuid: str
    op_uuid: str
    episode: str
    parent: str | None
    label: Label
    source: Source
    state: LabelState
    reason: str | None
    verdict: Verdict | None
    geometry: str
    note: str
    person: str
    at_ns: int


@dataclass(frozen=True, slots=True)
class LabelContent:
    """Content of a revision, without its position in the history."""

    label: Label
    source: Source
    geometry: str
    verdict: Verdict | None = None
    note: str = ""

    @classmethod
    def of(cls, revision: Revision) -> LabelContent:
        """Return the content of ``revision``."""
        r = revision
        return cls(r.label, r.source, r.geometry, r.verdict, r.note)


@dataclass(frozen=True, slots=True)
class Operation:
    """One action of one person: a link of the chain of its site, and one step of undo.

    ``body``: ``closes`` (revisions it closes), ``revs`` (revisions it writes), and optionally
    ``marks``, ``copies``, ``reviews``, ``opinions``, ``apart`` (steps on control items, in no
    label), ``seen_ms``, ``blind``. Hashes are hexadecimal.
    """

    op_uuid: str
    site: str
    seq: int
    lamport: int
    at_ns: int
    actor: str
    verb: str
    target_op: str | None
    body: Mapping[str, object]
    prev_hash: str
    hash: str

    @property
    def episodes(self) -> list[str]:
        """Ids of the episodes concerned, without duplicates."""
        body: Mapping[str, Any] = self.body
        names = ("revs", "marks", "opinions", "apart")
        parts = (part for name in names for part in body.get(name, ()))
        return list(dict.fromkeys(str(part["episode"]) for part in parts))


@dataclass(frozen=True, slots=True)
class AnswerContext:
    """Conditions of an answer: time spent in ms (without pauses), and suggestion hidden or not."""

    seen_ms: int
    blind: bool = False


@dataclass(frozen=True, slots=True)
class ControlItemStep:
    """State of a control item as one person sees it after a step, none of it a label.

    ``version``: its label. ``copy_of``: the version that undo or redo repeated. ``deleted``: the
    reason of a deletion, else "". ``beside``: the episode before it in the queue ("" if it comes
    first).
    """

    version: Revision
    copy_of: str | None = None
    deleted: str = ""
    skipped: bool = False
    beside: str = ""

    @property
    def answer(self) -> Label | None:
        """Decided content (without offset if rejected or deleted); None before a decision."""
        if self.deleted or self.version.state == "rejected":
            return NO_LABEL
        return self.version.label if self.version.state == "submitted" else None


@dataclass(frozen=True, slots=True)
class EpisodeContext:
    """Circumstances of an episode, on every bench.

    ``geometry``: hash of the pair record (``GeometryStore.store_pair``). ``mode``: lab, emulated,
    live simulation, stepped, mass or imported. ``bench``: further text for the record ``bench``.
    """

    series: str
    bottom: str
    geometry: str
    person: str
    grip_id: str
    mounting_id: str
    campaign: str = ""
    plan_item: int | None = None
    mode: str = "stepped"
    seed: int | None = None
    bench: Mapping[str, str] = field(default_factory=dict)


UNKNOWN_GRIP = "/unknown"  # end of a grip id of imported episodes, whose grips are unknown


@dataclass(frozen=True, slots=True)
class EpisodeEntry:
    """One row of the index.

    ``path`` is relative to the dataset; ``recorded_ns`` is UTC. ``state`` and the three flags come
    from the labels; ``file_state`` is that of the file. ``adopted``: found on disk on opening,
    after a crash or a restore.
    """

    uuid: str
    series: str
    campaign: str
    plan_item: int | None
    path: str
    recorded_ns: int
    piece: str
    bottom: str
    geometry: str
    grip_id: str
    mounting_id: str
    person: str
    mode: str
    quality: EpisodeQuality
    keep_frames: str
    sha256: str
    bytes: int
    file_state: FileState
    adopted: bool
    state: LabelState
    conflict: bool
    flagged: bool
    deleted: bool

    @property
    def grip(self) -> str:
        """Id of the grip; the episode itself where the grip is unknown."""
        return self.uuid if self.grip_id.endswith(UNKNOWN_GRIP) else self.grip_id


@dataclass(frozen=True, slots=True)
class EpisodeFilter:
    """Filter of a list of episodes, oldest first; empty or None matches all.

    ``accepted``: by the quality checks. ``after``: only episodes later than this uuid.
    """

    states: tuple[LabelState, ...] = ()
    piece: str | None = None
    bottom: str | None = None
    series: str | None = None
    campaign: str | None = None
    grip_id: str | None = None
    person: str | None = None
    accepted: bool | None = None
    flagged: bool | None = None
    conflict: bool | None = None
    deleted: bool | None = False
    tag: str | None = None
    after: str | None = None
    limit: int | None = None


FIRST_HASH = "0" * 64  # previous hash of the first operation of a site
ChainPosition = tuple[int, str]  # number and hash of an operation

HASHED = ("actor", "at_ns", "body", "lamport", "op_uuid", "seq", "site", "target_op", "verb")


def canonical_json(value: object) -> bytes:
    """Return UTF-8 JSON with sorted keys and without spaces.

    Integers, texts, booleans, null, arrays and objects only: a float raises ``TypeError``.
    """
    _refuse_floats(value)
    return _encoded(value)


def content_hash(value: object) -> str:
    """Return the SHA-256 of the canonical JSON, in hex."""
    return sha256(canonical_json(value)).hexdigest()


def operation_hash(operation: Operation) -> str:
    """Return the expected hash of ``operation`` (hexadecimal)."""
    content = {name: getattr(operation, name) for name in HASHED}
    # Not checked for floats here: storing an operation refuses them, and speed matters.
    return sha256(bytes.fromhex(operation.prev_hash) + _encoded(content)).hexdigest()


def first_broken_link(
    operations: Iterable[Operation], start: ChainPosition = (0, FIRST_HASH)
) -> int | None:
    """Return the first number that does not continue the chain of one site from ``start``."""
    seq, digest = start
    for operation in operations:
        fits = (operation.seq, operation.prev_hash) == (seq + 1, digest)
        try:
            whole = fits and operation_hash(operation) == operation.hash
        except (TypeError, ValueError):
            whole = False
        if not whole:
            return seq + 1
        seq, digest = operation.seq, operation.hash
    return None


def _encoded(value: object) -> bytes:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return text.encode("utf-8")


def _refuse_floats(value: object) -> None:
    if isinstance(value, float):
        raise TypeError("floats are not hashed: store a text or an integer in µm")
    if isinstance(value, dict | list | tuple):
        for item in value.values() if isinstance(value, dict) else value:
            _refuse_floats(item)

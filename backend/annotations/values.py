"""Value types of the annotations: labels, operations, episode entries, identifiers, hashes.

Identifiers are UUID version 7 (RFC 9562): sorting by id is sorting by time; Python 3.11 has no
generator. Operations are hashed as canonical JSON and chained, one chain per site.
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
    """Return a new id, greater than every one this process made before."""
    global _last
    with _lock:
        ms, random = time.time_ns() // 1_000_000, secrets.randbits(RANDOM_BITS - 1)
        if ms <= _last[0]:
            # Within one millisecond (or when the clock was set back) count on from the last one.
            ms, random = _last[0], _last[1] + 1 + secrets.randbits(32)
        _last = (ms, random)
    return uuid7_from_parts(ms, random)


def follow_uuid(text: str) -> None:
    """Make every later id of this process greater than ``text``, whatever the clock says.

    A clock that was set back must not put what comes later before what is there. Text that is no
    such id changes nothing.
    """
    global _last
    if is_uuid7(text):
        value = uuid.UUID(text).int
        random = (value >> 64 & 0xFFF) << 62 | value & ((1 << 62) - 1)
        ms = value >> 80
        # Near the end of a millisecond there is no room to count on.
        parts = (ms, random) if random < 1 << (RANDOM_BITS - 1) else (ms + 1, 0)
        with _lock:
            _last = max(_last, parts)


def uuid7_from_parts(ms: int, random: int) -> str:
    """Return the id of Unix milliseconds (48 bit) and 74 random bits."""
    high, low = random >> 62, random & ((1 << 62) - 1)
    return str(uuid.UUID(int=ms << 80 | 0x7 << 76 | high << 64 | 0b10 << 62 | low))


def is_uuid7(text: str) -> bool:
    """Whether ``text`` is such an id, in its usual spelling."""
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

# The actor of what no person did. It may store drafts, never submit or review them.
PROGRAM = "program"

FLAG, SKIPPED, DELETED = "flag", "skipped", "deleted"
GEOMETRY_CHANGED = "geometry-changed"


@dataclass(frozen=True, slots=True)
class Label:
    """Where the grasped face was relative to the bottom: x, y in µm, rotation in mdeg.

    ``sigma_um``: standard uncertainty of x and of y. All None: unlabelled.
    """

    x_um: int | None = None
    y_um: int | None = None
    theta_mdeg: int | None = None
    sigma_um: int | None = None

    @property
    def is_set(self) -> bool:
        """Whether there is an offset."""
        return self.x_um is not None and self.y_um is not None

    @property
    def offset_mm(self) -> FloatArray:
        """(2,) displacement in mm; NaN where there is none."""
        pair = [np.nan if value is None else value / 1e3 for value in (self.x_um, self.y_um)]
        return np.array(pair, dtype=np.float64)


NO_LABEL = Label()


@dataclass(frozen=True, slots=True)
class Revision:
    """One version of the label of one episode; never changed once written.

    ``parent``: the revision it follows. ``state`` is as written; ``superseded`` only ever appears
    in a history, for an approved revision that a later approved one replaced. ``geometry``: hash
    of the pair record. ``reason``: why it was rejected.
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
    """What a revision says, apart from where it stands in the history."""

    label: Label
    source: Source
    geometry: str
    verdict: Verdict | None = None
    note: str = ""

    @classmethod
    def of(cls, revision: Revision) -> LabelContent:
        """Return what ``revision`` says."""
        r = revision
        return cls(r.label, r.source, r.geometry, r.verdict, r.note)


@dataclass(frozen=True, slots=True)
class Operation:
    """One action of one person: a link of the chain of its site, and one step of undo.

    ``body``: ``closes`` (revisions it retires), ``revs`` (what it wrote), and where there are any
    ``marks``, ``copies``, ``reviews``, ``opinions``, ``apart`` (steps on gold, in no label),
    ``seen_ms``, ``blind``. Hashes are hex.
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
        """The episodes that it touched, each once."""
        parts: list[Any] = []
        for name in ("revs", "marks", "opinions", "apart"):
            found: Any = self.body.get(name, ())
            parts += found
        return list(dict.fromkeys(str(part["episode"]) for part in parts))


@dataclass(frozen=True, slots=True)
class AnswerContext:
    """How a person came to an answer: time spent in ms (pauses left out); model hidden or not."""

    seen_ms: int
    blind: bool = False


@dataclass(frozen=True, slots=True)
class ControlItemStep:
    """What one person sees of a gold episode after an action of theirs, none of it a label.

    ``version``: how its label looks. ``copy_of``: the version whose content undo or redo wrote
    again. ``deleted``: why, "" if it is not. ``beside``: the episode of the queue that it comes
    after ("" if it is the first).
    """

    version: Revision
    copy_of: str | None = None
    deleted: str = ""
    skipped: bool = False
    beside: str = ""

    @property
    def answer(self) -> Label | None:
        """What was decided (of rejected or deleted gold no displacement), None: nothing yet."""
        if self.deleted or self.version.state == "rejected":
            return NO_LABEL
        return self.version.label if self.version.state == "submitted" else None


@dataclass(frozen=True, slots=True)
class EpisodeContext:
    """What is known of an episode beside its signals, on every bench.

    ``geometry``: hash of the pair record (``GeometryStore.store_pair``). ``mode``: lab, emulated,
    live simulation, stepped, mass or imported. ``bench``: further words for the record ``bench``.
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


@dataclass(frozen=True, slots=True)
class EpisodeEntry:
    """One row of the index. ``path`` is relative to the dataset; ``recorded_ns`` is UTC.

    ``state`` and the three flags come from the labels; ``file_state`` is that of the file.
    ``adopted``: found on disk at a start, after a crash or a restore.
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


@dataclass(frozen=True, slots=True)
class EpisodeFilter:
    """Which episodes to list, oldest first; empty or None means any.

    ``accepted``: by the quality checks. ``after``: only episodes later than this uuid.
    """

    states: tuple[LabelState, ...] = ()
    piece: str | None = None
    bottom: str | None = None
    series: str | None = None
    campaign: str | None = None
    person: str | None = None
    accepted: bool | None = None
    flagged: bool | None = None
    conflict: bool | None = None
    deleted: bool | None = False
    tag: str | None = None
    after: str | None = None
    limit: int | None = None


FIRST = "0" * 64  # what the first operation of a site follows

HASHED = ("actor", "at_ns", "body", "lamport", "op_uuid", "seq", "site", "target_op", "verb")


def canonical_json(value: object) -> bytes:
    """Return UTF-8 JSON with sorted keys and no spaces.

    Integers, texts, booleans, null, arrays and objects only: a float raises ``TypeError``.
    """
    _refuse_floats(value)
    return _encoded(value)


def content_hash(value: object) -> str:
    """Return the SHA-256 of the canonical JSON, in hex."""
    return sha256(canonical_json(value)).hexdigest()


def operation_hash(operation: Operation) -> str:
    """Return the hash that ``operation`` must carry, in hex."""
    content = {name: getattr(operation, name) for name in HASHED}
    # Without a search for floats: storing an operation refuses them, and checking 100,000 is quick.
    return sha256(bytes.fromhex(operation.prev_hash) + _encoded(content)).hexdigest()


def first_broken_link(operations: Iterable[Operation]) -> int | None:
    """Return the sequence number of the first bad link of one site in order, or None."""
    previous, expected = FIRST, 1
    for operation in operations:
        whole = operation.seq == expected and operation.prev_hash == previous
        if not whole or operation_hash(operation) != operation.hash:
            return expected
        previous, expected = operation.hash, expected + 1
    return None


def _encoded(value: object) -> bytes:
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return text.encode("utf-8")


def _refuse_floats(value: object) -> None:
    if isinstance(value, float):
        raise TypeError("a number with a fraction is never hashed: write it as text or in µm")
    if isinstance(value, dict):
        for item in value.values():
            _refuse_floats(item)
    elif isinstance(value, list | tuple):
        for item in value:
            _refuse_floats(item)

"""Values of the catalogue: labels and their revisions, operations, entries of episodes.

Lengths are whole µm and angles whole mdeg, because they are hashed: a float has no one spelling.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from backend.core.flow import EpisodeQuality, FloatArray

Source = str
"""``commanded``, ``measured``, ``human`` or ``model:<sha256 of the weights>``; of several models
the hashes are joined by ``+``."""

LabelState = Literal["unlabelled", "draft", "submitted", "approved", "rejected", "superseded"]
Verdict = Literal["stable", "unstable", "unsure"]
FileState = Literal["complete", "missing", "damaged", "quarantined"]

PROGRAM = "program"
"""The actor of what no person did. It may store drafts, never submit or review them."""

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
class Content:
    """What a revision says, apart from where it stands in the history."""

    label: Label
    source: Source
    geometry: str
    verdict: Verdict | None = None
    note: str = ""

    @classmethod
    def of(cls, revision: Revision) -> Content:
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
class Looked:
    """How a person came to an answer: time spent in ms (pauses left out); model hidden or not."""

    seen_ms: int
    blind: bool = False


@dataclass(frozen=True, slots=True)
class Step:
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

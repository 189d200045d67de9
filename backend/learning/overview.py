"""What a training would be given: episodes per pair on each side of the split, and what leaks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from backend.catalogue.database import NAME, Database
from backend.catalogue.training_set import LabelChoice, is_dataset, labelled
from backend.core.faults import InputError
from backend.dataset.channels import LABEL, unpack_json
from backend.dataset.contents import explained, read_groups
from backend.dataset.rows import find_packs
from backend.dataset.splits import MIN_MOUNTINGS, Split, split_grips, split_series

FEW = 30
"""A share measured on fewer episodes is uncertain by more than 0.18 (95 %)."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """One episode that could be trained on. ``content``: hash of its signals, "" if not known."""

    piece: str
    bottom: str
    grip_id: str
    mounting_id: str
    content: str = ""


@dataclass(frozen=True, slots=True)
class PairCount:
    """Episodes of one pair on each side."""

    piece: str
    bottom: str
    train: int
    held_out: int


@dataclass(frozen=True, slots=True)
class Overview:
    """The training set of one piece. ``warnings``: sentences; ``error``: why it cannot be split."""

    pieces: tuple[str, ...]
    piece: str
    pairs: tuple[PairCount, ...] = ()
    kept_together: str = ""
    warnings: tuple[str, ...] = ()
    error: str = ""

    @property
    def train(self) -> int:
        """Number of episodes to train on."""
        return sum(pair.train for pair in self.pairs)

    @property
    def held_out(self) -> int:
        """Number of episodes for validation."""
        return sum(pair.held_out for pair in self.pairs)


def candidates(data: Path, labels: LabelChoice) -> list[Candidate]:
    """Return all usable episodes of a dataset, or of a folder of packs; raises ``InputError``."""
    if not is_dataset(data):
        return list(_in_packs(data))
    database = Database.open(data / NAME, write=False)
    try:
        listed = labelled(database, labels)
    finally:
        database.close()
    return [Candidate(e.piece, e.bottom, e.grip_id, e.mounting_id, e.row.sha256) for e in listed]


def overview(
    found: Sequence[Candidate],
    piece: str,
    share: float,
    seed: int,
    *,
    divide_series: bool = False,
) -> Overview:
    """Return the sides of ``piece`` ("": the commonest) as ``Trainer`` would split them."""
    counts = Counter(one.piece for one in found)
    pieces = tuple(sorted(counts))
    if not counts:
        return Overview((), "", error="No episode has a label that counts.")
    chosen = piece if piece in counts else counts.most_common(1)[0][0]
    mine = [one for one in found if one.piece == chosen]
    bottoms = sorted({one.bottom for one in mine})
    mountings = [one.mounting_id for one in mine]
    try:
        if divide_series:
            split = split_grips(mountings, [one.grip_id for one in mine], share, seed)
        else:
            names = [f"{one.piece} on {one.bottom}" for one in mine]
            split = split_series(mountings, names, share, seed)
    except InputError as error:
        pairs = tuple(PairCount(chosen, b, sum(o.bottom == b for o in mine), 0) for b in bottoms)
        return Overview(pieces, chosen, pairs, error=f"{error.what} {error.fix}")
    pairs = tuple(_pair(mine, split, bottom) for bottom in bottoms)
    return Overview(
        pieces, chosen, pairs, split.kept_together, tuple(_warnings(mine, split, pairs))
    )


def _pair(mine: Sequence[Candidate], split: Split, bottom: str) -> PairCount:
    here = np.array([one.bottom == bottom for one in mine])
    train, held_out = int(here[split.train].sum()), int(here[split.held_out].sum())
    return PairCount(mine[0].piece, bottom, train, held_out)


def _warnings(mine: Sequence[Candidate], split: Split, pairs: Sequence[PairCount]) -> Iterator[str]:
    train = [mine[i] for i in split.train.tolist()]
    held_out = [mine[i] for i in split.held_out.tolist()]
    shared = _series(train) & _series(held_out)
    if shared:
        words = "1 series is" if len(shared) == 1 else f"{len(shared)} series are"
        yield (
            f"Leakage: {words} on both sides, so validation knows their errors. From "
            f"{MIN_MOUNTINGS} mountings on, whole mountings are held out."
        )
    seen = {one.content for one in train} - {""}
    copies = sum(one.content in seen for one in held_out)
    if copies:
        words = "1 episode is" if copies == 1 else f"{copies} episodes are"
        yield f"Leakage: {words} held out of which training has a copy."
    lacking = [pair.bottom for pair in pairs if pair.train == 0]
    if lacking:
        yield f"All episodes of {', '.join(lacking)} are held out: none is trained on."
    unmeasured = [pair.bottom for pair in pairs if pair.held_out == 0]
    if unmeasured:
        yield f"No episode of {', '.join(unmeasured)} is held out: nothing is measured on it."
    if 0 < len(held_out) < FEW:
        few = "1 episode is" if len(held_out) == 1 else f"{len(held_out)} episodes are"
        yield f"Only {few} held out: what they measure is uncertain."


def _series(some: Sequence[Candidate]) -> set[tuple[str, str]]:
    return {(one.mounting_id, one.bottom) for one in some}


def _in_packs(folder: Path) -> Iterator[Candidate]:
    for path in find_packs(folder):
        with explained(path):
            for group in read_groups(path):
                for message in group.messages.get(LABEL.name, ()):
                    label = unpack_json(message)
                    names = ("piece", "bottom", "grip_id", "mounting_id")
                    yield Candidate(*(str(label.get(name, "")) for name in names))

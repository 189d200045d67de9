"""Composition of a training set: benches, pairs, sides of the split, leaks.

The manifest lists every episode.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from touchdown.backend.annotations import (
    CATALOGUE_FILE,
    Database,
    LabelChoice,
    is_dataset,
    labelled_episodes,
)
from touchdown.backend.config import BenchDescription, SimulationSettings, describe_simulation
from touchdown.backend.core import InputError
from touchdown.backend.episodes import (
    LABEL_TOPIC,
    MIN_MOUNTINGS,
    Split,
    TrainingRows,
    divided_indices,
    find_packs,
    input_errors,
    read_chunks,
    read_first,
    split_grips,
    split_series,
    unpack_json,
)

MANIFEST = "manifest.json"
SIMULATED_MODES = frozenset({"emulated", "live simulation", "stepped", "mass"})
_NAMED = ("episode", "revision", "file_sha256", "x_um", "y_um", "bottom", "grip_id", "mounting_id")


def training_manifest(rows: TrainingRows, split: Split) -> bytes:
    """Return the manifest as JSON; equal episodes, labels and sides give equal bytes."""
    held_out = set(split.held_out.tolist())
    episodes = [
        {name: label[name] for name in _NAMED if name in label}
        | {"split": "held out" if i in held_out else "train"}
        for i, label in enumerate(rows.labels)
    ]
    content: dict[str, object] = {
        "version": 1,
        "format": "training-set",
        "piece": rows.piece,
        "geometry": rows.geometry,
        "kept_together": split.kept_together,
        "episodes": episodes,
    }
    sides = [str(one["split"]) for one in episodes]
    leaks = len(divided_indices(sides, list(zip(rows.mounting_id, rows.bottom, strict=True))))
    if leaks:
        content["warnings"] = [
            f"Leakage: {leaks} episodes share mounting and bottom with the other side, so "
            "validation knows their errors."
        ]
    return json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False).encode() + b"\n"


def only_simulated(rows: TrainingRows) -> bool:
    """Return True if no episode was recorded on a real bench (packs are always simulated)."""
    return all(label.get("mode", "mass") in SIMULATED_MODES for label in rows.labels)


def read_benches(data: Path, rows: TrainingRows) -> tuple[BenchDescription, ...]:
    """Return the distinct benches of ``rows``, reading one file per mounting."""
    if is_dataset(data):
        named = (label.get("file") for label in rows.labels)
        per_mounting = dict(zip(rows.mounting_id, named, strict=True))
        files = sorted({data / str(name) for name in per_mounting.values() if name})
    else:
        files = find_packs(data)
    found = {
        facts.model_dump_json(): facts for path in files if (facts := _facts(path)) is not None
    }
    return tuple(facts for _, facts in sorted(found.items()))


def _facts(path: Path) -> BenchDescription | None:
    """Return the bench record of a pack or an episode file, None if there is none."""
    try:
        records = read_first(path).metadata
    except InputError:
        # The signals come from the cache; only the origin stays unknown.
        return None
    settings = records.get("pack", {}).get("settings")
    facts = records.get("bench", {}).get("facts")
    try:
        if settings is not None:
            return describe_simulation(SimulationSettings.model_validate_json(settings))
        return None if facts is None else BenchDescription.model_validate_json(facts)
    except ValidationError:
        return None


FEW = 30  # below this number the 95 % interval of a share exceeds 0.18


@dataclass(frozen=True, slots=True)
class TrainingCandidate:
    """One episode that can be used for training. ``content``: hash of its signals, or ""."""

    piece: str
    bottom: str
    grip_id: str
    mounting_id: str
    content: str = ""


@dataclass(frozen=True, slots=True)
class PairSplit:
    """Numbers of episodes of one pair on each side."""

    piece: str
    bottom: str
    train: int
    held_out: int


@dataclass(frozen=True, slots=True)
class TrainingSetOverview:
    """Training set of one piece.

    ``warnings``: sentences; ``error``: reason why it cannot be split.
    """

    pieces: tuple[str, ...]
    piece: str
    pairs: tuple[PairSplit, ...] = ()
    kept_together: str = ""
    warnings: tuple[str, ...] = ()
    error: str = ""

    @property
    def train(self) -> int:
        """Number of training episodes."""
        return sum(pair.train for pair in self.pairs)

    @property
    def held_out(self) -> int:
        """Number of validation episodes."""
        return sum(pair.held_out for pair in self.pairs)


def training_candidates(data: Path, labels: LabelChoice) -> list[TrainingCandidate]:
    """Return all usable episodes of a dataset or folder of packs; raises ``InputError``."""
    if not is_dataset(data):
        return list(_in_packs(data))
    with closing(Database.open(data / CATALOGUE_FILE, write=False)) as database:
        listed = labelled_episodes(database, labels)
    return [
        TrainingCandidate(e.piece, e.bottom, e.grip_id, e.mounting_id, e.row.sha256) for e in listed
    ]


def training_set_overview(
    found: Sequence[TrainingCandidate],
    piece: str,
    share: float,
    seed: int,
    *,
    divide_series: bool = False,
) -> TrainingSetOverview:
    """Return the sides of ``piece`` ("": the most frequent one), split as by ``Trainer``."""
    counts = Counter(one.piece for one in found)
    pieces = tuple(sorted(counts))
    if not counts:
        return TrainingSetOverview((), "", error="No episode has a label that counts.")
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
        pairs = tuple(PairSplit(chosen, b, sum(o.bottom == b for o in mine), 0) for b in bottoms)
        return TrainingSetOverview(pieces, chosen, pairs, error=f"{error.what} {error.fix}")
    train, held_out = (
        Counter(mine[i].bottom for i in side.tolist()) for side in (split.train, split.held_out)
    )
    pairs = tuple(PairSplit(chosen, name, train[name], held_out[name]) for name in bottoms)
    return TrainingSetOverview(
        pieces, chosen, pairs, split.kept_together, tuple(_warnings(mine, split, pairs))
    )


def _warnings(
    mine: Sequence[TrainingCandidate], split: Split, pairs: Sequence[PairSplit]
) -> Iterator[str]:
    train = [mine[i] for i in split.train.tolist()]
    held_out = [mine[i] for i in split.held_out.tolist()]
    series = [{(one.mounting_id, one.bottom) for one in side} for side in (train, held_out)]
    shared = series[0] & series[1]
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
        yield f"Leakage: {words} on the validation side with a copy in training."
    lacking = [pair.bottom for pair in pairs if pair.train == 0]
    if lacking:
        yield f"All episodes of {', '.join(lacking)} are held out: none is trained on."
    unmeasured = [pair.bottom for pair in pairs if pair.held_out == 0]
    if unmeasured:
        yield f"No episode of {', '.join(unmeasured)} is held out: nothing is measured on it."
    if 0 < len(held_out) < FEW:
        few = "1 episode is" if len(held_out) == 1 else f"{len(held_out)} episodes are"
        yield f"Only {few} held out: what they measure is uncertain."


def _in_packs(folder: Path) -> Iterator[TrainingCandidate]:
    for path in find_packs(folder):
        with input_errors(path):
            for chunk in read_chunks(path):
                for message in chunk.contents.messages.get(LABEL_TOPIC.name, ()):
                    label = unpack_json(message)
                    names = ("piece", "bottom", "grip_id", "mounting_id")
                    yield TrainingCandidate(*(str(label.get(name, "")) for name in names))

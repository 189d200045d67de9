"""The labelled episodes of a dataset as rows to train on, through the training cache.

Of each episode the latest approved label counts. Rejected, conflicting, deleted and quarantined
episodes, and those that failed their quality checks, are never used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from backend.catalogue.cache import CacheRow, open_cache
from backend.catalogue.database import NAME, Database
from backend.catalogue.geometry import GeometryStore, Pair, face_record
from backend.catalogue.values import Label
from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.dataset.rows import TrainingRows
from backend.objects.catalogue import Piece, load_catalogue
from backend.objects.surface import face_points, true_patch

LabelChoice = Literal["approved", "submitted", "drafts"]
"""``submitted`` adds labels that wait for review; ``drafts`` also what a simulated bench noted."""
LABEL_CHOICES: tuple[LabelChoice, ...] = get_args(LabelChoice)

_QUERY = """
SELECT e.uuid, e.sha256, e.path, e.chunk_off, e.chunk_len, e.piece, e.bottom, e.grip_id,
    e.mounting_id, e.mode, r.rev_uuid, r.x_um, r.y_um, r.theta_mdeg, r.sigma_um, r.source,
    r.geometry
FROM episode e JOIN label_head h ON h.episode = e.uuid
JOIN label_rev r ON r.rev_uuid = {revision}
WHERE e.state = 'complete' AND e.accepted AND NOT h.conflict AND NOT h.deleted
    AND h.state != 'rejected' AND r.x_um IS NOT NULL AND ({allowed})
ORDER BY e.uuid
"""
_WAITING = "h.state = 'submitted'"
_NOTED = (
    "h.state = 'draft' AND e.mode IN ('live simulation', 'stepped', 'mass')"
    " AND r.source IN ('commanded', 'measured')"
)


@dataclass(frozen=True, slots=True)
class Labelled:
    """One episode and the label revision that counts for it."""

    row: CacheRow
    label: Label
    source: str
    piece: str
    bottom: str
    grip_id: str
    mounting_id: str
    mode: str


def is_dataset(folder: Path) -> bool:
    """Whether ``folder`` is a dataset (and not a folder of packs)."""
    return (folder / NAME).is_file()


def load_training_set(
    folder: Path,
    piece: str | None = None,
    labels: LabelChoice = "approved",
    advance: Callable[[int], None] = lambda done: None,
) -> TrainingRows:
    """Return the labelled episodes of ``piece`` (None: the only one) in the dataset ``folder``.

    Reads beside a writer. ``advance`` gets the number of episodes copied into the cache, if it has
    to be built. Raises ``InputError`` if there are none, or if they belong to several pieces.
    """
    database = Database.open(folder / NAME, write=False)
    try:
        listed = labelled(database, labels)
    finally:
        database.close()
    chosen = _of_one_piece(listed, piece, folder, labels)
    pairs = {e.row.pair: None for e in chosen}
    store = GeometryStore(folder / "geometry")
    geometry = {name: store.pair(name) for name in pairs}
    top = load_catalogue().piece(chosen[0].piece)
    _check_face(top, geometry.values(), folder)
    cache = open_cache(folder, [e.row for e in chosen], advance=advance)
    return TrainingRows(
        top.name,
        top.sha256,
        cache.observation,
        np.stack([e.label.offset_mm for e in chosen]),
        _patches(chosen, geometry, face_points(top.face)),
        tuple(e.bottom for e in chosen),
        tuple(e.grip_id for e in chosen),
        tuple(e.mounting_id for e in chosen),
        tuple(_facts(e) for e in chosen),
        fetch=cache.batch,
    )


def labelled(database: Database, labels: LabelChoice) -> list[Labelled]:
    """Return the usable episodes with the labels that count, by uuid."""
    revision, allowed = "h.counting", "1"
    if labels != "approved":
        also = _WAITING if labels == "submitted" else f"{_WAITING} OR ({_NOTED})"
        # What was approved once counts until the new version is.
        revision = "coalesce(h.counting, h.rev_uuid)"
        allowed = f"h.counting IS NOT NULL OR {also}"
    rows = database.rows(_QUERY.format(revision=revision, allowed=allowed))
    return [_labelled(row) for row in rows]


def _labelled(row: Sequence[Any]) -> Labelled:
    uuid, sha256, path, offset, length, piece, bottom, grip, mounting, mode = row[:10]
    revision, x_um, y_um, theta_mdeg, sigma_um, source, pair = row[10:]
    chunk = None if offset is None else (offset, length)
    cached = CacheRow(uuid, sha256, revision, path, chunk, x_um, y_um, pair)
    label = Label(x_um, y_um, theta_mdeg, sigma_um)
    return Labelled(cached, label, source, piece, bottom, grip, mounting, mode)


def _of_one_piece(
    listed: Sequence[Labelled], piece: str | None, folder: Path, labels: LabelChoice
) -> list[Labelled]:
    found = sorted({e.piece for e in listed})
    if not found:
        further = LABEL_CHOICES[LABEL_CHOICES.index(labels) + 1 :]
        fix = "Label and approve some"
        fix += f", or allow more with --labels {' or '.join(further)}." if further else "."
        raise InputError("No episode has a label to train on.", str(folder), fix)
    if piece is None and len(found) > 1:
        raise InputError(
            f"The episodes belong to different grasped pieces ({', '.join(found)}).",
            str(folder),
            "Name one with --piece.",
        )
    chosen = [e for e in listed if e.piece == (piece or found[0])]
    if not chosen:
        raise InputError(
            f"There are no labelled episodes of '{piece}' here, only of {', '.join(found)}.",
            str(folder),
            "Choose one of these pieces.",
        )
    return chosen


def _check_face(piece: Piece, pairs: Iterable[Pair], folder: Path) -> None:
    """Raise ``InputError`` unless all labels refer to the face of ``piece``."""
    face = face_record(piece.face)
    if any(face_record(pair.face) != face for pair in pairs):
        raise InputError(
            f"Some labels refer to another face than that of the piece '{piece.name}'.",
            str(folder),
            "Move them to the corrected geometry by a bulk operation.",
        )


def _patches(
    chosen: Sequence[Labelled], pairs: Mapping[str, Pair], points: FloatArray
) -> NDArray[np.bool_]:
    """(n, N) true patches over ``points`` (N, 2), derived per pair and rotation at once."""
    patch = np.zeros((len(chosen), len(points)), dtype=np.bool_)
    offset: FloatArray = np.stack([e.label.offset_mm for e in chosen])
    groups: dict[tuple[str, int], list[int]] = {}
    for i, e in enumerate(chosen):
        groups.setdefault((e.row.pair, e.label.theta_mdeg or 0), []).append(i)
    for (name, theta_mdeg), index in groups.items():
        yaw_rad = math.radians(theta_mdeg / 1e3)
        patch[index] = true_patch(points, offset[index], pairs[name].bottom, yaw_rad)
    return patch


def _facts(e: Labelled) -> dict[str, object]:
    return {
        "episode": e.row.episode,
        "revision": e.row.revision,
        "x_um": e.label.x_um,
        "y_um": e.label.y_um,
        "sigma_um": e.label.sigma_um,
        "source": e.source,
        "piece": e.piece,
        "bottom": e.bottom,
        "grip_id": e.grip_id,
        "mounting_id": e.mounting_id,
        "mode": e.mode,
        "file": e.row.path,
        "file_sha256": e.row.sha256,
    }

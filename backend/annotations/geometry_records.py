"""Immutable geometry records (face, grid, pair), named by their hash.

True contact patches are derived from them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchdown.backend import geometry
from touchdown.backend.annotations.values import Label, canonical_json, content_hash
from touchdown.backend.core import FloatArray, InputError, parse_json, write_atomically

VERSION = 1
GRID_UM = 1000
# Rule 1: a face point is in contact if it lies inside the bottom outline or on its edge.
INSIDE_OR_ON_EDGE = 1

Record = dict[str, object]


@dataclass(frozen=True, slots=True)
class TruePatch:
    """Face points in contact, from geometry and label.

    ``points_mm`` (N, 2) in the face frame; ``touching`` (N,) bool; ``centre_mm``: projection of the
    centre of mass on the face.
    """

    points_mm: FloatArray
    touching: NDArray[np.bool_]
    centre_mm: geometry.Point


@dataclass(frozen=True)
class Pair:
    """Geometry of a grasped face above a bottom face."""

    sha256: str
    face: geometry.Outline
    bottom: geometry.Outline
    centre_mm: geometry.Point
    pitch_mm: float

    @cached_property
    def points_mm(self) -> FloatArray:
        """(N, 2) lattice of the grasped face; read-only."""
        points = geometry.face_points(self.face, self.pitch_mm)
        points.flags.writeable = False
        return points


def face_record(outline: geometry.Outline, com_xy_mm: geometry.Point = (0.0, 0.0)) -> Record:
    """Return the record of a face; ``com_xy_mm``: centre of mass relative to the face's centre."""
    record: Record = {"kind": "face", "v": VERSION, "com_um": [_um(value) for value in com_xy_mm]}
    if outline.kind == "circle":
        return record | {"shape": "circle", "d_um": _um(2 * outline.radius_mm)}
    if outline.kind == "region":
        parts = [
            {"exterior": _ring_um(exterior), "holes": [_ring_um(hole) for hole in holes]}
            for exterior, holes in outline.parts
        ]
        return record | {"shape": "region", "parts_um": parts}
    return record | {"shape": "polygon", "vertices_um": _ring_um(outline.vertices_mm)}


# Square lattice through the face's centre.
GRID: Record = {"kind": "grid", "v": VERSION, "pitch_um": GRID_UM, "origin_um": [0, 0]}


def pair_records(piece: geometry.Piece, bottom: geometry.Piece) -> dict[str, Record]:
    """Return the records of ``piece`` above ``bottom`` by hash; the pair comes last.

    Raises ``InputError`` if the centre of mass of ``piece`` is unknown.
    """
    if not piece.com_known:
        what = f"The centre of mass of '{piece.name}' is unknown, but labels of stability need it."
        raise InputError(what, piece.source, "Enter com_xy_mm in the piece file.")
    parts = [face_record(piece.face, piece.com_xy_mm), face_record(bottom.face), GRID]
    face, below, grid = (content_hash(part) for part in parts)
    pair: Record = {"kind": "pair", "v": VERSION, "rule": INSIDE_OR_ON_EDGE}
    pair |= {"face": face, "bottom": below, "grid": grid}
    return dict(zip((face, below, grid, content_hash(pair)), (*parts, pair), strict=True))


class GeometryStore:
    """Folder ``geometry`` of a dataset. Reads are cached, since records never change."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.patch: Callable[[str, Label], TruePatch] = lru_cache(maxsize=4096)(self._patch)
        self.pair: Callable[[str], Pair] = lru_cache(maxsize=256)(self._pair)

    def store_pair(self, piece: geometry.Piece, bottom: geometry.Piece) -> str:
        """Write the missing records of a pair; return the hash of the pair."""
        records = pair_records(piece, bottom)
        for name, record in records.items():
            path = self.folder / f"{name}.json"
            if not path.exists():
                write_atomically(path, canonical_json(record))
        return list(records)[-1]

    def read(self, sha256: str) -> Mapping[str, Any]:
        """Return one record; raises ``InputError`` if it is missing or its hash is wrong."""
        path = self.folder / f"{sha256}.json"
        try:
            record = parse_json(path.read_bytes())
            whole = content_hash(record) == sha256
        except OSError as error:
            raise _bad(path, "is missing") from error
        except (ValueError, TypeError) as error:
            raise _bad(path, "is damaged") from error
        if not whole or not isinstance(record, dict):
            raise _bad(path, "is not what its name says")
        return record

    def _pair(self, sha256: str) -> Pair:
        """Return a pair by its hash; raises ``InputError`` if it is missing or changed."""
        record = self.read(sha256)
        path = self.folder / f"{sha256}.json"
        if record.get("kind") != "pair" or record.get("rule") != INSIDE_OR_ON_EDGE:
            raise _bad(path, "is no pair of faces that this version knows")
        face, bottom = self.read(record["face"]), self.read(record["bottom"])
        grid = self.read(record["grid"])
        try:
            x, y = face["com_um"]
            pitch_mm = grid["pitch_um"] / 1e3
            return Pair(sha256, _outline(face), _outline(bottom), (x / 1e3, y / 1e3), pitch_mm)
        except (KeyError, TypeError, ValueError) as error:
            raise _bad(path, f"cannot be used: {error}") from error

    def _patch(self, sha256: str, label: Label) -> TruePatch:
        """Return the true patch of ``label`` for the pair ``sha256``; empty without offset."""
        pair = self.pair(sha256)
        if not label.is_set:
            touching = np.zeros(len(pair.points_mm), dtype=np.bool_)
        else:
            yaw_rad = math.radians((label.theta_mdeg or 0) / 1e3)
            touching = geometry.true_patch(pair.points_mm, label.offset_mm, pair.bottom, yaw_rad)
        touching.flags.writeable = False
        return TruePatch(pair.points_mm, touching, pair.centre_mm)


def _outline(record: Mapping[str, Any]) -> geometry.Outline:
    if record["shape"] == "circle":
        return geometry.circle(record["d_um"] / 1e3)
    if record["shape"] == "region":
        return geometry.region(
            (_ring_mm(part["exterior"]), [_ring_mm(hole) for hole in part["holes"]])
            for part in record["parts_um"]
        )
    return geometry.convex_polygon(_ring_mm(record["vertices_um"]))


def _ring_um(ring: Sequence[geometry.Point]) -> list[list[int]]:
    return [[_um(x), _um(y)] for x, y in ring]


def _ring_mm(ring_um: Sequence[Sequence[int]]) -> tuple[geometry.Point, ...]:
    return tuple((x / 1e3, y / 1e3) for x, y in ring_um)


def _um(value_mm: float) -> int:
    return round(value_mm * 1e3)


def _bad(path: Path, what: str) -> InputError:
    return InputError(
        f"A geometry record {what}.", str(path), "Restore it from another copy of the dataset."
    )

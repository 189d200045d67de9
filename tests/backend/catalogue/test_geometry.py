"""Geometry records by hash, and patches derived from them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import Record
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.geometry_records import GeometryStore, face_record, pair_records
from touchdown.backend.annotations.values import Label, content_hash
from touchdown.backend.core.faults import InputError
from touchdown.backend.geometry.outlines import circle, face_points, true_patch
from touchdown.backend.geometry.pieces import Piece, load_pieces

PIECES = load_pieces()


def disc(name: str = "circle15") -> Piece:
    return PIECES.piece(name)


def test_the_published_record_of_a_circle() -> None:
    expected = "1e539dbc6c5b2a1e36adca9ca8496f7049f62f099342ac2d4a8439cee539303b"
    assert content_hash(face_record(circle(15.0))) == expected


def test_the_published_counts_of_points_in_contact(tmp_path: Path) -> None:
    store = GeometryStore(tmp_path)
    pair = store.store_pair(disc(), disc())
    for x_um, y_um, touching in ((0, 0, 177), (5000, 0, 102), (8000, 0, 63), (15001, 0, 0)):
        patch = store.patch(pair, Label(x_um, y_um, 0, 0))
        assert len(patch.points_mm) == 177
        assert int(patch.touching.sum()) == touching
    assert not store.patch(pair, Label()).touching.any()


@pytest.mark.parametrize("piece", PIECES.tops)
@pytest.mark.parametrize("bottom", PIECES.bottoms)
def test_a_patch_from_records_equals_one_from_the_pieces(
    tmp_path: Path, piece: str, bottom: str
) -> None:
    store = GeometryStore(tmp_path)
    top, below = PIECES.top(piece), PIECES.bottom(bottom)
    pair = store.store_pair(top, below)
    points = face_points(top.face)
    rng = np.random.default_rng(5)
    for x, y, theta in rng.integers(-12000, 12000, (20, 3)).tolist():
        found = store.patch(pair, Label(x, y, theta, 0))
        offset = np.array([x, y]) / 1e3
        expected = true_patch(points, offset, below.face, np.radians(theta / 1e3))
        assert np.array_equal(found.points_mm, points)
        # Corners are kept to 1 µm: only a point that near to an edge may differ.
        assert int(np.sum(found.touching != expected)) <= 1
    assert found.centre_mm == pytest.approx(top.com_xy_mm, abs=5e-4)


def test_a_corrected_dimension_is_another_pair_and_changes_nothing_old(tmp_path: Path) -> None:
    store = GeometryStore(tmp_path)
    old = store.store_pair(disc(), disc())
    before = store.patch(old, Label(5000, 0, 0, 0)).touching.copy()
    new = store.store_pair(disc(), replace(disc(), face=circle(14.0)))
    assert new != old
    assert int(store.patch(new, Label(5000, 0, 0, 0)).touching.sum()) < before.sum()
    assert np.array_equal(GeometryStore(tmp_path).patch(old, Label(5000, 0, 0, 0)).touching, before)
    assert store.store_pair(disc(), disc()) == old
    assert len(list(tmp_path.glob("*.json"))) == 5


def test_a_changed_missing_or_foreign_record_is_named(tmp_path: Path) -> None:
    store = GeometryStore(tmp_path)
    records = pair_records(disc(), disc("square15"))
    pair = store.store_pair(disc(), disc("square15"))
    face = next(iter(records))
    with pytest.raises(InputError, match="no pair"):
        store.pair(face)
    path = tmp_path / f"{face}.json"
    content = path.read_bytes()
    path.write_bytes(content.replace(b"15000", b"15001"))
    with pytest.raises(InputError, match="not what its name says"):
        store.pair(pair)
    path.write_bytes(b"{")
    with pytest.raises(InputError, match="damaged"):
        store.pair(pair)
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        store.pair(pair)
    path.write_bytes(content)
    assert store.pair(pair).face == circle(15.0)


def test_the_patch_of_an_episode_follows_its_label(dataset: Dataset, record: Record) -> None:
    entry = record(0, 0)
    whole = dataset.patch(entry.uuid)
    dataset.labels.set("ann", entry.uuid, Label(14000, 0, 0, 100))
    moved = dataset.patch(entry.uuid)
    assert 0 < moved.touching.sum() < whole.touching.sum()
    dataset.labels.undo("ann")
    assert dataset.patch(entry.uuid) is whole

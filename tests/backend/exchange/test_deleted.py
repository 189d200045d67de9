"""Deleted episodes: absent from new exports, present in old ones, restored with the same ids."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

from tests.backend.exchange.conftest import Hand
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.exchange.manifest import read_manifest


def contents(folder: Path) -> dict[str, str]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(p.relative_to(folder)): sha256(p.read_bytes()).hexdigest() for p in files}


def uuids(folder: Path) -> list[str]:
    manifest = read_manifest(folder)
    assert manifest is not None
    return sorted(str(one["uuid"]) for one in manifest["episodes"])


def test_delete_export_and_undo(dataset: Dataset, hand: Hand) -> None:
    raw = {e.uuid: dataset.path(e.uuid).read_bytes() for e in dataset.episodes()}
    first = hand("csv", "first").folder
    gone, before = uuids(first)[1], contents(first)
    dataset.labels.delete("ann", gone, "disturbed")
    second = hand("csv", "second").folder
    assert uuids(second) == [uuid for uuid in uuids(first) if uuid != gone]
    dataset.labels.undo("ann")
    assert {e.uuid: dataset.path(e.uuid).read_bytes() for e in dataset.episodes()} == raw
    assert uuids(hand("csv", "third").folder) == uuids(first)
    assert contents(first) == before  # an export that was made stays what it was

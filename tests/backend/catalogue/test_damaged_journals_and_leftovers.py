"""What a start does with forged links, unreadable journals and the rests of a crash."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import Record
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import OperationJournal
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.values import (
    FIRST_HASH,
    EpisodeFilter,
    Label,
    Operation,
    first_broken_link,
    operation_hash,
)
from touchdown.backend.episodes.packs import PackedEpisode, PackWriter
from touchdown.backend.episodes.training_rows import patch_hex
from touchdown.backend.geometry.outlines import face_points
from touchdown.backend.geometry.pieces import load_pieces


def linked(count: int, previous: str = FIRST_HASH, seq: int = 1) -> list[Operation]:
    made: list[Operation] = []
    for number in range(seq, seq + count):
        body = {"closes": [], "revs": [], "note": f"n{number}"}
        operation = Operation(
            f"op-{number}", "A", number, number, 17 * number, "ann", "tag", None, body, previous, ""
        )
        made.append(replace(operation, hash=operation_hash(operation)))
        previous = made[-1].hash
    return made


@pytest.mark.parametrize("previous", ["00" * 32, "ff" * 32])
def test_a_link_to_another_past_is_found_though_its_own_hash_is_right(previous: str) -> None:
    whole = linked(3)
    assert first_broken_link(whole) is None
    forged = linked(1, previous, seq=2)[0]
    assert operation_hash(forged) == forged.hash
    assert first_broken_link([whole[0], forged]) == 2


def journal_of(dataset: Dataset, record: Record) -> tuple[OperationJournal, Path, list[bytes]]:
    """Return a fresh view of the journal after three labels, its file, and its lines."""
    uuid = record().uuid
    for x_um in (100, 200, 300):
        dataset.labels.set("ann", uuid, Label(x_um, 5, 0, 9))
    journal = OperationJournal(dataset.folder / "labels")
    path = journal.path(dataset.description.site)
    return journal, path, path.read_bytes().splitlines(keepends=True)


def test_a_journal_that_ends_well_gets_nothing_twice(dataset: Dataset, record: Record) -> None:
    journal, path, lines = journal_of(dataset, record)
    damaged = b"".join([lines[0], b"?\n", *lines[2:]])
    path.write_bytes(damaged)
    with dataset.database.transaction() as connection:
        assert journal.catch_up(connection, dataset.description.site) == 0
    assert path.read_bytes() == damaged


def test_a_last_line_without_a_number_is_no_obstacle(dataset: Dataset, record: Record) -> None:
    journal, path, lines = journal_of(dataset, record)
    path.write_bytes(b"".join(lines[:-1]) + b"{}\n")
    with dataset.database.transaction() as connection:
        assert journal.catch_up(connection, dataset.description.site) == 1
    assert path.read_bytes() == b"".join(lines[:-1]) + b"{}\n" + lines[-1]


def test_a_part_file_stays_while_its_finished_file_is_damaged(
    dataset: Dataset, record: Record
) -> None:
    entry = record()
    final = dataset.folder / entry.path
    part = final.with_name(f".{final.name}.part")
    part.write_bytes(final.read_bytes())
    data = bytearray(final.read_bytes())
    data[len(data) // 2] ^= 1
    final.write_bytes(data)
    site = dataset.folder
    dataset.close()
    with Dataset.open(site) as opened:
        found = {finding.kind for finding in check_dataset(opened.parts, whole=True)}
    assert "left-over" not in found
    assert part.exists()


def test_packed_episodes_count_as_accepted(tmp_path: Path) -> None:
    Dataset.open(tmp_path / "data").close()
    piece = load_pieces().top("pot")
    points = len(face_points(piece.face))
    label = {
        "x_um": 1500, "y_um": -700, "sigma_um": 300, "source": "commanded", "piece": "pot",
        "bottom": "circle15", "patch": patch_hex(np.arange(points) % 2 > 0), "points": points,
        "geometry": piece.sha256, "grip_id": "g", "mounting_id": "m", "person": "cleo", "seed": 3,
    }  # fmt: skip
    with PackWriter(tmp_path / "data" / "packs" / "a.mcap", {"simulated": "true"}) as pack:
        for number in range(3):
            observation = np.full((20, 258), 0.1 * number, dtype=np.float32)
            pack.write(PackedEpisode(observation, {"episode": f"e{number}", **label}))
    with Dataset.open(tmp_path / "data") as dataset:
        assert len(dataset.episodes(EpisodeFilter(accepted=True))) == 3
        assert dataset.episodes(EpisodeFilter(accepted=False)) == []

"""Quality check of a dataset: every injected fault is found, and nothing else."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.backend.catalogue.conftest import context_for
from tests.backend.catalogue.test_packs_in_datasets import write_pack
from tests.backend.dataset.test_health import (
    jumped_marker,
    knocked,
    late_gel,
    never_touched,
    simulated,
    worse,
)
from touchdown.backend.annotations import operation_log, review
from touchdown.backend.annotations.dataset import Dataset, check_dataset_quality
from touchdown.backend.annotations.episode_index import SPLIT_TAG
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.values import Episode
from touchdown.backend.episodes.quality import ExaminedEpisode

FAULTS: dict[str, Callable[[ExaminedEpisode], ExaminedEpisode]] = {
    "jerk": knocked,
    "no contact": never_touched,
    "saturated markers": jumped_marker,
    "clock skew": late_gel,
    "lost markers": lambda row: worse(row, lost_markers=4),
    "dropped frames": lambda row: worse(row, dropped_frames=5),
    "slip": lambda row: worse(row, slip_mm=0.4),
}


def always(_done: int, _count: int) -> bool:
    return True


@pytest.fixture(scope="module")
def rows() -> list[ExaminedEpisode]:
    return simulated(30)


@pytest.fixture
def filled(dataset: Dataset, rows: list[ExaminedEpisode]) -> dict[str, str]:
    """Record the probes, each fault once; return the episode of each kind."""
    context, wrong, first = context_for(dataset, "pot", "circle25"), {}, ""
    for row, kind in zip(rows, [*FAULTS, *[""] * (len(rows) - len(FAULTS))], strict=True):
        seen = FAULTS[kind](row) if kind else row
        x_um, y_um = np.rint(1e3 * seen.offset_mm).astype(int).tolist()
        episode = Episode(row.uuid, "pot", seen.observation, seen.offset_mm, 0.5, seen.quality)
        entry = dataset.record(
            episode, Label(x_um, y_um, 0, 300), source="commanded",
            context=replace(context, mounting_id=f"m-{len(wrong)}"),
        )  # fmt: skip
        if kind:
            wrong[kind] = entry.uuid
        first = first or entry.uuid
    return wrong


def test_each_fault_is_listed(dataset: Dataset, filled: dict[str, str]) -> None:
    health = check_dataset_quality(dataset, always)
    found = {(finding.kind, finding.episodes) for finding in health.findings}
    assert found >= {(kind, (uuid,)) for kind, uuid in filled.items()}
    assert {episodes for _, episodes in found} == {(uuid,) for uuid in filled.values()}
    assert (health.examined, health.count) == (30, 30)
    early = check_dataset_quality(dataset, lambda done, _: done < 3)
    assert (early.examined, early.count) == (3, 30)


def test_a_damaged_file_is_a_finding(dataset: Dataset, filled: dict[str, str]) -> None:
    uuid = next(e.uuid for e in dataset.episodes() if e.uuid not in filled.values())
    path = dataset.path(uuid)
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 0xFF
    path.write_bytes(bytes(data))
    found = check_dataset_quality(dataset, always).findings
    assert [finding.episodes for finding in found if finding.kind == "unreadable"] == [(uuid,)]


def test_deleted_episodes_are_not_looked_at(dataset: Dataset, filled: dict[str, str]) -> None:
    dataset.labels.delete("ann", filled["jerk"], "knocked")
    health = check_dataset_quality(dataset, always)
    assert health.count == 29
    assert "jerk" not in {finding.kind for finding in health.findings}


def test_a_pair_of_a_series_on_both_sides_is_a_finding(
    dataset: Dataset, filled: dict[str, str]
) -> None:
    last = [entry for entry in dataset.episodes() if entry.mounting_id == f"m-{len(FAULTS)}"]
    with dataset.labels.commit() as connection:
        mark = operation_log.read_mark(
            connection, last[0].uuid, f"{SPLIT_TAG}held_out", present=True
        )
        draft, site = operation_log.OperationDraft(marks=[mark]), dataset.description.site
        _, touched = operation_log.append_operation(connection, site, "ann", "tag", draft)
        review.refresh_heads(connection, touched)
    found = [
        f for f in check_dataset_quality(dataset, always).findings if f.kind == "divided series"
    ]
    assert [set(finding.episodes) for finding in found] == [{entry.uuid for entry in last}]


def test_every_episode_of_a_pack_is_read(tmp_path: Path) -> None:
    Dataset.open(tmp_path / "data").close()
    write_pack(tmp_path / "data" / "packs" / "a.mcap", count=5)
    with Dataset.open(tmp_path / "data") as dataset:
        health = check_dataset_quality(dataset, always)
        jerks = {f.episodes: f.text for f in health.findings if f.kind == "jerk"}
        assert len(jerks) == 5  # random numbers: each jumps, by a length of its own
        assert len(set(jerks.values())) > 1

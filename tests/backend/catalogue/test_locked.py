"""Catalogue locked by another program: the writer waits, then fails; readers continue."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager

import pytest

from tests.backend.catalogue.conftest import context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import FaultError

LABEL = Label(0, 0, 0, 9)


@contextmanager
def held(dataset: Dataset) -> Iterator[sqlite3.Connection]:
    """Another connection with a write transaction, as of another program."""
    with closing(sqlite3.connect(dataset.database.path, isolation_level=None)) as other:
        other.execute("BEGIN IMMEDIATE")
        yield other
        if other.in_transaction:
            other.execute("ROLLBACK")


def record(dataset: Dataset) -> str:
    context = context_for(dataset)
    return dataset.record(small_episode(), LABEL, source="measured", context=context).uuid


@pytest.mark.promise("D4")
def test_a_catalogue_that_stays_locked_is_one_fault_and_nothing_is_lost(dataset: Dataset) -> None:
    first = record(dataset)
    # As long as the settings of the connection say; the test has no time for it.
    assert dataset.database.one("PRAGMA busy_timeout")[0] == 2000
    dataset.database.first("PRAGMA busy_timeout = 20")
    with held(dataset):
        with pytest.raises(FaultError) as caught:
            record(dataset)
        assert caught.value.fault.code == "CATALOGUE-BUSY"
        with pytest.raises(FaultError, match="Another program"):
            dataset.labels.set("ann", first, Label(100, 0, 0, 9))
        # Readers go on meanwhile.
        assert [entry.uuid for entry in dataset.episodes()] == [first]
        assert dataset.labels.head(first).label == LABEL
    second = record(dataset)
    dataset.labels.set("ann", first, Label(100, 0, 0, 9))
    assert [entry.uuid for entry in dataset.episodes()] == [first, second]
    assert dataset.labels.head(first).label.x_um == 100
    assert dataset.database.one("PRAGMA integrity_check") == ("ok",)


@pytest.mark.promise("D4")
def test_a_writer_waits_for_a_lock_that_is_let_go(dataset: Dataset) -> None:
    first = record(dataset)
    dataset.database.first("PRAGMA busy_timeout = 30000")
    with held(dataset) as other:
        done: list[str] = []
        writer = threading.Thread(target=lambda: done.append(record(dataset)))
        writer.start()
        # It may not write before the other one has: that is seen from outside.
        writer.join(0.1)
        assert writer.is_alive()
        assert done == []
        other.execute("ROLLBACK")
        writer.join(30.0)
    assert [entry.uuid for entry in dataset.episodes()] == [first, *done]

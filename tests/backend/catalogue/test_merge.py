"""Merging is the union of two logs: order does not matter, and conflicts are kept."""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.catalogue.conftest import context_for, small_episode
from tests.backend.catalogue.test_undo import ACTIONS, FAST, PEOPLE, Step, act, contents
from touchdown.backend.annotations import review
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import read_journal
from touchdown.backend.annotations.training_set import labelled_episodes
from touchdown.backend.annotations.values import Label
from touchdown.backend.core.faults import FaultError, InputError, RefusedError

TABLES = ("op", "label_rev", "label_head", "closed", "mark", "review", "episode")
MORE = (*(a for a in ACTIONS if a != "reopen"), "undo", "redo", "resolve")
steps = st.lists(
    st.tuples(
        st.sampled_from(MORE), st.sampled_from(PEOPLE), st.integers(0, 1), st.integers(-3, 3)
    ),
    max_size=8,
)


def tables(dataset: Dataset) -> dict[str, list[tuple[object, ...]]]:
    return {t: sorted(dataset.database.rows(f"SELECT * FROM {t}"), key=str) for t in TABLES}


def play(dataset: Dataset, todo: list[Step], uuids: list[str]) -> None:
    labels = dataset.labels
    for step in todo:
        action, person, index, number = step
        try:
            if action == "undo":
                labels.undo(person)
            elif action == "redo":
                labels.redo(person)
            elif action == "resolve":
                leaves = labels.conflicting(uuids[index])
                labels.resolve(person, uuids[index], leaves[number % len(leaves)].rev_uuid)
            else:
                act(dataset, step, [uuids[index], uuids[1 - index]])
        except RefusedError:
            continue


def begin(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        context = context_for(dataset)
        return [
            dataset.record(
                small_episode(), Label(k, -k, 0, 9), source="commanded", context=context
            ).uuid
            for k in range(2)
        ]


def merged(folder: Path, name: str, first: str, *others: str) -> Dataset:
    """Return a fresh copy of ``first`` into which the others were merged in turn."""
    shutil.copytree(folder / first, folder / name)
    dataset = Dataset.open(folder / name)
    for other in others:
        dataset.merge("zoe", folder / other)
    return dataset


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(a=steps, b=steps, c=steps, between=steps)
def test_union_is_commutative_associative_and_idempotent(
    a: list[Step], b: list[Step], c: list[Step], between: list[Step]
) -> None:
    with tempfile.TemporaryDirectory(dir=FAST) as name:
        folder = Path(name)
        uuids = begin(folder / "base")
        for site, todo in (("a", a), ("b", b), ("c", c)):
            shutil.copytree(folder / "base", folder / site)
            with Dataset.open(folder / site) as dataset:
                play(dataset, todo, uuids)
        # B goes on after it has seen A: its operations refer to those of A.
        with Dataset.open(folder / "b") as dataset:
            dataset.merge("zoe", folder / "a")
            play(dataset, between, uuids)
        with (
            merged(folder, "ab", "a", "b") as ab,
            merged(folder, "ba", "b", "a") as ba,
            merged(folder, "abc", "a", "b", "c") as abc,
            merged(folder, "cba", "c", "b", "a") as cba,
        ):
            assert tables(ab) == tables(ba)
            assert tables(abc) == tables(cba)
            before = tables(abc)
            assert abc.merge("zoe", folder / "b").operations == 0
            assert abc.merge("zoe", folder / "c").operations == 0
            assert tables(abc) == before
        with merged(folder, "bc", "b", "c") as bc:
            bc.merge("zoe", folder / "a")
            assert tables(bc) == before
            with bc.database.transaction() as connection:
                review.rebuild_heads(connection)
            assert tables(bc) == before
        with Dataset.open(folder / "abc") as again:
            assert tables(again) == before


@pytest.fixture
def copies(tmp_path: Path) -> Iterator[tuple[Dataset, Dataset, list[str]]]:
    uuids = begin(tmp_path / "a")
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    with Dataset.open(tmp_path / "a") as ours, Dataset.open(tmp_path / "b") as theirs:
        yield ours, theirs, uuids


Copies = tuple[Dataset, Dataset, list[str]]


def test_two_labels_are_a_conflict_until_a_person_resolves_it(copies: Copies) -> None:
    ours, theirs, (uuid, other) = copies
    mine = ours.labels.accept("ann", uuid, Label(100, 0, 0, 50))
    yours = theirs.labels.accept("bob", uuid, Label(900, 0, 0, 50))
    theirs.labels.accept("bob", other, Label(5, 5, 0, 50))
    done = ours.merge("ann", theirs.folder)
    assert (done.operations, done.episodes, done.conflicts) == (2, 0, (uuid,))
    assert ours.queue("conflicts", "ann") == [uuid]
    assert ours.entry(uuid).conflict
    assert ours.labels.head(other).label == Label(5, 5, 0, 50)
    assert {leaf.rev_uuid for leaf in ours.labels.conflicting(uuid)} == {
        mine.rev_uuid,
        yours.rev_uuid,
    }
    with pytest.raises(RefusedError, match="resolve"):
        ours.labels.approve("cleo", uuid)
    with pytest.raises(RefusedError, match="bob changed this label since"):
        ours.labels.undo("ann")
    conflict = contents(ours)
    resolved = ours.labels.resolve("cleo", uuid, mine.rev_uuid)
    assert (resolved.label, resolved.state) == (mine.label, "submitted")
    assert ours.labels.review_status(uuid).authors == ("ann",)
    assert ours.queue("conflicts", "ann") == []
    chosen = contents(ours)
    for _ in range(3):
        ours.labels.undo("cleo")
        assert contents(ours) == conflict
        ours.labels.redo("cleo")
        assert contents(ours) == chosen
    theirs.merge("bob", ours.folder)
    assert contents(theirs) == chosen
    ours.labels.approve("cleo", uuid)


def test_two_reviews_of_one_label_are_a_conflict_that_its_author_cannot_settle(
    copies: Copies,
) -> None:
    ours, theirs, (uuid, _) = copies
    ours.labels.accept("ann", uuid, Label(100, 0, 0, 50))
    theirs.merge("bob", ours.folder)
    approved = ours.labels.approve("bob", uuid)
    theirs.labels.reject("cleo", uuid, "tilt")
    assert ours.merge("bob", theirs.folder).conflicts == (uuid,)
    assert {leaf.state for leaf in ours.labels.conflicting(uuid)} == {"approved", "rejected"}
    assert uuid not in [one.row.episode for one in labelled_episodes(ours.database, "drafts")]
    with pytest.raises(RefusedError, match="ann wrote it"):
        ours.labels.resolve("ann", uuid, approved.rev_uuid)
    assert ours.labels.resolve("dora", uuid, approved.rev_uuid).state == "approved"
    assert [one.row.episode for one in labelled_episodes(ours.database, "approved")] == [uuid]
    ours.labels.undo("dora")
    leaves = {leaf.state: leaf.rev_uuid for leaf in ours.labels.conflicting(uuid)}
    with pytest.raises(RefusedError, match="ann wrote it"):
        ours.labels.resolve("ann", uuid, leaves["approved"])
    assert ours.labels.resolve("ann", uuid, leaves["rejected"]).state == "rejected"


def test_a_merge_that_the_disk_refuses_says_so_and_goes_on_later(
    copies: Copies, monkeypatch: pytest.MonkeyPatch
) -> None:
    ours, theirs, (uuid, _) = copies
    theirs.labels.accept("bob", uuid, Label(900, 0, 0, 50))
    new = theirs.record(
        small_episode(seed=9), Label(1, 2), source="measured", context=context_for(theirs)
    ).uuid
    before = tables(ours)

    def refuse(path: Path, content: bytes) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as full:
        full.setattr("touchdown.backend.annotations.reconciliation.write_atomically", refuse)
        with pytest.raises(FaultError, match="No space left on device") as caught:
            ours.merge("ann", theirs.folder)
    assert caught.value.fault.code == "MERGE-WRITE"
    assert tables(ours) == before
    assert ours.merge("ann", theirs.folder).operations == 2
    assert ours.read(new).episode_id == new


def test_episodes_come_with_their_files(copies: Copies) -> None:
    ours, theirs, _ = copies
    entry = theirs.record(
        small_episode(seed=9), Label(1, 2), source="measured",
        context=context_for(theirs, "barrel", "hex20"),
    )  # fmt: skip
    done = ours.merge("ann", theirs.folder)
    assert (done.episodes, done.operations) == (1, 1)
    assert ours.entry(entry.uuid) == entry
    assert ours.read(entry.uuid).episode_id == entry.uuid
    assert ours.patch(entry.uuid).touching.any()
    journal = list(read_journal(ours.journal.path(theirs.description.site)))
    assert [operation.verb for operation in journal] == ["record"]
    assert ours.database.one("SELECT actor, verb FROM event WHERE verb = 'merge'") == (
        "ann",
        "merge",
    )


def test_a_broken_or_foreign_log_changes_nothing(copies: Copies, tmp_path: Path) -> None:
    ours, theirs, (uuid, _) = copies
    theirs.labels.flag("bob", uuid)
    theirs.labels.flag("bob", uuid, False)
    with theirs.database.transaction() as connection:
        connection.execute("DROP TRIGGER op_no_update")
        connection.execute("UPDATE op SET actor = 'eve' WHERE actor = 'bob' AND seq = 1")
    before = tables(ours)
    with pytest.raises(InputError, match="broken at operation 1 of site"):
        ours.merge("ann", theirs.folder)
    begin(tmp_path / "other")
    with pytest.raises(InputError, match="another dataset"):
        ours.merge("ann", tmp_path / "other")
    with pytest.raises(InputError, match="no dataset"):
        ours.merge("ann", tmp_path / "nowhere")
    assert tables(ours) == before


def test_one_chain_continued_in_two_ways_is_refused(copies: Copies) -> None:
    ours, theirs, (uuid, _) = copies
    # A copy that was made to look as if it lay at the same place.
    theirs.labels.site = ours.description.site
    ours.labels.flag("ann", uuid)
    theirs.labels.tag("bob", uuid, "gold")
    with pytest.raises(InputError, match="differently"):
        ours.merge("ann", theirs.folder)

"""Comparison of two labellers in one dataset, and merging of two copies of a dataset."""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.annotations.conftest import add, authors, context_for
from tests.backend.annotations.test_values import ACTIONS, FAST, PEOPLE, Step, act, contents
from tests.backend.annotations.test_values import tables as catalogue_tables
from touchdown.backend.annotations import review
from touchdown.backend.annotations.agreement import _periods, suggestion_bias
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.operation_log import read_journal
from touchdown.backend.annotations.training_set import labelled_episodes
from touchdown.backend.annotations.values import AnswerContext, Label
from touchdown.backend.core.faults import FaultError, InputError, RefusedError

SHIFTS_UM = (100, -200, 300, 0, 300)


def test_opinions_are_compared_and_change_no_label(dataset, record):
    labels = dataset.labels
    uuids = [record(2000 * k, -1000 * k).uuid for k in range(5)]
    for k, uuid in enumerate(uuids):
        verdict = "stable" if k < 2 else "unstable"
        labels.accept("ann", uuid, Label(2000 * k + SHIFTS_UM[k], -1000 * k + 1, 0, 50),
                      verdict=verdict, context=AnswerContext(4000 + 1000 * k))  # fmt: skip
        labels.approve("cleo", uuid)
    before, chain = contents(dataset), len(labels.log(limit=1000))
    for k, uuid in enumerate(uuids):
        verdict = "stable" if k < 3 else "unstable"
        labels.opinion("bob", uuid, Label(999, 999, 0, 50))
        labels.opinion("bob", uuid, Label(2000 * k, -1000 * k, 0, 50), verdict=verdict,
                       context=AnswerContext(90_000, blind=True))  # fmt: skip
    assert contents(dataset) == before
    assert len(labels.log(limit=1000)) == chain + 10
    assert not labels._stack("bob").undo
    found = dataset.compare("ann", "bob")
    assert found.episodes == 5
    bias = found.bias_x_mm
    assert (bias.mean, bias.deviation) == pytest.approx((0.1, 0.21213), abs=5e-5)
    assert (bias.lower, bias.upper) == pytest.approx((-0.3158, 0.5158), abs=5e-5)
    assert found.rms_mm == pytest.approx(math.sqrt((1e4 + 4e4 + 9e4 + 9e4) / 5 + 1) / 1e3)
    assert found.icc_x > 0.99
    assert 0.8 < found.patch_iou < 1.0
    assert found.kappa == pytest.approx((0.8 - 0.48) / 0.52)
    assert found.drift_mm == pytest.approx(((300 + 0 + 300) / 3e3 - (100 - 200) / 2e3, 0.0))
    assert found.seconds == (6.0, 60.0)
    (period,) = found.periods
    assert period[1:] == (5, found.rms_mm)


@pytest.mark.parametrize(
    ("step_days", "names"),
    [(0.2, ["2026-01-01"]), (3, ["2026-01-01", "2026-01-04"]), (30, ["2026-W01", "2026-W05"]),
     (120, ["2026-01", "2026-05"])],
)  # fmt: skip
def test_agreement_over_time_has_days_weeks_or_months(step_days, names):
    begin = datetime(2026, 1, 1, 12).timestamp()
    times_ns = [int((begin + 86_400 * days) * 1e9) for days in (0, step_days, step_days)]
    periods = _periods(times_ns, np.array([[0.3, -0.4], [0.0, 1.0], [0.0, 2.0]]))
    assert [name for name, _, _ in periods] == names
    assert sum(count for _, count, _ in periods) == 3
    if len(periods) > 1:
        assert periods[0][2] == pytest.approx(0.5)
        assert periods[1][2] == pytest.approx(math.sqrt(2.5))
    assert _periods([], np.zeros((0, 2))) == ()


def test_two_persons_without_a_common_episode(dataset, record):
    dataset.labels.set("ann", record().uuid, Label(1, 1))
    found = dataset.compare("ann", "bob")
    assert found.episodes == 0
    figures = (found.rms_mm, found.icc_x, found.patch_iou, found.kappa, found.alpha)
    assert all(math.isnan(figure) for figure in (*figures, *found.drift_mm, *found.seconds))


def test_one_common_episode_gives_what_one_can_give(dataset, record):
    uuid = record().uuid
    dataset.labels.opinion("ann", uuid, Label(100, 0, 0, 1))
    dataset.labels.opinion("bob", uuid, Label(0, 0, 0, 1))
    found = dataset.compare("ann", "bob")
    assert (found.bias_x_mm.mean, found.rms_mm) == pytest.approx((0.1, 0.1))
    assert math.isnan(found.bias_x_mm.deviation)
    assert math.isnan(found.icc_x)


def test_labels_made_blind_are_held_against_those_made_with_the_model_in_sight(dataset, record):
    uuids = [record(1000 * k, 0).uuid for k in range(5)]
    for k, uuid in enumerate(uuids):
        shown = Label(1000 * k, 0, 0, 50)
        dataset.labels.opinion("ann", uuid, shown, context=AnswerContext(2000, blind=False))
        if k < 4:
            blind = Label(1000 * k + SHIFTS_UM[k], 500, 0, 50)
            dataset.labels.opinion("bob", uuid, blind, context=AnswerContext(2000, blind=True))
    found = suggestion_bias(dataset.database, ["ann", "bob"])
    assert found.episodes == 4
    assert found.x_mm.mean == pytest.approx(sum(SHIFTS_UM[:4]) / 4e3)
    assert found.y_mm.mean == pytest.approx(0.5)
    assert suggestion_bias(dataset.database, ["ann"]).episodes == 0


tables = partial(catalogue_tables, columns="*")
MORE = (*(a for a in ACTIONS if a != "reopen"), "undo", "redo", "resolve")
steps = st.lists(
    st.tuples(
        st.sampled_from(MORE), st.sampled_from(PEOPLE), st.integers(0, 1), st.integers(-3, 3)
    ),
    max_size=8,
)


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
        return [add(dataset, Label(k, -k, 0, 9)).uuid for k in range(2)]


def merged(folder: Path, name: str, first: str, *others: str) -> Dataset:
    """Return a fresh copy of ``first`` into which the others were merged in turn."""
    shutil.copytree(folder / first, folder / name)
    dataset = Dataset.open(folder / name)
    for other in others:
        dataset.merge("zoe", folder / other)
    return dataset


@settings(max_examples=12, deadline=None, suppress_health_check=list(HealthCheck))
@given(a=steps, b=steps, c=steps, between=steps)
def test_union_is_commutative_associative_and_idempotent(a, b, c, between):
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


def test_two_labels_are_a_conflict_until_a_person_resolves_it(copies):
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
    assert authors(ours, uuid) == ("ann",)
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


def test_two_reviews_of_one_label_are_a_conflict_that_its_author_cannot_settle(copies):
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


def test_a_merge_that_the_disk_refuses_says_so_and_goes_on_later(copies, monkeypatch):
    ours, theirs, (uuid, _) = copies
    theirs.labels.accept("bob", uuid, Label(900, 0, 0, 50))
    new = add(theirs, Label(1, 2), seed=9, source="measured").uuid
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


def test_episodes_come_with_their_files(copies):
    ours, theirs, _ = copies
    entry = add(
        theirs,
        Label(1, 2),
        seed=9,
        source="measured",
        context=context_for(theirs, "barrel", "hex20"),
    )
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


def test_a_broken_or_foreign_log_changes_nothing(copies, tmp_path):
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


def test_one_chain_continued_in_two_ways_is_refused(copies):
    ours, theirs, (uuid, _) = copies
    # A copy that was made to look as if it lay at the same place.
    theirs.labels.site = ours.description.site
    ours.labels.flag("ann", uuid)
    theirs.labels.tag("bob", uuid, "gold")
    with pytest.raises(InputError, match="differently"):
        ours.merge("ann", theirs.folder)

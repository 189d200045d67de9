"""Undo and redo: unlimited, across restarts, for every action, never over another's work."""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.catalogue.conftest import Record, context_for, small_episode
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import RotateFrame, SetState, ShiftOrigin
from touchdown.backend.annotations.values import EpisodeFilter, Label
from touchdown.backend.core.faults import RefusedError

PEOPLE = ("ann", "bob", "cleo")
EPISODES = 3
FAST = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Where thousands of synced commits cost no time."""
ACTIONS = (
    "set", "accept", "approve", "reject", "skip", "flag", "tag", "delete", "restore", "shift",
    "rotate", "accept all", "take over", "reopen",
)  # fmt: skip
Step = tuple[str, str, int, int]

steps = st.lists(
    st.tuples(
        st.sampled_from(ACTIONS),
        st.sampled_from(PEOPLE),
        st.integers(0, EPISODES - 1),
        st.integers(-3, 3),
    ),
    max_size=25,
)


def contents(dataset: Dataset) -> dict[str, object]:
    """Return label, state, marks and training label of every episode."""
    found: dict[str, object] = {}
    for entry in dataset.episodes(EpisodeFilter(deleted=None)):
        head, counting = dataset.labels.head(entry.uuid), dataset.labels.counting(entry.uuid)
        found[entry.uuid] = (
            head.label, head.source, head.state, head.reason, head.verdict, head.geometry,
            head.note, dataset.labels.marks(entry.uuid), counting and counting.label,
            entry.conflict,
        )  # fmt: skip
    return found


def act(dataset: Dataset, step: Step, uuids: list[str]) -> bool:
    """Do one step; False if it was refused or changed nothing."""
    action, person, index, number = step
    labels, uuid = dataset.labels, uuids[index]
    before = labels.chain_heads()
    calls = {
        "set": lambda: labels.set(person, uuid, Label(1000 * number, 5, 0, 100), note=str(number)),
        "accept": lambda: labels.accept(person, uuid),
        "approve": lambda: labels.approve(person, uuid),
        "reject": lambda: labels.reject(person, uuid, "tilt"),
        "skip": lambda: labels.skip(person, uuid),
        "flag": lambda: labels.flag(person, uuid, number > 0, str(number)),
        "tag": lambda: labels.tag(person, uuid, "gold", number > 0),
        "delete": lambda: labels.delete(person, uuid, "test"),
        "restore": lambda: labels.restore(person, uuid),
        "take over": lambda: labels.take_over(person, uuid),
        "shift": lambda: labels.bulk(
            person, labels.preview(person, uuids, ShiftOrigin(number * 100, 7))
        ),
        "rotate": lambda: labels.bulk(
            person, labels.preview(person, uuids, RotateFrame(1234 * number))
        ),
        "accept all": lambda: labels.bulk(
            person, labels.preview(person, uuids, SetState("accept"))
        ),
    }
    with suppress(RefusedError):
        calls[action]()
    return labels.chain_heads() != before


@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(steps=steps, restarts=st.sets(st.integers(0, 60)))
def test_undo_all_gives_the_beginning_and_redo_all_the_end(
    steps: list[Step], restarts: set[int]
) -> None:
    with tempfile.TemporaryDirectory(dir=FAST) as folder:
        dataset = Dataset.open(Path(folder))
        count = 0

        def tick() -> Dataset:
            nonlocal dataset, count
            count += 1
            if count in restarts:
                dataset.close()
                dataset = Dataset.open(Path(folder))
            return dataset

        context = context_for(dataset)
        uuids = [
            dataset.record(
                small_episode(), Label(k, -k, 0, 9), source="commanded", context=context
            ).uuid
            for k in range(EPISODES)
        ]
        trail, done = [contents(dataset)], []
        for step in steps:
            if step[0] == "reopen":
                dataset.close()
                dataset = Dataset.open(Path(folder))
            elif act(tick(), step, uuids):
                done.append(step[1])
                trail.append(contents(dataset))
        for person, before in zip(reversed(done), reversed(trail[:-1]), strict=True):
            assert tick().labels.undo(person) is not None
            assert contents(dataset) == before
        for person, after in zip(done, trail[1:], strict=True):
            assert tick().labels.redo(person) is not None
            assert contents(dataset) == after
        assert not any(dataset.labels.can_redo(person) for person in PEOPLE)
        dataset.close()


def test_anothers_later_change_is_not_undone_and_its_name_is_told(
    dataset: Dataset, record: Record
) -> None:
    labels, uuid = dataset.labels, record().uuid
    labels.accept("ann", uuid, Label(1, 2, 0, 3))
    labels.approve("bob", uuid)
    before = contents(dataset)
    with pytest.raises(RefusedError, match="bob changed this label since"):
        labels.undo("ann")
    assert contents(dataset) == before
    labels.undo("bob")
    labels.undo("ann")
    assert labels.head(uuid).source == "commanded"


def test_undoing_a_review_gives_no_authorship(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    labels.accept("ann", uuid, Label(1, 2, 0, 3))
    labels.approve("bob", uuid)
    labels.undo("bob")
    assert labels.head(uuid).state == "submitted"
    assert labels.counting(uuid) is None
    assert labels.review_status(uuid).authors == ("ann",)
    with pytest.raises(RefusedError, match="ann wrote it"):
        labels.approve("ann", uuid)
    labels.approve("bob", uuid)


def test_a_new_action_empties_redo_and_nothing_is_nothing(dataset: Dataset, record: Record) -> None:
    labels, uuid = dataset.labels, record().uuid
    assert labels.undo("ann") is None
    assert labels.redo("ann") is None
    labels.set("ann", uuid, Label(1, 1))
    labels.undo("ann")
    assert labels.can_redo("ann")
    labels.flag("ann", uuid)
    assert not labels.can_redo("ann")
    assert labels.redo("ann") is None


def test_a_recording_is_no_step_of_undo(dataset: Dataset, record: Record) -> None:
    record()
    assert not dataset.labels.can_undo("cleo")
    assert dataset.labels.undo("cleo") is None


@pytest.mark.parametrize("which", ["the one that leads", "the other one"])
def test_an_undone_resolution_lets_the_label_lead_that_led_before(
    tmp_path: Path, which: str
) -> None:
    with Dataset.open(tmp_path / "ours") as ours:
        uuid = ours.record(
            small_episode(), Label(1, -2, 0, 9), source="commanded", context=context_for(ours)
        ).uuid
    shutil.copytree(tmp_path / "ours", tmp_path / "theirs")
    with Dataset.open(tmp_path / "ours") as ours, Dataset.open(tmp_path / "theirs") as theirs:
        ours.labels.set("ann", uuid, Label(300, -400, 0, 9))
        theirs.labels.set("bob", uuid, Label(-500, 700, 0, 9))
        ours.merge("zoe", tmp_path / "theirs")
        led = ours.labels.head(uuid)
        leaves = ours.labels.conflicting(uuid)
        (other,) = (leaf for leaf in leaves if leaf.rev_uuid != led.rev_uuid)
        chosen = led if which == "the one that leads" else other
        ours.labels.resolve("cleo", uuid, chosen.rev_uuid)
        assert ours.labels.head(uuid).label == chosen.label
        ours.labels.undo("cleo")
        assert ours.labels.head(uuid).label == led.label
        again = ours.labels.conflicting(uuid)
        assert [leaf.label for leaf in again] == [leaf.label for leaf in leaves]

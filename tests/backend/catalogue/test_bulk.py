"""Bulk changes: as previewed or refused, and undone in one step."""

from __future__ import annotations

import pytest

from tests.backend.catalogue.conftest import Record, context_for
from tests.backend.catalogue.test_undo import contents
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import MoveGeometry, RotateFrame, SetState, ShiftOrigin
from touchdown.backend.annotations.values import GEOMETRY_CHANGED, Label
from touchdown.backend.core.faults import InputError, RefusedError


@pytest.fixture
def uuids(record: Record) -> list[str]:
    return [record(1000 * k, -500).uuid for k in range(5)]


def test_a_shift_changes_what_was_previewed_and_one_undo_restores_all(
    dataset: Dataset, uuids: list[str]
) -> None:
    labels = dataset.labels
    labels.accept("ann", uuids[0])
    labels.approve("bob", uuids[0])
    labels.reject("ann", uuids[1], "tilt")
    labels.delete("ann", uuids[2], "test")
    before = contents(dataset)
    wanted = labels.preview("cleo", uuids, ShiftOrigin(250, -40))
    assert [row.episode for row in wanted.rows] == [uuids[0], uuids[3], uuids[4]]
    assert dict(wanted.refused) == {
        uuids[1]: "It is rejected.",
        uuids[2]: "The episode is deleted: restore it first.",
    }
    assert contents(dataset) == before
    assert labels.bulk("cleo", wanted) == len(wanted.rows) == 3
    for row in wanted.rows:
        head = labels.head(row.episode)
        assert (head.label, head.state, head.source) == (row.after.label, "draft", "commanded")
        assert head.label.y_um == -540
    counting = labels.counting(uuids[0])
    assert counting is not None
    assert counting.label.x_um == 0
    labels.undo("cleo")
    assert contents(dataset) == before


def test_a_label_changed_since_the_preview_refuses_all(dataset: Dataset, uuids: list[str]) -> None:
    labels = dataset.labels
    wanted = labels.preview("cleo", uuids, ShiftOrigin(1, 1))
    labels.set("ann", uuids[3], Label(5, 5, 0, 50))
    before = contents(dataset)
    with pytest.raises(RefusedError, match=r"1 of 5 labels changed[^,]*, the first by ann"):
        labels.bulk("cleo", wanted)
    assert contents(dataset) == before
    again = labels.preview("cleo", uuids, ShiftOrigin(1, 1))
    assert again.token != wanted.token
    assert labels.preview("cleo", uuids, ShiftOrigin(1, 1)).token == again.token
    assert labels.bulk("cleo", again) == 5


def test_a_quarter_turn_of_the_frame(dataset: Dataset, record: Record) -> None:
    entry = record(3000, -1000)
    labels = dataset.labels
    labels.bulk("ann", labels.preview("ann", [entry.uuid], RotateFrame(90_000)))
    assert labels.head(entry.uuid).label == Label(1000, 3000, 90_000, 150)
    labels.bulk("ann", labels.preview("ann", [entry.uuid], RotateFrame(-90_000)))
    assert labels.head(entry.uuid).label == Label(3000, -1000, 0, 150)


def test_labels_move_to_a_corrected_geometry_and_have_to_be_reviewed_again(
    dataset: Dataset, uuids: list[str]
) -> None:
    labels = dataset.labels
    old, new = context_for(dataset).geometry, context_for(dataset, "pot", "circle25").geometry
    labels.accept("ann", uuids[0])
    labels.approve("bob", uuids[0])
    labels.reject("bob", uuids[1], "tilt")
    small = int(dataset.patch(uuids[0]).touching.sum())
    wanted = labels.preview("ann", uuids, MoveGeometry(old, new))
    assert labels.bulk("ann", wanted) == 5
    assert int(dataset.patch(uuids[0]).touching.sum()) > small
    assert labels.head(uuids[0]).state == "draft"
    # Approved with the wrong dimension: it does not train until it is approved again.
    assert labels.counting(uuids[0]) is None
    assert labels.head(uuids[1]).state == "rejected"
    assert all(GEOMETRY_CHANGED in labels.marks(uuid) for uuid in uuids)
    assert labels.preview("ann", uuids, MoveGeometry(old, new)).rows == ()
    labels.undo("ann")
    assert int(dataset.patch(uuids[0]).touching.sum()) == small
    assert labels.counting(uuids[0]) is not None
    assert not any(GEOMETRY_CHANGED in labels.marks(uuid) for uuid in uuids)


def test_states_in_bulk_obey_the_same_rules(dataset: Dataset, uuids: list[str]) -> None:
    labels = dataset.labels
    labels.bulk("ann", labels.preview("ann", uuids, SetState("accept")))
    own = labels.preview("ann", uuids, SetState("approve"))
    assert own.rows == ()
    assert {reason for _, reason in own.refused} == {
        "ann wrote it: another person has to review it."
    }
    others = labels.preview("bob", uuids, SetState("approve"))
    with pytest.raises(RefusedError, match="ann wrote it"):
        labels.bulk("ann", others)
    assert labels.bulk("bob", others) == 5
    assert dataset.counts() == {"approved": 5}
    assert dataset.database.one("SELECT count(*) FROM review WHERE reviewer = 'bob'") == (5,)
    with pytest.raises(InputError, match="reason"):
        labels.preview("bob", uuids, SetState("reject"))
    with pytest.raises(InputError, match="cannot be 'set'"):
        labels.preview("bob", uuids, SetState("set"))

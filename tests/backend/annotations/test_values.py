"""Hashes and ids compared with published vectors."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.backend.annotations.conftest import (
    Record,
    add,
    authors,
    context_for,
    flip_byte,
    small_episode,
)
from touchdown.backend.annotations import values as ids
from touchdown.backend.annotations.backups import BackupStore
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.labels import RotateFrame, SetState, ShiftOrigin
from touchdown.backend.annotations.operation_log import OperationJournal, read_journal
from touchdown.backend.annotations.reconciliation import check_dataset, reconcile
from touchdown.backend.annotations.values import FIRST_HASH as VALUES_FIRST_HASH
from touchdown.backend.annotations.values import (
    EpisodeFilter,
    Label,
    Operation,
    canonical_json,
    first_broken_link,
    follow_uuid,
    is_uuid7,
    operation_hash,
    uuid7,
    uuid7_from_parts,
)
from touchdown.backend.core.faults import RefusedError
from touchdown.backend.episodes.episode_mcap import read_episode, write_episode
from touchdown.backend.runs.campaign import new_campaign

FIRST_OP = (
    '{"actor":"ann","at_ns":1700000000000000000,"body":{"closes":[],"revs":[{"episode":"ep-1",'
    '"geometry":"g-1","note":"","parent":null,"reason":null,"rev_uuid":"r-1","sigma_um":100,'
    '"source":"human","state":"submitted","theta_mdeg":0,"verdict":null,"x_um":1500,"y_um":-250}]},'
    '"lamport":1,"op_uuid":"op-1","seq":1,"site":"A","target_op":null,"verb":"label.set"}'
)
FIRST_HASH = "7e024c3b923a4d1ed09b5c8498dd87d881f8eb8de319dfd8d0de98a3d8bff805"
SECOND_OP = (
    '{"actor":"ann","at_ns":1700000001000000000,"body":{"closes":[],"revs":[{"episode":"ep-1",'
    '"geometry":"g-1","note":"","parent":"r-1","reason":null,"rev_uuid":"r-2","sigma_um":null,'
    '"source":"human","state":"unlabelled","theta_mdeg":null,"verdict":null,"x_um":null,'
    '"y_um":null}]},"lamport":2,"op_uuid":"op-2","seq":2,"site":"A","target_op":"op-1",'
    '"verb":"undo"}'
)
SECOND_HASH = "e8f53d2ec1936ec7559812cb81acbaef03cbb919d28e44b2a3166b1ffc6c712d"


def operation(text: str, prev_hash: str, digest: str) -> Operation:
    return Operation(**json.loads(text), prev_hash=prev_hash, hash=digest)


def test_the_published_chain_and_one_changed_character():
    first = operation(FIRST_OP, VALUES_FIRST_HASH, FIRST_HASH)
    second = operation(SECOND_OP, FIRST_HASH, SECOND_HASH)
    assert canonical_json(json.loads(FIRST_OP)) == FIRST_OP.encode()
    assert len(FIRST_OP.encode()) == 354
    assert operation_hash(first) == FIRST_HASH
    assert operation_hash(second) == SECOND_HASH
    assert first_broken_link([first, second]) is None
    changed = operation(SECOND_OP.replace('"undo"', '"Undo"'), FIRST_HASH, SECOND_HASH)
    assert first_broken_link([first, changed]) == 2
    assert first_broken_link([changed]) == 1


def test_a_float_is_never_hashed_and_words_stay_as_they_are():
    with pytest.raises(TypeError):
        canonical_json({"x": [1, {"y": 0.5}]})
    assert canonical_json({"b": "Jörg", "a": None}) == '{"a":null,"b":"Jörg"}'.encode()


def test_ids_sort_by_time_and_have_the_form_of_rfc_9562():
    # Appendix A.6 of RFC 9562.
    random = (0xCC3 << 62) | 0x18C4DC0C0C07398F
    assert uuid7_from_parts(0x017F22E279B0, random) == "017f22e2-79b0-7cc3-98c4-dc0c0c07398f"
    made = [uuid7() for _ in range(3000)]
    assert made == sorted(made)
    assert len(set(made)) == 3000
    assert all(map(is_uuid7, made))
    assert not is_uuid7("0190-abc")
    assert not is_uuid7("6ba7b810-9dad-41d1-80b4-00c04fd430c8")


HOUR_NS = 3600 * 1_000_000_000


@pytest.mark.promise("P2")
def test_labels_and_episodes_keep_their_order(tmp_path, monkeypatch):
    folder = tmp_path / "data"
    with Dataset.open(folder, person="ann") as dataset:

        def record() -> str:
            label = Label(0, 0, 0, 9)
            made = add(dataset, label, source="measured")
            return made.uuid

        first = record()
        dataset.labels.set("ann", first, Label(100, 0, 0, 9))
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() - HOUR_NS)
    monkeypatch.setattr(ids, "_last", (0, 0))  # as in a process that starts now
    with Dataset.open(folder, person="ann") as dataset:
        assert dataset.notices == ()
        second = record()
        dataset.labels.set("ann", first, Label(200, 0, 0, 9))
        assert [e.uuid for e in dataset.episodes()] == [first, second]
        assert dataset.labels.head(first).label.x_um == 200
        assert [r.label.x_um for r in dataset.labels.history(first)] == [0, 100, 200]
        dataset.labels.undo("ann")
        assert dataset.labels.head(first).label.x_um == 100
        assert list(check_dataset(dataset.parts, whole=True)) == []


def test_a_campaign_of_now_is_newer_than_one_of_an_hour_later(monkeypatch):
    before = new_campaign("pot", "circle15", "random", 0, 3, None).uuid
    clock = time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: clock() - HOUR_NS)
    monkeypatch.setattr(ids, "_last", (0, 0))
    follow_uuid(before)
    assert uuid7() > before
    last_of_a_millisecond = uuid7_from_parts(clock() // 1_000_000, (1 << 74) - 1)
    follow_uuid(last_of_a_millisecond)
    assert uuid7() > last_of_a_millisecond
    follow_uuid("no id")
    assert uuid7() > last_of_a_millisecond


def test_labels_are_backed_up_hourly_although_the_newest_copy_is_of_tomorrow(dataset):
    now = datetime(2030, 5, 2, 12, tzinfo=UTC)
    keeper = BackupStore(dataset.database, dataset.folder / "b", lambda: now + timedelta(days=1))
    dataset.labels.skip("ann", add(dataset, Label(0, 0, 0, 9), source="measured").uuid)
    keeper.make("test")
    dataset.labels.flag("ann", dataset.episodes()[0].uuid)
    back = BackupStore(dataset.database, dataset.folder / "b", lambda: now)
    assert back.hourly() is not None
    assert back.hourly() is None


def linked(count: int, previous: str = VALUES_FIRST_HASH, seq: int = 1) -> list[Operation]:
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
def test_a_link_to_another_past_is_found_though_its_own_hash_is_right(previous):
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


def test_a_journal_gets_what_lacks_behind_its_last_number(dataset, record):
    journal, path, lines = journal_of(dataset, record)
    damaged = b"".join([lines[0], b"?\n", *lines[2:]])
    path.write_bytes(damaged)
    with dataset.database.transaction() as connection:
        assert journal.catch_up(connection, dataset.description.site) == 0
    assert path.read_bytes() == damaged
    journal = OperationJournal(path.parent)
    path.write_bytes(b"".join(lines[:-1]) + b"{}\n")
    with dataset.database.transaction() as connection:
        assert journal.catch_up(connection, dataset.description.site) == 1
    assert path.read_bytes() == b"".join(lines[:-1]) + b"{}\n" + lines[-1]


def test_a_part_file_stays_while_its_finished_file_is_damaged(dataset, record):
    entry = record()
    final = dataset.folder / entry.path
    part = final.with_name(f".{final.name}.part")
    part.write_bytes(final.read_bytes())
    flip_byte(final)
    site = dataset.folder
    dataset.close()
    with Dataset.open(site) as opened:
        found = {finding.kind for finding in check_dataset(opened.parts, whole=True)}
    assert "left-over" not in found
    assert part.exists()


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A dataset of three episodes, one with a label by a person; closed."""
    folder = tmp_path / "data"
    with Dataset.open(folder, person="cleo") as dataset:
        for number in range(3):
            label = Label(1000 * number, -500, 0, 150)
            add(dataset, label, seed=number)
        first = dataset.episodes()[0].uuid
        dataset.labels.set("ann", first, Label(1234, 5, 0, 100))
    return folder


def uuids(folder: Path) -> list[str]:
    with Dataset.open(folder) as dataset:
        return [entry.uuid for entry in dataset.episodes()]


def file_of(folder: Path, uuid: str) -> Path:
    return folder / "raw" / "series-1" / f"{uuid}.mcap"


def mended(folder: Path) -> tuple[str, ...]:
    """Return the messages of the first opening; later ones and a check list losses only."""
    with Dataset.open(folder) as dataset:
        notices = dataset.notices
    with Dataset.open(folder) as dataset:
        assert all(problem.lasting for problem in dataset.problems)
        assert [f for f in check_dataset(dataset.parts) if f.repair is not None] == []
    return notices


def forget_row(folder: Path, uuid: str) -> None:
    """Remove the row, as if the process had died before its commit."""
    with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
        for trigger in ("op_no_delete", "label_rev_no_delete"):
            connection.execute(f"DROP TRIGGER {trigger}")
        ops = "SELECT op_uuid FROM label_rev WHERE episode = ?"
        listed = [op for (op,) in connection.execute(ops, (uuid,)).fetchall()]
        connection.execute("DELETE FROM episode WHERE uuid = ?", (uuid,))
        connection.execute("DELETE FROM label_head WHERE episode = ?", (uuid,))
        connection.execute("DELETE FROM label_rev WHERE episode = ?", (uuid,))
        connection.executemany("DELETE FROM op WHERE op_uuid = ?", [(op,) for op in listed])
    journal = next((folder / "labels").glob("*.jsonl"))
    lines = journal.read_bytes().splitlines(keepends=True)
    kept = [line for line in lines if json.loads(line)["op_uuid"] not in listed]
    journal.write_bytes(b"".join(kept))


def test_a_complete_file_without_a_row_is_adopted(tmp_path):
    folder = tmp_path / "data"
    with Dataset.open(folder) as dataset:
        entry = add(dataset, Label(700, -30, 5, 90), source="measured")
    forget_row(folder, entry.uuid)
    (notice,) = mended(folder)
    assert "adopted" in notice
    with Dataset.open(folder) as dataset:
        (back,) = dataset.episodes()
        assert back.adopted
        names = ("uuid", "series", "campaign", "plan_item", "path", "recorded_ns", "piece",
                 "bottom", "geometry", "grip_id", "mounting_id", "person", "mode", "quality",
                 "keep_frames", "sha256", "bytes", "file_state", "state")  # fmt: skip
        assert [getattr(back, n) for n in names] == [getattr(entry, n) for n in names]
        head = dataset.labels.head(entry.uuid)
        assert (head.label, head.source, head.state) == (
            Label(700, -30, 5, 90), "measured", "draft",
        )  # fmt: skip
        (event,) = dataset.database.rows("SELECT target FROM event WHERE verb = 'adopt'")
        assert event == (entry.uuid,)


def test_a_changed_byte_is_found_by_the_whole_check(folder):
    uuid = uuids(folder)[1]
    path = file_of(folder, uuid)
    with Dataset.open(folder) as dataset:
        assert list(check_dataset(dataset.parts, whole=True)) == []
    data = flip_byte(path)
    assert mended(folder) == ()
    with Dataset.open(folder) as dataset:
        (finding,) = reconcile(dataset.parts, whole=True)
        assert (finding.kind, finding.target) == ("damaged", uuid)
        assert dataset.entry(uuid).file_state == "damaged"
        (again,) = reconcile(dataset.parts, whole=True)
        assert (again.target, again.lasting) == (uuid, True)
    assert path.read_bytes() == data


@pytest.mark.parametrize(("loss", "state"), [("marked as damaged", "damaged"),
                                             ("missing", "missing")])  # fmt: skip
def test_a_changed_or_missing_file_keeps_its_label_and_comes_back(folder, loss, state):
    uuid = uuids(folder)[1]
    path = file_of(folder, uuid)
    good = path.read_bytes()
    if state == "missing":
        path.unlink()
    else:
        write_other_episode(path)
    assert loss in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == state
        assert dataset.labels.head(uuid).label == Label(1000, -500, 0, 150)
    path.write_bytes(good)
    assert "is back" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "complete"


def write_other_episode(path: Path) -> None:
    """Replace the file of an episode by a readable file of another size."""
    write_episode(path, small_episode(seed=99), None, {"note": "another" * 50})


def test_a_torn_file_under_a_final_name_goes_to_quarantine(folder):
    uuid = uuids(folder)[2]
    path = file_of(folder, uuid)
    whole = path.read_bytes()
    path.write_bytes(whole[:-300])
    (notice,) = mended(folder)
    assert "torn" in notice
    assert not path.exists()
    assert (folder / "quarantine" / path.name).read_bytes() == whole[:-300]
    saved = folder / "quarantine" / f"{uuid}.salvaged.mcap"
    assert read_episode(saved).episode_id == uuid
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).file_state == "quarantined"
        assert dataset.labels.head(uuid).label == Label(2000, -500, 0, 150)


def test_an_unfinished_part_file_is_salvaged_and_stays(folder):
    uuid = uuids(folder)[0]
    data = file_of(folder, uuid).read_bytes()
    part = folder / "raw" / "series-1" / ".torn.mcap.part"
    part.write_bytes(data[:-200])
    assert "never finished" in mended(folder)[0]
    assert part.read_bytes() == data[:-200]
    assert read_episode(folder / "quarantine" / "torn.mcap").episode_id == uuid
    assert len(uuids(folder)) == 3


def test_part_files_without_content_or_beside_the_finished_file_are_deleted(folder):
    parts = {name: folder / "raw" / "series-1" / f".{name}.mcap.part" for name in range(9)}
    for part in parts.values():
        part.touch()
    (notice,) = mended(folder)
    assert "9 times" in notice, "many findings of a kind are one line"
    assert "empty" in notice
    beside = folder / "raw" / "series-1" / f".{uuids(folder)[0]}.mcap.part"
    beside.write_bytes(b"half of it")
    assert "finished file" in mended(folder)[0]
    assert list(beside.parent.glob(".*.part")) == []


def test_a_moved_file_is_found_again(folder):
    uuid = uuids(folder)[0]
    there = folder / "raw" / "elsewhere" / "renamed.mcap"
    there.parent.mkdir()
    shutil.move(file_of(folder, uuid), there)
    assert any("moved to raw/elsewhere" in notice for notice in mended(folder))
    with Dataset.open(folder) as dataset:
        assert dataset.entry(uuid).path == "raw/elsewhere/renamed.mcap"
        assert dataset.entry(uuid).file_state == "complete"
        assert dataset.read(uuid).episode_id == uuid


@pytest.mark.parametrize("damaged", [False, True])
def test_of_two_files_with_one_uuid_the_true_one_stays(folder, damaged):
    uuid = uuids(folder)[0]
    path = file_of(folder, uuid)
    good = path.read_bytes()
    copy = path.with_name("copy.mcap")
    copy.write_bytes(good)
    if damaged:
        write_other_episode(path)
    mended(folder)
    with Dataset.open(folder) as dataset:
        entry = dataset.entry(uuid)
        assert entry.file_state == "complete"
        assert (folder / entry.path).read_bytes() == good
    assert len(list((folder / "quarantine").iterdir())) == 1


def test_a_foreign_file_is_told_once_and_left(folder):
    stray = folder / "raw" / "stray.mcap"
    write_episode(stray, small_episode(seed=5), None, {})
    assert "no label message" in mended(folder)[0]
    assert stray.exists()
    assert len(uuids(folder)) == 3


def test_what_is_missing_in_the_journal_is_written(folder):
    journal = next((folder / "labels").glob("*.jsonl"))
    whole = journal.read_bytes()
    lines = whole.splitlines(keepends=True)
    journal.write_bytes(b"".join(lines[:2]) + lines[2][:40])
    (notice,) = mended(folder)
    assert "2 label operations were missing in the journal" in notice
    assert journal.read_bytes() == whole


COLUMNS = "uuid, series, path, sha256, bytes, piece, bottom, geometry, person, state"


def tables(dataset: Dataset, columns: str = COLUMNS) -> dict[str, list[tuple[object, ...]]]:
    listed = {}
    for name in ("op", "label_rev", "label_head", "mark", "closed"):
        rows = dataset.database.rows(f"SELECT * FROM {name}")
        listed[name] = sorted(rows, key=repr)
    listed["episode"] = dataset.database.rows(f"SELECT {columns} FROM episode")
    return listed


@pytest.mark.parametrize("where", ["catalogue", "journal", "fork"])
def test_a_broken_chain_makes_labels_read_only(folder, where):
    uuid = uuids(folder)[0]
    journal = next((folder / "labels").glob("*.jsonl"))
    lines = journal.read_text().splitlines(keepends=True)
    if where == "catalogue":
        with Dataset.open(folder) as dataset, dataset.database.transaction() as connection:
            connection.execute("DROP TRIGGER op_no_update")
            sql = "UPDATE op SET body = replace(body, '1234', '1235') WHERE seq = 4"
            connection.execute(sql)
        number = 4
    elif where == "journal":
        extra = json.loads(lines[-1]) | {"seq": 5, "op_uuid": "x", "prev_hash": "0" * 64}
        journal.write_text("".join(lines) + json.dumps(extra) + "\n")
        number = 5
    else:
        other = json.loads(lines[-1]) | {"hash": "1" * 64}
        journal.write_text("".join(lines[:-1]) + json.dumps(other) + "\n")
        number = 4
    for _ in range(2):
        with Dataset.open(folder) as dataset:
            (notice,) = dataset.notices
            assert f"at number {number}" in notice
            assert "read-only" in notice
            before = tables(dataset)
            with pytest.raises(RefusedError, match="read-only"):
                dataset.labels.set("ann", uuid, Label(1, 2, 0, 3))
            with pytest.raises(RefusedError):
                add(dataset, Label(), seed=7)
            assert tables(dataset) == before
            assert len(list((folder / "raw").rglob("*.mcap"))) == 3
            events = dataset.database.rows("SELECT 1 FROM event WHERE verb = 'broken-chain'")
            assert len(events) == 1


def test_wrong_heads_are_made_anew(folder):
    with Dataset.open(folder) as dataset:
        expected = tables(dataset)
        with dataset.database.transaction() as connection:
            first = connection.execute("SELECT rev_uuid FROM label_rev LIMIT 1").fetchone()
            connection.execute("UPDATE label_head SET rev_uuid = ?", first)
    assert "heads" in mended(folder)[0]
    with Dataset.open(folder) as dataset:
        assert tables(dataset) == expected
        with dataset.database.transaction() as connection:
            connection.execute("UPDATE label_head SET conflict = 1")
        kinds = [finding.kind for finding in check_dataset(dataset.parts, whole=True)]
        assert kinds == ["heads"]


def test_half_made_files_are_deleted_but_not_those_being_made(folder):
    (folder / "cache").mkdir()
    old, new = folder / "cache" / ".a.tmp", folder / "cache" / ".b.tmp"
    for path in (old, new):
        path.write_bytes(b"half")
    os.utime(old, (1, 1))
    assert "left incomplete" in mended(folder)[0]
    assert not old.exists()
    assert new.exists()


def test_checking_changes_nothing(folder):
    gone, torn, _ = uuids(folder)
    file_of(folder, gone).unlink()
    path = file_of(folder, torn)
    path.write_bytes(path.read_bytes()[:-100])
    with Dataset.open(folder, write=False) as dataset:
        kinds = {finding.kind for finding in check_dataset(dataset.parts, whole=True)}
        assert kinds == {"missing", "torn"}
        assert {e.file_state for e in dataset.episodes(EpisodeFilter())} == {"complete"}
    assert path.exists()


ROUNDS = 12


def test_recording_labelling_and_reading_at_once_lose_nothing(dataset, record):
    uuids = [record().uuid for _ in range(3)]
    context = context_for(dataset)

    def collect(seed: int) -> str:
        episode = small_episode(seed=seed)
        entry = dataset.record(episode, Label(seed, 0), source="measured", context=context)
        return entry.uuid

    def label(number: int) -> int:
        person, uuid = f"person {number % 2}", uuids[number % 3]
        try:
            dataset.labels.set(person, uuid, Label(number, number, 0, 10))
            dataset.labels.undo(person)
        except RefusedError:
            return 0
        return 2

    def look(number: int) -> int:
        return len(dataset.labels.history(uuids[number % 3])) + len(dataset.episodes())

    with ThreadPoolExecutor(6) as pool:
        collected = pool.map(collect, range(ROUNDS))
        written = pool.map(label, range(3 * ROUNDS))
        looked = pool.map(look, range(3 * ROUNDS))
        new, count, seen = list(collected), sum(written), list(looked)
    assert min(seen) >= 1 + 3
    assert {entry.uuid for entry in dataset.episodes()} == {*uuids, *new}
    log = sorted(dataset.labels.log(limit=10_000), key=lambda op: op.seq)
    assert first_broken_link(log) is None
    assert list(read_journal(dataset.journal.path(dataset.description.site))) == log
    assert len([op for op in log if op.verb == "record"]) == 3 + ROUNDS
    assert len(log) >= 3 + ROUNDS + count


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
def test_undo_all_gives_the_beginning_and_redo_all_the_end(steps, restarts):
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

        uuids = [add(dataset, Label(k, -k, 0, 9)).uuid for k in range(EPISODES)]
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
        assert not any(dataset.labels._stack(person).redo for person in PEOPLE)
        dataset.close()


def test_anothers_later_change_is_not_undone_and_its_name_is_told(dataset, record):
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


def test_undoing_a_review_gives_no_authorship(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    labels.accept("ann", uuid, Label(1, 2, 0, 3))
    labels.approve("bob", uuid)
    labels.undo("bob")
    assert labels.head(uuid).state == "submitted"
    assert labels.counting(uuid) is None
    assert authors(dataset, uuid) == ("ann",)
    with pytest.raises(RefusedError, match="ann wrote it"):
        labels.approve("ann", uuid)
    labels.approve("bob", uuid)


def test_a_new_action_empties_redo_and_nothing_is_nothing(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    assert labels.undo("ann") is None
    assert labels.redo("ann") is None
    labels.set("ann", uuid, Label(1, 1))
    labels.undo("ann")
    assert labels._stack("ann").redo
    labels.flag("ann", uuid)
    assert not labels._stack("ann").redo
    assert labels.redo("ann") is None

    # A recording is no step of undo.
    assert not labels._stack("cleo").undo
    assert labels.undo("cleo") is None


@pytest.mark.parametrize("which", ["the one that leads", "the other one"])
def test_an_undone_resolution_lets_the_label_lead_that_led_before(tmp_path, which):
    with Dataset.open(tmp_path / "ours") as ours:
        uuid = add(ours, Label(1, -2, 0, 9)).uuid
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

"""Table of states: every action in every state, with the reason of each refusal."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from tests.backend.annotations.conftest import authors, context_for
from tests.backend.annotations.filling import fill
from touchdown.backend.annotations import episode_index
from touchdown.backend.annotations.backups import list_backups, restore_backup
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.queues import (
    AUDIT_SHARE,
    QUEUES,
    ScoredLabel,
    Suggestion,
    disagreement,
    parse_filter,
)
from touchdown.backend.annotations.rebuild import rebuild_dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.review import ReviewStatus, check_person, state_after
from touchdown.backend.annotations.run_tracking import METRICS_FILE, RUNS_FOLDER, ActiveRun
from touchdown.backend.annotations.values import AnswerContext, EpisodeFilter, Label
from touchdown.backend.core.faults import InputError, RefusedError

MOVED = Label(2000, 300, 0, 200)


def standing(state: str, authors: tuple[str, ...] = ("ann",), before: bool = False) -> ReviewStatus:
    return ReviewStatus(state, authors, before, conflict=False, deleted=False)


TABLE = {
    ("unlabelled", "set"): "draft",
    ("unlabelled", "accept"): "no offset",
    ("unlabelled", "approve"): "no label to review",
    ("unlabelled", "reject"): "rejected",
    ("draft", "set"): "draft",
    ("draft", "accept"): "submitted",
    ("draft", "approve"): "its author has to accept",
    ("draft", "reject"): "rejected",
    ("submitted", "set"): "waits for review",
    ("submitted", "accept"): "waits for review already",
    ("submitted", "approve"): "ann wrote it",
    ("submitted", "reject"): "ann wrote it",
    ("approved", "set"): "draft",
    ("approved", "accept"): "approved already",
    ("approved", "approve"): "It is approved",
    ("approved", "reject"): "It is approved",
    ("rejected", "set"): "draft",
    ("rejected", "accept"): "was rejected",
    ("rejected", "approve"): "rejected already",
    ("rejected", "reject"): "rejected already",
}
STATES = ("draft", "submitted", "approved", "rejected")
BY_ANOTHER = {
    ("draft", "set"): "labels are by ann",
    ("rejected", "set"): "labels are by ann",
    ("submitted", "approve"): "approved",
    ("submitted", "reject"): "rejected",
}


def outcome(wanted: str, call: Callable[[], str]) -> None:
    if wanted in STATES:
        assert call() == wanted
    else:
        with pytest.raises(RefusedError, match=wanted):
            call()


@pytest.mark.parametrize(("state", "action"), TABLE)
def test_every_state_by_every_action(state, action):
    found, key = standing(state), (state, action)
    outcome(TABLE[key], lambda: state_after(action, found, "ann"))
    wanted = BY_ANOTHER.get(key, TABLE[key])
    outcome(wanted, lambda: state_after(action, found, "bob"))


@pytest.mark.parametrize("action", ["set", "accept", "approve", "reject"])
@pytest.mark.parametrize("state", ["unlabelled", *STATES])
def test_nothing_is_done_to_what_is_deleted_or_in_conflict(state, action):
    for closed, word in (({"deleted": True}, "deleted"), ({"conflict": True}, "two labels")):
        flags = {"conflict": False, "deleted": False} | closed
        found = ReviewStatus(state, (), False, **flags)
        with pytest.raises(RefusedError, match=word):
            state_after(action, found, "bob")


def test_one_pair_of_eyes_may_be_allowed_and_a_changed_approved_draft_can_be_reviewed():
    assert state_after("approve", standing("submitted"), "ann", four_eyes=False) == "approved"
    assert state_after("approve", standing("draft", before=True), "bob") == "approved"
    with pytest.raises(RefusedError, match="ann wrote it"):
        state_after("approve", standing("draft", before=True), "ann")


@pytest.mark.parametrize("name", ["", "  ", "program", "a\nb", "x" * 81])
def test_only_a_person_acts(dataset, record, name):
    with pytest.raises(InputError, match="name of a person"):
        dataset.labels.accept(name, record().uuid)
    assert check_person("  Jörg  ") == "Jörg"


def test_the_way_of_a_label_from_the_campaign_to_approval(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    assert labels.head(uuid).source == "commanded"
    assert labels.set("ann", uuid, MOVED).source == "human"
    accepted = labels.accept("ann", uuid, context=AnswerContext(4200))
    assert (accepted.state, accepted.source, accepted.label) == ("submitted", "human", MOVED)
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", uuid)
    approved = labels.approve("bob", uuid, context=AnswerContext(900, blind=True))
    assert labels.counting(uuid) == approved
    edited = labels.set("ann", uuid, Label(0, 0, 0, 100))
    assert edited.state == "draft"
    assert labels.counting(uuid) == approved
    labels.accept("ann", uuid)
    final = labels.approve("bob", uuid)
    assert labels.counting(uuid) == final
    states = [revision.state for revision in labels.history(uuid)]
    assert states == ["draft", "draft", "submitted", "superseded", "draft", "submitted", "approved"]
    done = [op for op in reversed(labels.log()) if op.actor == "bob"]
    assert [op.body["reviews"][0]["decision"] for op in done] == ["approved", "approved"]
    assert (done[0].body["seen_ms"], done[0].body["blind"]) == (900, True)


def test_accepting_a_changed_offset_is_one_revision(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    revision = labels.accept("ann", uuid, MOVED)
    assert (revision.state, revision.source, revision.label) == ("submitted", "human", MOVED)
    assert len(labels.history(uuid)) == 2
    suggested = record().uuid
    revision = labels.accept("ann", suggested, MOVED, source="model:abc")
    assert revision.source == "model:abc"
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", suggested)


def test_rejected_work_goes_back_to_its_author(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    labels.accept("ann", uuid, MOVED)
    with pytest.raises(InputError, match="reason"):
        labels.reject("bob", uuid, " ")
    rejected = labels.reject("bob", uuid, "tilt")
    assert (rejected.state, rejected.reason) == ("rejected", "tilt")
    assert authors(dataset, uuid) == ("ann",)
    assert labels.counting(uuid) is None
    with pytest.raises(RefusedError, match="labels are by ann"):
        labels.set("bob", uuid, Label(1, 1))
    labels.take_over("bob", uuid)
    assert authors(dataset, uuid) == ("ann", "bob")
    labels.set("bob", uuid, Label(1, 1))
    labels.accept("bob", uuid)
    with pytest.raises(RefusedError, match="another person"):
        labels.approve("ann", uuid)
    labels.approve("cleo", uuid)


def test_the_source_of_an_untouched_offset_never_changes(dataset, record):
    labels, entry = dataset.labels, record()
    before = labels.head(entry.uuid)
    assert labels.set("ann", entry.uuid, before.label) == before
    noted = labels.set("ann", entry.uuid, before.label, note="looks odd", verdict="unsure")
    assert (noted.source, noted.note, noted.verdict) == ("commanded", "looks odd", "unsure")
    labels.accept("ann", entry.uuid)
    labels.undo("ann")
    labels.redo("ann")
    labels.approve("bob", entry.uuid)
    sources = {revision.source for revision in labels.history(entry.uuid)}
    assert sources == {"commanded"}


def test_any_old_revision_can_be_written_again(dataset, record):
    labels, uuid = dataset.labels, record().uuid
    first = labels.head(uuid)
    labels.set("ann", uuid, MOVED)
    again = labels.restore_revision("ann", uuid, first.rev_uuid)
    assert (again.label, again.source, again.state) == (first.label, "commanded", "draft")
    assert len(labels.history(uuid)) == 3
    with pytest.raises(InputError, match="another episode"):
        labels.restore_revision("ann", record().uuid, first.rev_uuid)


def test_deleting_hides_and_restoring_brings_back(dataset, record):
    labels, entry = dataset.labels, record()
    content = dataset.path(entry.uuid).read_bytes()
    labels.delete("ann", entry.uuid, "wrong piece")
    assert dataset.episodes() == []
    assert labels.marks(entry.uuid) == {"deleted": "wrong piece"}
    with pytest.raises(RefusedError, match="deleted"):
        labels.flag("ann", entry.uuid)
    labels.undo("ann")
    assert dataset.episodes() == [entry]
    assert dataset.path(entry.uuid).read_bytes() == content


def test_the_log_can_be_searched(dataset, record):
    labels, first, second = dataset.labels, record().uuid, record().uuid
    labels.set("ann", first, MOVED, note="bent corner")
    labels.flag("bob", second)
    assert [op.verb for op in labels.log()] == ["flag", "label.set", "record", "record"]
    assert [op.verb for op in labels.log(text="bob")] == ["flag"]
    assert [op.verb for op in labels.log(text=first)] == ["label.set", "record"]
    assert [op.actor for op in labels.log(text="bent corner")] == ["ann"]
    assert labels.people() == ["ann", "bob", "cleo"]
    with pytest.raises(InputError, match="no such episode"):
        labels.head("nothing")


def test_work_moves_from_queue_to_queue(dataset, record):
    labels, (a, b, c) = dataset.labels, [record().uuid for _ in range(3)]
    assert dataset.queue("unlabelled", "ann") == [a, b, c]
    labels.skip("ann", a)
    assert dataset.queue("unlabelled", "ann") == [b, c, a]
    assert dataset.queue("unlabelled", "ann", limit=1) == [b]
    labels.accept("ann", b)
    assert dataset.queue("unlabelled", "ann") == [c, a]
    assert dataset.queue("review", "ann") == []
    assert dataset.queue("review", "bob") == [b]
    labels.reject("bob", b, "tilt")
    assert dataset.queue("returned", "ann") == [b]
    assert dataset.queue("returned", "bob") == []
    labels.reject("bob", a, "slip")
    assert dataset.queue("returned", "bob") == [a], "an own rejection of a probe stays in reach"
    assert dataset.queue("returned", "ann") == [b]
    labels.undo("bob")
    labels.delete("ann", c, "test")
    assert dataset.queue("unlabelled", "ann") == [a]
    assert dataset.counts() == {"deleted": 1, "draft": 1, "rejected": 1}
    # What a person rejects of their own stays in sight, until the rejection is undone.
    labels.reject("cleo", a, "tilt")
    own = record().uuid
    labels.set("cleo", own, MOVED)
    labels.reject("cleo", own, "slip in grasp")
    assert dataset.queue("returned", "cleo") == [own, a]
    assert dataset.queue("returned", "ann") == [b]
    labels.undo("cleo")
    assert dataset.queue("returned", "cleo") == [a]
    with pytest.raises(InputError, match="no queue 'nothing'"):
        dataset.queue("nothing", "ann")


def test_all_episodes_are_filtered_and_ordered(dataset, record):
    labels, (a, b, c) = dataset.labels, [record(x, 0).uuid for x in (3000, -5000, 1000)]
    other = dataset.record(
        replace(dataset.read(c), episode_id="another"),
        Label(0, 0), source="commanded", context=context_for(dataset, "pot", "hex20"),
    ).uuid  # fmt: skip
    labels.accept("ann", a)
    labels.set("bob", b, Label(-5000, 0, 0, 100), note="Bent Corner")
    labels.flag("ann", c)
    dataset.scores.put("doubt", {a: 2.0, b: 9.0, c: 4.0}, "m")
    labels.set("bob", c, Label(1001, 0, 0, 100))  # a score of a former label does not count
    today = f"{datetime.now():%Y-%m-%d}"

    def found(text):
        return dataset.queue("all", "ann", wanted=text)

    for text, wanted in (
        ("", [other, c, b, a]), ("sort:oldest", [a, b, c, other]),
        ("sort:distance", [b, a, c, other]), ("sort:state", [b, c, other, a]),
        ("bottom:hex20", [other]), ("state:submitted", [a]), ("state:flagged", [c]),
        ("state:refused", []), ("person:bob", [c, b]), ("doubt:0 sort:doubt", [b, a]),
        ("doubt:5", [b]), ("corner BENT", [b]), ("nowhere", []), ("since:2999-01-01", []),
        (f"since:{today} until:{today} piece:pot", [other, c, b, a]), ("until:1999-01-01", []),
        ("sort:doubt", [b, a, c, other]),
    ):  # fmt: skip
        assert found(text) == wanted, text
    for text in ("colour:red", "since:yesterday", "sort:mood", "doubt:much",
                 "doubt:1 sort:uncertainty", 'person:"bob'):  # fmt: skip
        with pytest.raises(InputError, match="is no filter"):
            found(text)
    labels.delete("ann", other, "test")
    assert found("") == [c, b, a]
    dataset.scores.suggest({b: Label(-4000, 500, 0, 300)}, "m")
    beside = dataset.scores.beside([a, b], "doubt")
    assert beside[a] == ScoredLabel(Label(3000, 0, 0, 150), None, 2.0)
    assert beside[b].model == Label(-4000, 500, 0, 300)


def test_a_day_begins_at_local_midnight(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "NPT-5:45")
        time.tzset()
        values = parse_filter("since:2026-11-26 until:2026-11-26").values
    time.tzset()
    begin = 1_795_630_500 * 10**9  # 2026-11-25 18:15 UTC
    assert values == {"v0": begin, "v1": begin + 86_400 * 10**9, "score": ""}


def test_coverage_brings_the_emptiest_squares_first(dataset, record):
    labels = dataset.labels
    crowded = [record(100 * k, 100).uuid for k in range(4)]
    lonely = record(-100, 100).uuid
    other_pair = dataset.record(
        replace(dataset.read(lonely), episode_id="another"),
        Label(100, 100), source="commanded", context=context_for(dataset, "pot", "hex20"),
    ).uuid  # fmt: skip
    for uuid in crowded[:2]:
        labels.accept("ann", uuid)
        labels.approve("bob", uuid)
    assert dataset.queue("coverage", "ann") == [lonely, other_pair, *crowded[2:]]
    labels.accept("ann", lonely)
    labels.approve("bob", lonely)
    assert dataset.queue("coverage", "ann") == [other_pair, *crowded[2:]]


def test_injected_errors_come_first_in_the_queue_of_disagreement(dataset):
    uuids = fill(dataset, 1000)
    rng = np.random.default_rng(3)
    wrong = set(rng.choice(uuids, 20, replace=False).tolist())
    values = {}
    for uuid in uuids:
        head = dataset.labels.head(uuid)
        noise = rng.normal(0, 150, 2) + (2000 if uuid in wrong else 0)
        x, y = head.label.offset_mm * 1e3 + noise
        guess = Suggestion(Label(round(x), round(y), 0, 150), "model:m", 0)
        value = disagreement(head, guess)
        values[uuid] = value
    dataset.scores.put("disagreement", values, "m")
    first = dataset.queue("disagreement", "ann", limit=100)
    precision = len(wrong & set(first)) / 100
    base_rate = len(wrong) / len(uuids)
    assert precision == 0.2 > 5 * base_rate
    assert set(first[:20]) == wrong
    dataset.labels.set("ann", first[0], Label(1, 1))
    assert first[0] not in dataset.queue("disagreement", "ann")
    score = dataset.scores.of_revision("disagreement", first[1])
    assert score == (dataset.labels.head(first[1]).rev_uuid, values[first[1]])


def test_what_to_label_first_and_duplicate_signals(dataset, record):
    a, b, c = (record().uuid for _ in range(3))
    dataset.scores.put("training", {a: 0.1, b: 0.7, c: 0.4, "gone": 9.0}, "m")
    dataset.scores.put("duplicates", {a: 1.1, c: 7.5}, "m")
    assert dataset.queue("training", "ann") == [b, c, a]
    assert dataset.queue("duplicates", "ann") == [c, a]
    dataset.labels.set("ann", c, Label(5, 5))
    assert dataset.queue("training", "ann") == [b, c, a]
    dataset.labels.accept("ann", b)
    assert dataset.queue("training", "ann") == [c, a]
    with pytest.raises(InputError, match="no score"):
        dataset.scores.put("beauty", {a: 1.0}, "m")


def test_a_random_audit_is_a_share_that_its_seed_repeats(dataset):
    uuids = fill(dataset, 2000, approved=2000)
    first = dataset.queue("audit", "ann", seed=1)
    assert first == dataset.queue("audit", "bob", seed=1)
    assert first != dataset.queue("audit", "ann", seed=2)
    # The ids are random: half as much again is five standard deviations.
    assert len(first) == pytest.approx(AUDIT_SHARE * len(uuids), rel=0.5)
    assert first != sorted(first)


def test_gold_items_are_answered_once_and_never_by_their_author(dataset):
    fill(dataset, 500, approved=500)
    gold = dataset.queue("gold", "cleo", seed=4)
    assert gold
    dataset.labels.opinion("cleo", gold[0], Label(1, 1, 0, 100))
    assert dataset.queue("gold", "cleo", seed=4) == gold[1:]
    assert dataset.queue("gold", "ann", seed=4) == []


def test_every_queue_answers_on_an_empty_dataset(dataset):
    for name in QUEUES:
        assert dataset.queue(name, "ann") == []


def test_a_suggestion_is_no_label(dataset, record):
    entry = record()
    before = dataset.labels.history(entry.uuid)
    assert dataset.scores.suggestion(entry.uuid) is None
    dataset.scores.suggest({entry.uuid: Label(5, 6, 0, 700)}, "abc")
    found = dataset.scores.suggestion(entry.uuid)
    assert (found.label, found.source) == (Label(5, 6, 0, 700), "model:abc")
    assert dataset.labels.history(entry.uuid) == before


def test_entries_are_read_in_pages_and_counted_by_the_catalogue(dataset, monkeypatch):
    monkeypatch.setattr(episode_index, "PAGE", 7)
    uuids = fill(dataset, 30, approved=4)
    dataset.labels.delete("ann", uuids[3], "test")
    dataset.labels.delete("ann", uuids[20], "test")
    listed = dataset.episodes()
    assert list(dataset) == listed
    assert dataset.uuids() == {entry.uuid for entry in listed}
    assert dataset.entries([uuids[5], "none", uuids[3]]).keys() == {uuids[3], uuids[5]}
    every = dataset.episodes(EpisodeFilter(deleted=None))
    keys = ((e.piece, e.bottom, "deleted" if e.deleted else e.state, e.file_state) for e in every)
    counted = {tuple(one[:4]): one.episodes for one in dataset.count_by_pair()}
    assert counted == dict(Counter(keys))


SETTINGS = {"modality": "FT+Tac", "epochs": 2, "out": "pot.safetensors"}


def begin(dataset: Dataset, **changes: object) -> ActiveRun:
    return dataset.runs.begin("train", seed=7, settings=SETTINGS | changes)


def test_a_run_is_told_while_it_goes_on_and_after(dataset, tmp_path):
    live = begin(dataset)
    assert dataset.runs.entry(live.uuid).state == "running"
    assert list(check_dataset(dataset.parts)) == [], "a run that lives is left alone"
    live.metric("loss", 1, 0.5)
    live.end_epoch()
    assert [(m.name, m.step, m.value) for m in dataset.runs.metrics(live.uuid)] == [
        ("loss", 1, 0.5)
    ]
    live.metric("loss", 2, 0.25)
    live.metric("iou", 2, math.nan)
    model = tmp_path / "pot.safetensors"
    model.write_bytes(b"weights")
    live.artifact("model", model)
    live.finish("m" * 64)
    entry = dataset.runs.entry(live.uuid)
    assert (entry.state, entry.kind, entry.seed, entry.manifest) == (
        "finished", "train", 7, "m" * 64,
    )  # fmt: skip
    assert entry.params == SETTINGS
    assert entry.ended_ns >= entry.started_ns
    (made,) = entry.artifacts
    assert (made.path, made.bytes) == (str(model.resolve()), 7)
    assert made.sha256 == hashlib.sha256(b"weights").hexdigest()
    assert [m.value for m in dataset.runs.metrics(live.uuid, "loss")] == [0.5, 0.25]
    assert math.isnan(dataset.runs.metrics(live.uuid, "iou")[0].value)


def test_runs_are_listed_by_kind_the_newest_first(dataset):
    with begin(dataset) as first:
        first.finish()
    with dataset.runs.begin("evaluate", seed=0, settings={}) as other:
        other.finish()
    with begin(dataset) as second:
        second.finish()
    assert [e.uuid for e in dataset.runs.entries()] == [second.uuid, other.uuid, first.uuid]
    assert [e.uuid for e in dataset.runs.entries("train")] == [second.uuid, first.uuid]
    with pytest.raises(InputError, match="no such run"):
        dataset.runs.entry("elsewhere")


def test_what_did_not_end_by_itself_failed_or_was_cancelled(dataset):
    with pytest.raises(ValueError, match="too hot"), begin(dataset) as failed:
        raise ValueError("too hot")
    with pytest.raises(KeyboardInterrupt), begin(dataset) as stopped:
        raise KeyboardInterrupt
    states = {e.uuid: (e.state, e.reason) for e in dataset.runs.entries()}
    assert states == {failed.uuid: ("failed", "too hot"), stopped.uuid: ("cancelled", "")}


def test_a_run_needs_no_right_to_write_the_catalogue(dataset):
    with Dataset.open(dataset.folder, write=False) as reader:
        live = begin(reader)
        assert [e.uuid for e in reader.runs.entries()] == [live.uuid]
    live.metric("loss", 1, 0.5)
    assert [e.state for e in dataset.runs.entries()] == ["running"]
    live.finish()
    assert [e.state for e in dataset.runs.entries()] == ["finished"]
    assert len(dataset.runs.metrics(live.uuid)) == 1


def die_running(folder: Path, lines: int) -> str:
    """Begin a run in a child, write ``lines`` values and half a line, and kill it."""
    out, into = os.pipe()
    pid = os.fork()
    if not pid:
        with Dataset.open(folder, write=False) as dataset:
            live = begin(dataset)
        for step in range(lines):
            live.metric("loss", step, float(step))
        live._metrics.write('{"name": "lo')
        live._metrics.flush()
        os.write(into, live.uuid.encode())
        os.kill(os.getpid(), signal.SIGKILL)
    os.close(into)
    uuid = os.read(out, 100).decode()
    os.close(out)
    os.waitpid(pid, 0)
    return uuid


def test_a_killed_run_is_interrupted_at_the_next_start(tmp_path):
    Dataset.open(tmp_path / "data").close()
    uuid = die_running(tmp_path / "data", 3)
    with Dataset.open(tmp_path / "data", write=False) as reader:
        assert [f.kind for f in check_dataset(reader.parts)] == ["interrupted"]
    with Dataset.open(tmp_path / "data") as dataset:
        assert "--resume" in dataset.notices[0]
        entry = dataset.runs.entry(uuid)
        assert entry.state == "interrupted"
        assert entry.ended_ns is not None
        assert [m.value for m in dataset.runs.metrics(uuid)] == [0.0, 1.0, 2.0]
    with Dataset.open(tmp_path / "data") as dataset:
        assert dataset.notices == ()
        assert list(check_dataset(dataset.parts, whole=True)) == []


def test_a_folder_without_a_run_is_deleted_unless_it_has_values(dataset):
    runs = dataset.folder / RUNS_FOLDER
    for name in ("begun", "torn"):
        (runs / name).mkdir(parents=True)
    (runs / "torn" / METRICS_FILE).write_text("{")
    dataset.close()
    with Dataset.open(dataset.folder) as again:
        assert len(again.notices) == 1
        assert [path.name for path in runs.iterdir()] == ["torn"]


def test_an_unreadable_run_is_told_once_and_harms_nothing(dataset):
    live = begin(dataset)
    live.finish()
    (dataset.folder / RUNS_FOLDER / live.uuid / "run.json").write_text("{")
    dataset.close()
    with Dataset.open(dataset.folder) as again:
        assert "cannot be read" in again.notices[0]
    with Dataset.open(dataset.folder) as again:
        assert again.notices == ()


def test_runs_come_back_after_a_rebuild_and_after_a_restore(dataset):
    backup = dataset.backups.make("test")
    live = begin(dataset)
    live.metric("loss", 1, 0.5)
    live.finish()
    dataset.close()
    assert rebuild_dataset(dataset.folder, replace=True).equal
    with Dataset.open(dataset.folder) as again:
        assert len(again.runs.metrics(live.uuid)) == 1
    assert list_backups(dataset.folder / "backup")
    restore_backup(dataset.folder, backup)
    with Dataset.open(dataset.folder) as again:
        assert len(again.runs.metrics(live.uuid)) == 1
        assert again.runs.entry(live.uuid).params == SETTINGS


def test_the_chain_of_labels_is_written_into_the_run(dataset, record):
    record()
    live = begin(dataset)
    live.finish()
    newest = dataset.database.one("SELECT hash FROM op ORDER BY seq DESC LIMIT 1")[0]
    assert newest in json.dumps(dict(dataset.runs.entry(live.uuid).chain))


ROOT = Path(__file__).resolve().parents[3]
SMALL = 'mount -t tmpfs -o size=48m none "$0" && exec "$@"'


@pytest.mark.promise("D2")
@pytest.mark.slow
def test_labels_and_a_campaign_outlast_a_full_disk(tmp_path):
    try:
        allowed = subprocess.run(["unshare", "-Urm", "true"], check=False, capture_output=True)
    except FileNotFoundError:
        pytest.skip("only Linux has disks of one process")
    if allowed.returncode != 0:
        pytest.skip("this system gives users no disks of their own")
    child = [sys.executable, "-m", "tests.backend.annotations.small_disk", str(tmp_path)]
    inside = ["unshare", "-Urm", "sh", "-c", SMALL, str(tmp_path), *child]
    done = subprocess.run(inside, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    answer = json.loads(done.stdout.splitlines()[-1])
    labels, campaign = answer["labels"], answer["campaign"]
    assert labels["codes"] == ["DISK-FULL", "DISK-FULL"]
    assert labels["until_full"] > 0
    assert labels["episodes_when_full"] == 1
    assert (labels["lost"], labels["wrong"]) == ([], [])
    assert labels["states"] == ["complete"] * 2
    assert labels["journal"] == labels["operations"] == labels["until_full"] + 4
    assert campaign == {
        "paused": ["DISK-FULL"], "stored_when_paused": [1], "ending": ["finished"],
        "all_told": True, "ticks": [20, 20, 20], "wrong": [],
    }  # fmt: skip

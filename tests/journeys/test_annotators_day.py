"""Probes labelled by keys in the real window, killed twice, reviewed, handed on.

Nine of them: each way to decide at least once, two collected and the others simulated.
``DAY_PROBES=100`` in the environment makes it a hundred.
"""

from __future__ import annotations

import csv
import json
import os
import random
import shutil
import signal
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from tests.warm import WarmChild
from touchdown.backend.annotations import Dataset, Revision, check_dataset
from touchdown.backend.cli.command_line import main
from touchdown.backend.learning.training_runs import list_training_runs

PROBES = int(os.environ.get("DAY_PROBES", "9"))
COLLECTED, PACKED = 2, PROBES - 2
"""Probes through the devices of the bench, and from its mass simulation."""
KILLS = ((PROBES * 4 // 25, PROBES * 8 // 25), (PROBES * 12 // 25, PROBES * 18 // 25))
"""Between so many labelled episodes in all the window is killed."""
LATER_S = 0.15
FORMATS = ("csv", *(("lerobot",) if find_spec("pyarrow") and find_spec("av") else ()))
Told = dict[str, Any]
TILT, BY_MODEL = 3, 5
WHERE: dict[int, Callable[[int, int], tuple[int | None, int | None]]] = {
    0: lambda x, y: (x, y),
    1: lambda x, y: (x + 100, y),
    2: lambda x, y: (1500, -2250),
    3: lambda x, y: (x, y),
    4: lambda x, y: (x, y),
    5: lambda x, y: (None, None),  # wherever the model puts it
    6: lambda x, y: (x, y + 10 - 1000),
}
"""Displacement in µm that each way of ``annotator.decide`` makes of the one before."""


@dataclass
class Known:
    """What the window ever called saved, by which keys, and where it was killed."""

    saved: list[Told] = field(default_factory=list)
    ways: dict[str, int] = field(default_factory=dict)
    at: str = ""
    interrupted: set[str] = field(default_factory=set)

    def take(self, told: Told) -> None:
        if "saved" in told:
            self.saved.append(told)
        elif "way" in told:
            self.at = told["at"]
            self.ways[self.at] = told["way"]

    @property
    def decided(self) -> set[str]:
        return {told["saved"] for told in self.saved if told["state"] != "draft"}


@pytest.fixture
def first(folder) -> dict[str, Revision]:
    """The labels with which the day begins."""
    with Dataset.open(folder, create=False) as dataset:
        return {e.uuid: dataset.labels.head(e.uuid) for e in dataset.episodes()}


@pytest.fixture
def folder(isolated_settings, capsys) -> Path:
    """The dataset that the window opens by itself: of real probes and of simulated ones."""
    place = isolated_settings / "data" / "dataset"
    assert main(["collect", "--count", str(COLLECTED), "--probes-per-grip", "2", "--preset",
                 "quiet", "--person", "setup", "--json"]) == 0  # fmt: skip
    assert main(["simulate", "--bottoms", "circle15", "--episodes", str(PACKED), "--seed", "3",
                 "--workers", "1", "--out", str(place / "packs"), "--json"]) == 0  # fmt: skip
    capsys.readouterr()
    return place


class Window:
    """The application in a process of its own, used by the parts of a day."""

    def __init__(self, process: WarmChild) -> None:
        self.process = process

    def until(self, known: Known, enough: int | None) -> list[Told]:
        """Return what it told until its end, or until ``enough`` are decided and it was killed."""
        told, dying = [], None
        for line in self.process.stdout:
            if not line.endswith("\n"):
                break  # torn by the kill: nothing that was acknowledged
            told.append(json.loads(line))
            known.take(told[-1])
            assert "failed" not in told[-1], told[-1]["failed"]
            if enough is not None and dying is None and len(known.decided) >= enough:
                dying = threading.Timer(random.uniform(0, LATER_S), self.process.kill)
                dying.start()
        if dying is not None:
            dying.join()
        return told

    def close(self) -> int:
        """Return how it ended."""
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.kill()
        return self.process.wait(120)


@pytest.fixture
def window(open_window, tmp_path):
    """Return what starts the application for some parts of the day."""
    made: list[Window] = []

    def start(*parts: str) -> Window:
        made.append(Window(open_window([*parts], tmp_path / f"window-{len(made)}.log")))
        return made[-1]

    yield start
    for one in made:
        one.close()


def check_nothing_lost(folder: Path, known: Known, room: Path) -> list[str]:
    """Return what is still to be labelled; fails if anything acknowledged is not there.

    Looks at a copy, so that the next start finds the folder as the crash left it.
    """
    shutil.copytree(folder, room)
    last = {told["saved"]: told for told in known.saved}
    with Dataset.open(room, person="check") as dataset:
        assert dataset.labels.frozen == ""
        assert [e.file_state for e in dataset.episodes()] == ["complete"] * (COLLECTED + PACKED)
        for told in known.saved:
            revisions = {r.rev_uuid for r in dataset.labels.history(told["saved"])}
            assert told["rev"] in revisions
        for uuid, told in last.items():
            if uuid != known.at:
                assert_same(dataset.labels.head(uuid), told)
        # Saved and not yet said when the kill came: what the disk has of it now has to stay.
        known.saved.append(as_told(dataset.labels.head(known.at)))
        assert list(check_dataset(dataset.parts, whole=True)) == []
        return dataset.queue("unlabelled", "ann")


def as_told(head: Revision) -> Told:
    """Return a label as the window tells that it is saved."""
    return {
        "saved": head.episode, "rev": head.rev_uuid, "state": head.state, "x_um": head.label.x_um,
        "y_um": head.label.y_um, "person": head.person, "reason": head.reason,
        "source": head.source,
    }  # fmt: skip


def assert_same(head: Revision, told: Told) -> None:
    """Fail unless the label that holds is the one that the window called saved."""
    assert (head.state, head.source, head.person, head.reason) == (
        told["state"], told["source"], told["person"], told["reason"],
    )  # fmt: skip
    assert (head.label.x_um, head.label.y_um) == (told["x_um"], told["y_um"])


@pytest.mark.slow
def test_a_day_of_labelling(
    folder, first, window, tmp_path, capsys, monkeypatch, isolated_settings
):
    monkeypatch.setenv("TOUCHDOWN_CONFIG", str(isolated_settings / "config"))
    known, todo, order = Known(), list[str](), list[str]()
    for number, (least, most) in enumerate(KILLS):
        parts = ("arrive", "label") if number == 0 else ("arrive", "take-back", "label")
        app = window(*parts)
        begun = app.until(known, random.randint(least, most))[0]
        assert app.close() == -signal.SIGKILL
        order = order or begun["begun"]
        assert begun["first"] == (number == 0)  # later starts know who labels
        assert begun["begun"] == (todo or order)
        todo = check_nothing_lost(folder, known, tmp_path / f"look-{number}")
        assert todo == order[-len(todo) :]  # what was decided is gone from the front, in order
        known.interrupted.add(known.at)
        assert todo[0] in (known.at, order[order.index(known.at) + 1])
    app = window("arrive", "take-back", "label", "four-eyes", "review", "correct", "train")
    told = app.until(known, None)
    assert app.close() == 0
    assert told[0]["begun"] == todo
    assert set(known.ways.values()) == set(range(7))
    assert set(known.ways) == set(order) == set(first)
    assert len(order) == COLLECTED + PACKED
    assert known.decided == set(order)
    assert not [code for code in told[-1]["cards"] if code.startswith("BUG")]
    refused = next(t for t in told if "refused" in t)
    assert "ann wrote it: another person has to review it" in refused["refused"]
    approved = check_reviewed(folder, known, told)
    check_keys(known, first, told)
    check_training(folder, approved)
    check_exports(folder, approved, tmp_path, capsys)


def check_reviewed(folder: Path, known: Known, told: list[Told]) -> dict[str, Revision]:
    """Return the labels that were approved, each by another person than its author."""
    waiting = next(t["waiting"] for t in told if "waiting" in t)
    corrected = next(t["corrected"] for t in told if "corrected" in t)
    last = {told["saved"]: told for told in known.saved}
    with Dataset.open(folder, create=False) as dataset:
        assert list(check_dataset(dataset.parts, whole=True)) == []
        heads = {e.uuid: dataset.labels.head(e.uuid) for e in dataset.episodes()}
        for uuid, head in heads.items():
            assert_same(head, last[uuid])
        approved = {uuid: head for uuid, head in heads.items() if head.state == "approved"}
        assert set(approved) == set(waiting)
        for uuid in approved:
            states = [(r.state, r.person) for r in dataset.labels.history(uuid)]
            assert states[-1] == ("approved", "bob")
            assert states[-2] == ("submitted", "ann")
            assert (("rejected", "bob") in states) == (uuid in corrected)
        left = Counter(head.state for head in heads.values())
        assert left == {"approved": len(waiting), "rejected": COLLECTED + PACKED - len(waiting)}
        assert corrected
    return approved


def check_keys(known: Known, first: dict[str, Revision], told: list[Told]) -> None:
    """The labels are those that the keys mean, counted here from the labels of the beginning."""
    corrected = next(t["corrected"] for t in told if "corrected" in t)
    last = {told["saved"]: told for told in known.saved}
    for uuid, way in known.ways.items():
        if uuid in known.interrupted:
            continue  # a nudge before the crash, and another after it
        was, now = first[uuid], last[uuid]
        assert was.state == "draft"
        assert (now["state"], now["reason"]) == (
            ("rejected", "tilt") if way == TILT else ("approved", None)
        )
        x_um, y_um = WHERE[way](was.label.x_um, was.label.y_um)
        if uuid in corrected:
            x_um = None if x_um is None else x_um - 1000
        assert (now["x_um"], now["y_um"]) == (x_um or now["x_um"], y_um or now["y_um"])
        moved = way in (1, 2, 6) or uuid in corrected
        source = "human" if moved else "model" if way == BY_MODEL else was.source
        assert now["source"].partition(":")[0] == source


def said(words: list[str], capsys) -> Told:
    """Return what a verb answers."""
    assert main([*words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def check_training(folder: Path, approved: dict[str, Revision]) -> None:
    """The model of the Train page learned from exactly the approved labels."""
    (run,) = list_training_runs(folder)
    assert run.state == "finished"
    assert run.model.stat().st_size > 10_000
    assert len(run.curves["validation_loss"]) == 2
    manifest = json.loads((run.folder / "manifest.json").read_text())
    assert {e["episode"]: e["revision"] for e in manifest["episodes"]} == revisions(approved)
    assert {e["split"] for e in manifest["episodes"]} == {"train", "held out"}


def check_exports(folder: Path, approved: dict[str, Revision], room: Path, capsys) -> None:
    """Exactly the approved labels are handed on."""
    for name in FORMATS:
        out = room / name
        answer = said(["export", name, "--out", str(out), "--video", "none"], capsys)
        assert answer["episodes"] == len(approved)
        manifest = json.loads((out / "manifest.json").read_text())
        assert {e["uuid"]: e["rev_uuid"] for e in manifest["episodes"]} == revisions(approved)
        assert {e["state"] for e in manifest["episodes"]} == {"approved"}
    with (room / "csv" / "episodes.csv").open(encoding="utf-8") as file:
        rows = {
            row["uuid"]: (float(row["x_mm"]), float(row["y_mm"])) for row in csv.DictReader(file)
        }
    assert rows == {uuid: tuple(head.label.offset_mm) for uuid, head in approved.items()}


def revisions(approved: dict[str, Revision]) -> dict[str, str]:
    return {uuid: head.rev_uuid for uuid, head in approved.items()}

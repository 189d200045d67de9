"""A nudge on gold outlives the window, as one on the rest does, and nothing tells the two apart."""

from __future__ import annotations

import json
import shutil
import signal
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from tests.backend.annotations.conftest import context_for, small_episode
from touchdown.backend.annotations.agreement import compare_with_control_items
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.annotations.reconciliation import check_dataset
from touchdown.backend.annotations.training_set import labelled_episodes
from touchdown.backend.annotations.values import Label

Told = dict[str, Any]
WAITING = 21  # ordinary episodes: enough for one of gold among them


@pytest.fixture
def folder(isolated_settings, monkeypatch) -> Path:
    """The dataset that the window opens by itself; people, once asked for, stay."""
    monkeypatch.setenv("TOUCHDOWN_CONFIG", str(isolated_settings / "config"))
    return isolated_settings / "data" / "dataset"


@pytest.fixture
def chosen(folder) -> list[str]:
    """An ordinary episode and a gold one, recorded with the same label."""
    with Dataset.open(folder, person="setup") as dataset:
        context, label = context_for(dataset), Label(1000, -500, 0, 150)

        def record() -> str:
            episode = small_episode()
            return dataset.record(episode, label, source="commanded", context=context).uuid

        while not dataset.queue("gold", "ann"):
            uuid = record()
            dataset.labels.accept("bob", uuid, Label(4000, 4000, 0, 50))
            dataset.labels.approve("cleo", uuid)
        return [[record() for _ in range(WAITING)][3], uuid]


@pytest.fixture
def window(open_window, tmp_path):
    """Return a function that plays parts and returns what the window told.

    The window is killed when it has told ``deadly`` looks, ends by itself if that is None.
    """
    logs = count()

    def play(*parts: str, deadly: int | None = None) -> list[Told]:
        process = open_window(["arrive", *parts], tmp_path / f"{next(logs)}.log")
        told: list[Told] = []
        for line in process.stdout:
            if line.endswith("\n"):
                told.append(json.loads(line))
                assert "failed" not in told[-1], told[-1]["failed"]
            if deadly is not None and sum("saw" in one for one in told) == deadly:
                process.kill()
                break
        process.stdin.close()
        process.stdout.close()
        assert process.wait(120) == (0 if deadly is None else -signal.SIGKILL)
        return told

    return play


def seen(told: list[Told], uuid: str) -> list[Told]:
    """Return all that was shown of one episode, without what may differ between any two."""
    looks = [one for one in told if one.get("saw") == uuid]
    return [{k: v for k, v in look.items() if k not in ("saw", "at", "when")} for look in looks]


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_kill_loses_no_nudge_on_gold_and_undo_reaches_behind_it(
    folder, chosen, monkeypatch, window
):
    plain, gold = chosen
    monkeypatch.setenv("CHOSEN", ",".join(chosen))
    before = window("nudge", deadly=4)
    after = window("take-back-chosen", "do-again")
    for told in (before, after):
        assert seen(told, gold) == seen(told, plain)
    for uuid in chosen:
        # In its place and with its time, before the crash and after it.
        ((at, _),) = {(t["at"], t["when"]) for t in (*before, *after) if t.get("saw") == uuid}
        assert at < len(before[0]["begun"])
    fresh, nudged = seen(before, gold)
    left, taken_back, *again = seen(after, gold)
    assert (fresh["strip"][-1], nudged["strip"][-1]) == ("rev 1", "rev 2")
    assert left["versions"] == nudged["versions"]
    assert [len(look["versions"]) for look in (left, taken_back, *again)] == [2, 3, 4, 4]
    assert taken_back["row"] == fresh["row"]
    assert again[-1]["basis"] == nudged["basis"]
    with Dataset.open(folder, create=False) as dataset:
        assert list(check_dataset(dataset.parts, whole=True)) == []
        head = dataset.labels.head(gold)
        assert (head.state, head.person, head.label.x_um) == ("approved", "cleo", 4000)
        assert "ann" not in {r.person for r in dataset.labels.history(gold)}
        assert dataset.labels.head(plain).label.x_um == 1100
        counting = {
            e.row.episode: e.label.x_um for e in labelled_episodes(dataset.database, "submitted")
        }
        assert (counting[gold], counting[plain]) == (4000, 1100)
        found = compare_with_control_items(dataset.database, dataset.geometry, "ann")
        assert found.episodes == 1
        assert found.bias_x_mm.mean == pytest.approx(1.1 - 4)


KILLS = 20


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_no_nudge_is_lost_where_the_window_is_killed_0_6_s_after_it(monkeypatch, window, tmp_path):
    """Each window is the first of its person, who has not said how sure they are."""
    recorded = tmp_path / "recorded"
    with Dataset.open(recorded, person="setup") as dataset:
        label = Label(1000, -500, 0, 150)
        dataset.record(small_episode(), label, source="commanded", context=context_for(dataset))
    for number in range(KILLS):
        # A dataset of its own: no window pages through the episodes of those before.
        home = tmp_path / f"home-{number}"
        shutil.copytree(recorded, home / "data" / "dataset")
        monkeypatch.setenv("TOUCHDOWN_CONFIG", str(home / "config"))
        monkeypatch.setenv("TOUCHDOWN_DATA", str(home / "data"))
        told = window("nudge-and-die", deadly=-1)
        nudged = next(one for one in told if "nudged" in one)
        with Dataset.open(home / "data" / "dataset", create=False) as dataset:
            label = dataset.labels.head(nudged["nudged"]).label
        assert (label.x_um, label.sigma_um) == (nudged["x_um"], 200), number

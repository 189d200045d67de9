"""Every event survives the event log; an incomplete or foreign log gives one clear error."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from touchdown.backend.core import events, values
from touchdown.backend.core.faults import Fault, InputError
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, EventLog, read_events

EPISODE = values.Episode(
    episode_id="e1",
    piece="pot",
    observation=np.arange(20 * 258, dtype=np.float32).reshape(20, 258),
    offset_mm=np.array([1.5, -2.25]),
    onset_s=3.25,
    quality=values.EpisodeQuality(True, (), 1, 0.01, 0, 12.5, 0.02),
    metadata=(("grip_id", "g1"),),
)
PATCH = values.ContactPatch(np.array([[0.0, 1.0], [2.0, 3.0]]), np.array([0.1, 0.9]))
BELIEF = values.BeliefMap(
    np.linspace(-3, 3, 12).reshape(3, 4), np.eye(3, 4, dtype=bool), (-1.0, 2.0), 1.0, 2
)
STABILITY = values.Stability(
    True, 0.75, values.SupportKind.AREA, np.array([[0.0, 0], [1, 0], [0, 1]]), (0.2, 0.3), "belief"
)
ACTION = values.PlaceAction("shift", (1.0, -2.0), (4.0, 5.0), True, "why")
FALL = values.Fall(np.array([0.0, 0.1]), np.zeros((2, 1, 7)), ("pot",))
ALL = [
    events.RunStarted(0.0, "r", "pot", "short", "paper", 7, 2, True, "{}"),
    events.TrialStarted(0.1, 1, 7, (1.0, 2.0)),
    events.TrialStarted(0.1, 1, 7, None),
    events.PhaseEntered(0.2, "press", 1),
    events.EpisodeRecorded(0.3, EPISODE, 1, "e1.mcap"),
    events.PatchEstimated(0.4, PATCH, (1.5, -2.25), 1),
    events.BeliefUpdated(0.5, BELIEF, 1),
    events.StabilityJudged(0.6, STABILITY, 1),
    events.StabilityJudged(
        0.6,
        values.Stability(
            False, -math.inf, values.SupportKind.NONE, np.zeros((0, 2)), (0.0, 0.0), "patch"
        ),
        1,
    ),
    events.ActionChosen(0.7, ACTION, 1, 3.5),
    events.ApprovalAwaited(0.8, dataclasses.replace(ACTION, target_mm=None), 1),
    events.Released(0.9, 1, False, -1.25, FALL),
    events.Released(0.9, 1, True, None, None),
    events.TrialFinished(1.0, 1, 7, values.Outcome.FELL, "because", 3, None, -1.25),
    events.CalibrationMeasured(
        2.9, "payload", ("mass_kg",), (1.5,), (0.01,), ("kg",), (0.1, 0.05), 0.1, 0.3, "N", "", ""
    ),
    events.FaultRaised(1.1, Fault("X", "what", "so", "then", "arm")),
    events.FaultsReset(1.2),
    events.Progress(1.3, 1, 2, "half"),
    events.Said(1.4, "words"),
    events.RunFinished(1.5, "r", "finished", "done"),
    events.CampaignBegan(1.6, "c", "s", "/data", 3, 20),
    events.Gripped(1.7, 1, 2, 16.5),
    events.OriginChecked(1.8, (0.1, -0.2), 0.05, True),
    events.DecisionAwaited(1.9, "u", 4),
    events.HandOverAwaited(1.95, "pot", gives=True),
    events.MountingAwaited(1.97, "circle15", 2),
    events.ProbeCollected(
        2.0, "u", 4, 1, 4, 20, (1.0, 2.0), (1.1, 2.1), 0.15, (1.0, 2.0, 0.1, 0.2, 9.0), 0.0, 0.1, ""
    ),
    events.Refused(2.2, "IN-CONTACT", "words"),
    events.EpisodeDecided(2.1, "u", 4, "keep", "ann"),
    events.Paused(2.3, Fault("DISK-LOW", "what", "so", "then", "disk")),
    events.Noticed(2.35, Fault("FT-DRIFT", "what", "so", "then", "force_torque")),
    events.SetUpAwaited(2.4, "pot", "short", (1.0, -2.0), holds=False),
    events.OutcomeAwaited(2.5, values.Outcome.PLACED, "why"),
    events.PhotoKept(2.6, 1, "trial-1.jpg"),
]


def same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(
            same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a)
        )
    return a == b


def written(folder: Path) -> Path:
    journal = EventLog(folder)
    for fact in ALL:
        journal(fact)
    journal.close()
    return folder


def test_every_kind_of_fact_is_in_the_test() -> None:
    kinds = {
        value
        for value in vars(events).values()
        if isinstance(value, type) and issubclass(value, events.Event) and value is not events.Event
    }
    assert kinds == {type(fact) for fact in ALL}


def test_all_facts_come_back_equal(tmp_path: Path) -> None:
    back = list(read_events(written(tmp_path / "run")))
    assert len(back) == len(ALL)
    for before, after in zip(ALL, back, strict=True):
        assert same(before, after), type(before).__name__


def test_a_torn_last_line_costs_that_line_only(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    content = (folder / EVENT_LOG_NAME).read_bytes()
    lines = content.splitlines(keepends=True)
    for cut in (1, 10, len(lines[-1]) - 1):
        (folder / EVENT_LOG_NAME).write_bytes(content[:-cut])
        assert len(list(read_events(folder))) == len(ALL) - 1


def test_damage_in_the_middle_names_file_and_line(tmp_path: Path) -> None:
    folder = written(tmp_path / "run")
    lines = (folder / EVENT_LOG_NAME).read_bytes().splitlines(keepends=True)
    lines[5] = b'{"kind": "PatchEst\n'
    (folder / EVENT_LOG_NAME).write_bytes(b"".join(lines))
    with pytest.raises(InputError, match="line 6"):
        list(read_events(folder))


@pytest.mark.parametrize(
    "change",
    [
        {"dtype": "object"},
        {"data": "not base64!"},
        {"shape": [999]},
    ],
)
def test_a_forged_array_is_refused(tmp_path: Path, change: dict[str, object]) -> None:
    folder = written(tmp_path / "run")
    lines = (folder / EVENT_LOG_NAME).read_bytes().splitlines()
    line = json.loads(lines[6])
    line["patch"]["probability"].update(change)
    lines[6] = json.dumps(line).encode()
    (folder / EVENT_LOG_NAME).write_bytes(b"\n".join(lines) + b"\n")
    with pytest.raises(InputError, match="Damaged event PatchEstimated"):
        list(read_events(folder))


def test_foreign_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no event log"):
        list(read_events(tmp_path))
    (tmp_path / EVENT_LOG_NAME).write_text('{"program": "other"}\n')
    with pytest.raises(InputError, match="not a Touchdown event log"):
        list(read_events(tmp_path))


def test_an_existing_run_is_never_written_over(tmp_path: Path) -> None:
    written(tmp_path / "run")
    with pytest.raises(FileExistsError):
        EventLog(tmp_path / "run")


def test_each_fact_is_on_the_disk_before_the_next_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each line has its own sync, at which all previous lines are in the file."""
    path, synced = tmp_path / "run" / EVENT_LOG_NAME, []
    fsync = os.fsync

    def noted(handle: int) -> None:
        if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
            synced.append(path.read_bytes().count(b"\n"))
        fsync(handle)

    monkeypatch.setattr(os, "fsync", noted)
    journal = EventLog(tmp_path / "run")
    for fact in ALL[:3]:
        journal(fact)
    assert synced == [1, 2, 3, 4]
    journal.close()

"""Photos of a trial: none is overwritten, and a full disk leaves no partial file."""

from __future__ import annotations

import errno
import os
import threading
import time
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.reader import make_reader

from tests.backend.bench.brisk import brisk_bench, brisk_method, brisk_session
from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.annotations.dataset import Dataset
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.core import Event, EventBus, Fault, InputError, PhaseEntered, Said
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.episodes import read_episode, read_first
from touchdown.backend.runs import recorder as store_module
from touchdown.backend.runs.event_log import EVENT_LOG_NAME, read_events
from touchdown.backend.runs.motions import wait_until_durable
from touchdown.backend.runs.recorder import (
    BOOKMARKS_NAME,
    CLOCK_SET,
    Bookmark,
    RecordingOptions,
    RunRecorder,
    RunStore,
    keep_bookmark,
    keep_photo,
    read_bookmarks,
)
from touchdown.backend.runs.requests import CollectRequest, SceneChoice

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def picture(tmp_path: Path) -> Path:
    path = tmp_path / "picture.PNG"
    path.write_bytes(PNG + b"first")
    return path


def test_a_picture_that_was_taken_away_leaves_the_others_in_place(tmp_path, picture):
    first, second = (keep_photo(tmp_path / "run", 3, picture) for _ in range(2))
    first.unlink()
    picture.write_bytes(PNG + b"third")
    third = keep_photo(tmp_path / "run", 3, picture)
    assert (second.name, third.name) == ("trial-003-2.png", "trial-003-3.png")
    assert second.read_bytes() == PNG + b"first"
    assert third.read_bytes() == PNG + b"third"


def test_a_closed_record_is_left_alone_until_the_next_run(tmp_path):
    recorder = RunRecorder(RecordingOptions(tmp_path), EventBus(), Interlock())
    for run in ("first", "second"):
        before = recorder.store
        recorder.close()
        assert recorder.store is before, "nothing was open"
        recorder.open(run, "stepped", "{}")
        during = recorder.store
        recorder.close()
        assert recorder.store not in (before, during)
        assert (tmp_path / run / EVENT_LOG_NAME).exists()


@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_full_disk_is_said_and_leaves_nothing(tmp_path, picture, monkeypatch, call):
    kept = keep_photo(tmp_path / "run", 3, picture)

    def full(*_args: object, **_named: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os if call == "fsync" else Path, call, full)
        with pytest.raises(InputError, match="No space left") as caught:
            keep_photo(tmp_path / "run", 3, picture)
    assert caught.value.where == str(kept.with_name("trial-003-2.png"))
    assert sorted(kept.parent.iterdir()) == [kept]
    assert keep_photo(tmp_path / "run", 3, picture).name == "trial-003-2.png"


@pytest.fixture
def slow(tmp_path, monkeypatch):
    """Episode store with a write that ends once ``done`` is set."""
    done = threading.Event()
    monkeypatch.setattr(store_module, "write_episode", lambda *_, **__: done.wait(30.0))
    store = RunStore(tmp_path, {})
    store.keep(SimpleNamespace(episode_id="one"))
    yield store, done
    done.set()
    store.close()


def test_a_plan_goes_on_waiting_by_steps_until_the_episode_is_written(slow):
    store, done = slow
    plan = wait_until_durable(SimpleNamespace(store=store, real_time=True))
    waiting = next(plan)
    assert not waiting.until()
    done.set()
    store._pending.result(30.0)
    assert waiting.until()
    with pytest.raises(StopIteration) as ended:
        next(plan)
    assert ended.value.value.name == "one.mcap"


def test_a_stepped_bench_lets_no_time_of_its_own_pass(slow):
    store, done = slow
    threading.Timer(0.05, done.set).start()
    with pytest.raises(StopIteration) as ended:
        next(wait_until_durable(SimpleNamespace(store=store, real_time=False)))
    assert ended.value.value.name == "one.mcap"


POWER = Fault("WSG-DEVICE", "Its supply voltage is out of range.", "It stands.", "Look at it.")


@dataclass
class Failing:
    """Gripper that reports a fault."""

    state: DeviceState = DeviceState.READY
    fault: Fault | None = None


def test_a_fault_of_a_device_is_latched_with_the_next_step():
    session = simulated_session(SimulatedBenchChoice(), keep=RecordingOptions(None))
    session.prepare(SceneChoice("pot", ("short",), 1))
    gripper = Failing()
    devices = {**session.devices, "gripper": gripper}
    session._stage = replace(session._stage, devices=devices)
    session.advance()
    assert not session.interlock.latched
    gripper.state, gripper.fault = DeviceState.FAULT, POWER
    session.advance()
    assert [fault.code for fault in session.interlock.faults] == ["WSG-DEVICE"]
    session.close()


HOUR_NS = 3600 * 1_000_000_000


def recorded(folder: Path, monkeypatch: pytest.MonkeyPatch, back_ns: int) -> tuple[bytes, int]:
    """Collect one probe while the clock is set back; return its values and time."""
    keep = RecordingOptions(folder / "runs", episodes=False)
    session = simulated_session(brisk_bench("quiet"), keep=keep, method=brisk_method())
    clock, clock_ns = time.time, time.time_ns

    def set_back(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press":
            monkeypatch.setattr(time, "time", lambda: clock() - 1e-9 * back_ns)
            monkeypatch.setattr(time, "time_ns", lambda: clock_ns() - back_ns)

    session.events.subscribe(set_back)
    with Dataset.open(folder / "dataset", person="ann") as dataset:
        session.dataset = dataset
        session.run(CollectRequest(seed=2, person="ann", count=1))
        (entry,) = dataset.episodes()
        episode = dataset.read(entry.uuid)
    session.close()
    monkeypatch.undo()
    (run,) = (folder / "runs").iterdir()
    told = [fact.text for fact in read_events(run) if isinstance(fact, Said)]
    jumps = [text for text in told if "clock of this computer" in text]
    assert jumps == ([CLOCK_SET.format(-1e-9 * back_ns)] if back_ns else [])
    assert np.isfinite(episode.observation).all()
    return episode.observation.tobytes(), entry.recorded_ns


@pytest.mark.promise("P2")
def test_a_clock_set_back_by_an_hour_in_mid_press_changes_no_number_and_no_order(
    tmp_path, monkeypatch
):
    plain, _ = recorded(tmp_path / "plain", monkeypatch, 0)
    jumped, at_ns = recorded(tmp_path / "jumped", monkeypatch, HOUR_NS)
    assert jumped == plain
    # The time of the recording is what the wall said, and tells of the jump.
    assert time.time_ns() - at_ns > HOUR_NS // 2


def test_recordings_are_logged_by_the_wall_clock_and_keep_the_bench_clock(tmp_path):
    before_ns = time.time_ns()
    with brisk_session() as session, Dataset.open(tmp_path / "ds") as dataset:
        session.dataset = dataset
        session.run(CollectRequest(seed=2, person="ann", count=1))
        collected = dataset.folder / dataset.episodes()[0].path
    stacking = OracleSession(runs=tmp_path / "runs")
    stacking.session.run(request())
    stacking.session.close()
    probed = next((tmp_path / "runs").glob("*/episodes/*.mcap"))
    for path in (collected, probed):
        contents, onset_s = read_first(path), read_episode(path).onset_s
        start_ns = int(contents.metadata["clock"]["utc_minus_monotonic_ns"])
        assert before_ns <= start_ns <= time.time_ns()
        assert contents.metadata["bench"]["clock_start_ns"] == str(start_ns)
        with path.open("rb") as file:
            logged = {m.log_time for _, c, m in make_reader(file).iter_messages() if c.id == 3}
        assert logged == {start_ns + round(1e9 * onset_s)}


def test_a_bookmark_is_whole_on_the_disk_at_every_instant(tmp_path, monkeypatch):
    path = tmp_path / "run" / BOOKMARKS_NAME
    assert read_bookmarks(path) == []
    first, later = Bookmark(1, 3.25, "slipped?"), Bookmark(2, 1.0, "new gel")
    keep_bookmark(path, later)
    assert keep_bookmark(path, first) == read_bookmarks(path) == [first, later]
    with monkeypatch.context() as patch:
        # As a kill or a full disk before the rename: the former file stays.
        patch.setattr(Path, "replace", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
        with pytest.raises(InputError, match="cannot be stored: full"):
            keep_bookmark(path, Bookmark(1, 9.0, "lost"))
    assert read_bookmarks(path) == [first, later]
    changed = Bookmark(1, 3.25, "it slipped")
    assert keep_bookmark(path, changed) == [changed, later]
    assert keep_bookmark(path, Bookmark(1, 3.25)) == [later]
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize(
    "content", ["", "[]", '{"bookmarks": 3}', '{"bookmarks": [{"trial": 1}]}',
                '{"bookmarks": [{"trial": 1, "t_s": NaN, "note": "a"}]}'],
)  # fmt: skip
def test_bookmarks_that_cannot_be_read_are_left_alone(tmp_path, content):
    path = tmp_path / BOOKMARKS_NAME
    path.write_text(content)
    with pytest.raises(InputError, match="bookmarks cannot be read"):
        keep_bookmark(path, Bookmark(1, 1.0, "a"))
    assert path.read_text() == content

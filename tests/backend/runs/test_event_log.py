"""A disk that fills up while stacking pauses the run until there is space."""

from __future__ import annotations

import dataclasses
import errno
import json
import math
import os
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_method, on
from tests.backend.runs.oracle_bench import Oracle, OracleSession, request
from touchdown.backend.annotations import storage
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config import Limits
from touchdown.backend.config.method import (
    FusedSettings,
    PolicySettings,
    StackSettings,
    TowerSettings,
)
from touchdown.backend.core import events, values
from touchdown.backend.core.events import (
    ActionChosen,
    ApprovalAwaited,
    BeliefUpdated,
    EpisodeRecorded,
    Event,
    FaultRaised,
    PatchEstimated,
    Paused,
    PhaseEntered,
    Released,
    RunFinished,
    RunStarted,
    Said,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.faults import Fault, InputError, RefusedError
from touchdown.backend.core.values import ContactPatch, Episode, Outcome
from touchdown.backend.devices import ArmPress, CommandedMotion, JogOrder, PressCommand
from touchdown.backend.devices.melfa.faults import VOID
from touchdown.backend.episodes.episode_mcap import read_episode
from touchdown.backend.rig.safety import LAPSED
from touchdown.backend.runs import RecordingOptions, RunState, SceneChoice, excluding_fault
from touchdown.backend.runs.event_log import (
    EVENT_LOG_NAME,
    LIMIT_LOG_NAME,
    EventLog,
    encode_event,
    log_limit_change,
    read_events,
)
from touchdown.backend.simulation.devices.arm import SimArm

ROOT = Path(__file__).resolve().parents[3]
CHILD = """
import json, resource, sys
from pathlib import Path
from touchdown.backend.core.events import EpisodeRecorded, Paused
from tests.backend.runs.oracle_bench import OracleSession, request

bench = OracleSession(runs=Path(sys.argv[1]))
hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]

def fill(fact):
    # After each episode no file grows beyond 1 MB, until there is room: an episode takes 4.
    if isinstance(fact, EpisodeRecorded):
        resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, hard))
    elif isinstance(fact, Paused) and sys.argv[3] == "resume":
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
        bench.session.engine.resume()

bench.session.events.subscribe(fill)
bench.session.run(request(seed=int(sys.argv[2]), trials=1))
bench.session.close()
codes = [fault.code for fault in bench.session.interlock.faults]
print(json.dumps([codes, bench.benches[-1].truth().stands, str(bench.session.run_folder)]))
"""


def _stacked(folder: Path, seed: int, then: str) -> tuple[list[str], bool, list[Event]]:
    """Return the latched fault codes, whether the piece stands, and the events."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(folder), str(seed), then],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""
    codes, stands, run = json.loads(done.stdout)
    return codes, stands, list(read_events(Path(run)))


@pytest.mark.promise("D2", "W18")
@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
def test_a_full_disk_pauses_the_run_which_goes_on_and_loses_nothing(tmp_path):
    codes, stands, told = _stacked(tmp_path, 3, "resume")
    assert codes == []
    assert stands is True
    pauses = [fact for fact in told if isinstance(fact, Paused)]
    assert {fact.fault.code for fact in pauses} == {"DISK-FULL"}
    assert all("in memory" in fact.fault.consequence for fact in pauses)
    trial, run = told[-2:]
    assert (trial.outcome, run.ending) == (Outcome.PLACED, "finished")
    recorded = [fact for fact in told if isinstance(fact, EpisodeRecorded)]
    assert [fact.probe for fact in recorded] == list(range(1, trial.probes + 1))
    files = sorted(tmp_path.glob("*/episodes/*"))
    assert sorted(fact.path for fact in recorded) == [file.name for file in files]
    assert all(read_episode(file).quality.accepted for file in files)


@pytest.mark.skipif(sys.platform == "win32", reason="needs limits of POSIX")
def test_what_was_placed_stays_placed_where_nobody_makes_room(tmp_path):
    # The second probe of this seed is the one that lets go: its episode is refused afterwards.
    codes, stands, told = _stacked(tmp_path, 10, "give up")
    assert codes == ["DISK-FULL"]
    assert stands is True
    assert [type(fact) for fact in told[-4:]] == [Paused, FaultRaised, TrialFinished, RunFinished]
    fault, trial, run = told[-3:]
    assert str(tmp_path) in fault.fault.next_step
    assert (trial.outcome, run.ending) == (Outcome.PLACED, "failed")
    assert "The episode cannot be written" in run.reason
    # The one before is whole, and of the refused one nothing is left.
    (recorded,) = [fact for fact in told if isinstance(fact, EpisodeRecorded)]
    (file,) = tmp_path.glob("*/episodes/*")
    assert file.name == recorded.path
    assert read_episode(file).quality.accepted


@pytest.mark.promise("D2", "W18")
def test_a_run_is_refused_below_1_gb_and_pauses_before_the_next_probe_below_half_of_it(
    tmp_path, monkeypatch
):
    usage = SimpleNamespace(free=900_000_000)
    monkeypatch.setattr(storage.shutil, "disk_usage", lambda _place: usage)
    bench = OracleSession(runs=tmp_path)
    with pytest.raises(InputError, match=r"Only 0\.90 GB are free; recording needs 1\.00 GB"):
        bench.session.run(request())
    assert bench.of(PhaseEntered) == []
    assert list(tmp_path.iterdir()) == []
    usage.free = 10**12
    states: list[tuple[RunState, str]] = []

    def watch(fact: Event) -> None:
        if isinstance(fact, EpisodeRecorded):
            usage.free = 420_000_000
        elif isinstance(fact, Paused):
            states.append((bench.session.status().state, fact.fault.what))

    bench.session.events.subscribe(watch)
    bench.session.run(request())
    bench.session.close()
    # Nobody resumed it: a run without a window ends, lifted, and says why.
    assert [state for state, _ in states] == [RunState.PAUSED]
    assert "Only 0.42 GB" in states[0][1]
    end = bench.of(RunFinished)[-1]
    assert end.ending == "cancelled"
    assert "0.42 GB" in end.reason
    assert len(bench.of(EpisodeRecorded)) == 1
    assert bench.session.interlock.faults == ()


@pytest.mark.promise("D2")
def test_a_journal_without_room_is_held_in_memory_and_written_in_order(tmp_path, monkeypatch):
    bench = OracleSession(runs=tmp_path)
    plain, full = EventLog._append, []

    def torn(journal: EventLog, line: dict[str, object]) -> None:
        if full:
            with (journal.folder / EVENT_LOG_NAME).open("ab") as file:
                file.write(b'{"torn":')
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(journal, line)

    def watch(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press":
            full.append(fact)
        elif isinstance(fact, Paused):
            full.clear()
            bench.session.engine.resume()

    monkeypatch.setattr(EventLog, "_append", torn)
    bench.session.events.subscribe(watch)
    bench.session.run(request())
    folder = bench.session.run_folder
    bench.session.close()
    # Before the second probe and at the end: both presses had filled the disk.
    assert [fact.fault.device for fact in bench.of(Paused)] == ["store", "store"]
    assert [encode_event(fact) for fact in read_events(folder)] == [
        encode_event(fact) for fact in bench.facts
    ]
    assert bench.session.interlock.faults == ()


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
    events.PieceWeighed(2.8, 150.2, 0.4, (2.4, -1.6), (0.5, 0.2)),
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
    return folder


def test_events_of_every_kind_come_back_equal(tmp_path):
    classes = [value for value in vars(events).values() if isinstance(value, type)]
    kinds = {cls for cls in classes if issubclass(cls, events.Event)} - {events.Event}
    assert kinds == {type(fact) for fact in ALL}
    back = list(read_events(written(tmp_path / "run")))
    assert len(back) == len(ALL)
    for before, after in zip(ALL, back, strict=True):
        assert same(before, after), type(before).__name__


def test_a_torn_last_line_costs_that_line_only(tmp_path):
    folder = written(tmp_path / "run")
    content = (folder / EVENT_LOG_NAME).read_bytes()
    lines = content.splitlines(keepends=True)
    for cut in (1, 10, len(lines[-1]) - 1):
        (folder / EVENT_LOG_NAME).write_bytes(content[:-cut])
        assert len(list(read_events(folder))) == len(ALL) - 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (None, "line 6"),
        *(({"dtype": "object"}, ""), ({"data": "not base64!"}, ""), ({"shape": [999]}, "")),
    ],
)
def test_damage_and_forged_arrays_are_refused(tmp_path, change, said):
    folder = written(tmp_path / "run")
    lines = (folder / EVENT_LOG_NAME).read_bytes().splitlines(keepends=True)
    if change is None:
        lines[5] = b'{"kind": "PatchEst\n'
    else:
        line = json.loads(lines[6])
        line["patch"]["probability"].update(change)
        lines[6] = json.dumps(line).encode() + b"\n"
    (folder / EVENT_LOG_NAME).write_bytes(b"".join(lines))
    with pytest.raises(InputError, match=said or "Damaged event PatchEstimated"):
        list(read_events(folder))


def test_foreign_files_are_refused_and_a_run_is_never_written_over(tmp_path):
    with pytest.raises(InputError, match="no event log"):
        list(read_events(tmp_path))
    (tmp_path / EVENT_LOG_NAME).write_text('{"program": "other"}\n')
    with pytest.raises(InputError, match="not a Touchdown event log"):
        list(read_events(tmp_path))
    written(tmp_path / "run")
    with pytest.raises(FileExistsError):
        EventLog(tmp_path / "run")


def test_each_fact_is_on_the_disk_before_the_next_one(tmp_path, monkeypatch):
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


LOWER = Limits(jog_mm_s=30.0)


@pytest.fixture
def session(tmp_path):
    made = simulated_session(
        SimulatedBenchChoice(preset="quiet"), keep=RecordingOptions(tmp_path / "runs")
    )
    made.prepare(SceneChoice(estimates=False))
    for _ in range(60):
        made.advance()
    yield made
    made.close()


def test_a_change_holds_from_now_on_and_is_said_and_logged(session, tmp_path):
    said = []
    on(session, Said, said.append)
    session.change_limits(LOWER, "anna")
    assert session.interlock.limits == LOWER
    assert "anna" in said[0].text
    with pytest.raises(RefusedError, match=r"40\.0 mm/s"):
        session.hand.jog.renew(JogOrder(1, 1, session.clock_s(), "z", "XYZ", 40.0))
    log_limit_change(
        tmp_path / "runs", "Bench 2", "ben", LOWER, LOWER.model_copy(update={"probe_n": 20.0})
    )
    log = (tmp_path / "runs" / LIMIT_LOG_NAME).read_text().splitlines()
    first, second = map(json.loads, log)
    assert (first["person"], first["changed"]) == ("anna", {"jog_mm_s": [50.0, 30.0]})
    assert (second["bench"], second["person"]) == ("Bench 2", "ben")
    assert second["changed"] == {"probe_n": [30.0, 20.0]}


def test_nothing_changes_while_the_arm_is_moved(session):
    session.hand.jog.renew(JogOrder(1, 1, session.clock_s(), "z", "XYZ", 5.0))
    session.advance()
    with pytest.raises(RefusedError, match="manual control"):
        session.change_limits(LOWER, "anna")
    assert session.interlock.limits == Limits()


def test_a_disk_that_refuses_leaves_the_former_limits(session, tmp_path):
    (tmp_path / "runs").write_text("a file in the way")
    with pytest.raises(InputError, match="former limits hold"):
        session.change_limits(LOWER, "anna")
    assert session.interlock.limits == Limits()


PROBE = (PatchEstimated, BeliefUpdated, StabilityJudged, ActionChosen)


def one_probe() -> StackSettings:
    """Return the method that gives up after one probe."""
    return brisk_method().model_copy(update={"policy": PolicySettings(max_probes=1)})


def last_trial(bench: OracleSession) -> TrialFinished:
    fact = bench.of(TrialFinished)[-1]
    assert isinstance(fact, TrialFinished)
    return fact


def test_places_the_piece_and_the_journal_gives_the_run_back(tmp_path):
    """One undisturbed run, recorded with all its images."""
    bench = OracleSession(runs=tmp_path, rate_hz=25.0)
    bench.session.run(request())
    bench.session.close()
    end = last_trial(bench)
    assert end.outcome is Outcome.PLACED
    truth = bench.benches[-1].truth()
    assert truth.stands is True
    assert end.margin_mm == truth.margin_mm > 0
    assert end.excess_probes == 0
    kinds = [type(fact) for fact in bench.facts]
    assert kinds[:2] == [RunStarted, TrialStarted]
    assert kinds[-2:] == [TrialFinished, RunFinished]
    assert [k for k in kinds if k in PROBE] == list(PROBE) * end.probes
    assert len(bench.of(EpisodeRecorded)) == end.probes
    assert bench.of(ActionChosen)[-1].action.kind == "release"
    folder = bench.session.run_folder
    back = list(read_events(folder))
    assert [type(f) for f in back] == [type(f) for f in bench.facts]
    for fact, oracle in zip(bench.of(EpisodeRecorded), bench.oracles[0].asked, strict=True):
        episode = read_episode(folder / "episodes" / fact.path)
        assert episode.observation.tobytes() == oracle.observation.tobytes()
        assert len(episode.recording.frames) >= 100


def test_equal_seeds_give_equal_bits_live_and_stepped():
    stepped = OracleSession()
    stepped.session.run(request(trials=1))
    live = OracleSession()
    ended = threading.Event()
    live.session.events.subscribe(lambda f: ended.set() if isinstance(f, RunFinished) else None)
    live.session.prepare(request(seed=99).scene())
    live.session.open(speed=100.0)
    live.session.start(request(trials=1))
    assert ended.wait(300)
    live.session.close()
    assert live.record() == stepped.record()
    assert len(live.oracles[-1].asked) > 1
    other = OracleSession(method=one_probe())
    other.session.run(request(seed=8))
    assert any(line not in stepped.record() for line in other.record()[1:])
    first, second = (bench.oracles[0].asked[0] for bench in (other, stepped))
    assert first.observation.tobytes() != second.observation.tobytes()


def test_pick_and_place_always_starts_unstable_and_falls():
    bench = OracleSession()
    bench.session.run(request(strategy="pick-and-place", trials=3))
    ends = bench.of(TrialFinished)
    assert [e.outcome for e in ends] == [Outcome.FELL] * 3
    assert not bench.oracles[0].asked


def height_mm(bench: OracleSession) -> float:
    return bench.benches[-1].arm.pose(1.0).z_mm


@pytest.mark.promise("G4")
def test_without_contact_only_a_strategy_that_asks_for_it_presses_elsewhere():
    above = brisk_method().probe.model_copy(update={"max_travel_mm": 0.01, "start_height_mm": 3.0})
    changes = {"probe": above, "policy": PolicySettings(max_probes=2)}
    bench = OracleSession(method=brisk_method().model_copy(update=changes))
    bench.session.run(request(strategy="fused"))
    assert last_trial(bench).outcome is Outcome.ASKED
    moved = [f.phase for f in bench.of(PhaseEntered)]
    assert moved.count("approach") == 2
    assert moved.count("shift") == 1
    assert bench.benches[-1].gripper.status().holding
    began_mm: list[float] = []
    after(bench, PhaseEntered, "approach", lambda: began_mm.append(height_mm(bench)))
    bench.session.run(request())
    assert height_mm(bench) == pytest.approx(began_mm[0], abs=0.05)
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert "NO-CONTACT" in [f.fault.code for f in bench.of(FaultRaised)]
    assert not bench.of(EpisodeRecorded)


def after(bench: OracleSession, kind: type[Event], phase: str, act: object) -> None:
    """Call ``act`` once when an event of ``kind`` (and phase) is published."""
    done = threading.Event()

    def listen(fact: Event) -> None:
        match = isinstance(fact, kind) and getattr(fact, "phase", phase) == phase
        if match and not done.is_set():
            done.set()
            act()

    bench.session.events.subscribe(listen)


@pytest.mark.parametrize("phase", ["grip", "reference", "approach", "press", "hold", "lift"])
def test_stop_in_every_phase_ends_the_run_and_keeps_the_piece(phase):
    bench = OracleSession()
    after(bench, PhaseEntered, phase, bench.session.stop)
    bench.session.run(request())
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert last_trial(bench).probes == len(bench.of(PatchEstimated)), "only what was felt counts"
    assert excluding_fault(last_trial(bench), phase) == ""
    end = bench.facts[-1]
    assert end.ending == "stopped"
    world = bench.benches[-1]
    world.advance(20_000)
    before = world.arm.pose(1.0)
    world.advance(500_000)
    settled = world.arm.pose(1.0)
    world.advance(500_000)
    assert world.arm.pose(1.0) == settled
    assert abs(settled.z_mm - before.z_mm) < 0.5
    assert world.truth().stands is None


def test_cancel_lifts_and_keeps_the_piece():
    bench = OracleSession()
    after(bench, PhaseEntered, "press", bench.session.engine.cancel)
    bench.session.run(request())
    assert last_trial(bench).outcome is Outcome.ABORTED
    end = bench.facts[-1]
    assert end.ending == "cancelled"
    assert bench.benches[-1].gripper.status().holding
    pressed_n = bench.session.wrench.latest(bench.session.clock_s(), 1.0)[1][2]
    assert abs(pressed_n) < 1.0


@pytest.mark.parametrize(
    ("fault", "code", "device"),
    [
        ("tactile_left:stop@3.0", "CAMERA-STALE", "tactile_left"),
        ("tactile_right:freeze@3.0", "CAMERA-FROZEN", "tactile_right"),
        ("force_torque:nan@4.0", "FT-STALE", "force_torque"),
        ("force_torque:stop@4.0", "FT-STALE", "force_torque"),
        ("force_torque:jump@4.0", "FT-TRIP", "force_torque"),
        ("tactile_left:dark@3.0", "CAMERA-DARK", "tactile_left"),
        ("gripper:silent@3.0", "GRIP-STALE", "gripper"),
        ("arm:silent@1.0", "ARM-STALE", "arm"),
        ("arm:stall@3.0", "ARM-STALLED", "arm"),
    ],
)
def test_a_failing_sensor_ends_in_one_clear_fault(fault, code, device, tmp_path):
    bench = OracleSession(fault, runs=tmp_path)
    bench.session.run(request())
    folder = bench.session.run_folder
    bench.session.close()
    faults = bench.of(FaultRaised)
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert len(faults) == 1
    raised = faults[0]
    assert (raised.fault.code, raised.fault.device) == (code, device)
    phase = bench.of(PhaseEntered)[-1].phase
    assert excluding_fault(last_trial(bench), phase) == ("" if code == "FT-TRIP" else code)
    for letting_go in ("release", "rise"):
        assert excluding_fault(last_trial(bench), letting_go) == ""
    assert bench.benches[-1].gripper.status().holding
    assert isinstance(list(read_events(folder))[-1], RunFinished)


@pytest.mark.promise("C7")
def test_a_camera_that_is_dark_from_the_start_is_named_before_a_reference_fails():
    bench = OracleSession("tactile_left:dark@0.0")
    bench.session.run(request())
    bench.session.close()
    faults = [f.fault for f in bench.of(FaultRaised) if isinstance(f, FaultRaised)]
    assert [(fault.code, fault.device) for fault in faults] == [("CAMERA-DARK", "tactile_left")]


def test_a_short_nan_burst_voids_the_probe_and_the_run_goes_on():
    bench = OracleSession("force_torque:nan@4.0+0.2")
    bench.session.run(request())
    end = last_trial(bench)
    assert end.outcome is Outcome.PLACED
    presses = [f for f in bench.of(PhaseEntered) if getattr(f, "phase", "") == "press"]
    assert len(presses) == end.probes + 1
    assert len(bench.oracles[0].asked) == end.probes


def test_approve_mode_moves_only_after_a_yes_and_judges_again():
    bench = OracleSession()
    asked: list[str] = []

    def answer(fact: ApprovalAwaited) -> None:
        asked.append(fact.action.kind)
        force = bench.session.wrench.latest(bench.session.clock_s(), 1.0)[1][2]
        assert abs(force) < 1.0
        bench.session.answer(True)

    on(bench.session, ApprovalAwaited, answer)
    bench.session.run(request(mode="approve"))
    assert last_trial(bench).outcome is Outcome.PLACED
    assert asked[-1] == "release"
    assert asked.count("release") == 1
    chosen = [f.action.kind for f in bench.of(ActionChosen)]
    assert chosen[-2:] == ["release", "release"]
    declined = OracleSession()
    on(declined.session, ApprovalAwaited, lambda _: declined.session.answer(False))
    declined.session.run(request(mode="approve"))
    assert last_trial(declined).outcome is Outcome.ABORTED
    assert declined.benches[-1].gripper.status().holding


def test_stacks_on_a_tower_of_two():
    bench = OracleSession()
    bench.session.run(request(piece="barrel", bottoms=("short", "long"), seed=5))
    assert last_trial(bench).outcome is Outcome.PLACED


@pytest.mark.parametrize(("lean_mm", "carried"), [(0.0, True), (30.0, False)])
def test_learned_fusion_lets_go_on_a_tower_only_where_the_entry_carries_it(lean_mm, carried):
    """Ready to let go of anything that the touched face might carry, it still asks the entry."""
    changes = {
        "policy": PolicySettings(max_probes=1),
        "fused": FusedSettings(risk=0.999, first_risk=0.0, inset_mm=0.0),
        "tower": TowerSettings(offset_mm=((lean_mm, 0.0),), sigma_mm=1.0),
    }
    bench = OracleSession(method=brisk_method().model_copy(update=changes))
    bench.session.run(request(bottoms=("short", "long"), strategy="fused"))
    assert len(bench.of(ActionChosen)) == 1
    assert bool(bench.of(Released)) is carried
    if not carried:
        assert last_trial(bench).outcome is Outcome.ASKED
        assert bench.benches[-1].gripper.status().holding


def test_a_verdict_that_comes_too_late_is_not_acted_on(monkeypatch):
    bench = OracleSession()
    plain = Oracle.estimate

    def slow(oracle: Oracle, episode: Episode) -> ContactPatch:
        if len(oracle.asked) == 1:
            for _ in range(160):
                bench.session.advance()
        return plain(oracle, episode)

    monkeypatch.setattr(Oracle, "estimate", slow)
    bench.session.run(request())
    chosen = [f.action.kind for f in bench.of(ActionChosen)]
    assert chosen == ["shift", "release", "release"]
    assert len(bench.of(Released)) == 1
    assert last_trial(bench).probes == 3


@pytest.mark.allow_leaks
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dying_bench_thread_latches_a_fault_and_ends_the_run():
    bench = OracleSession()
    ended = threading.Event()
    bench.session.events.subscribe(lambda f: ended.set() if isinstance(f, RunFinished) else None)

    def break_down() -> None:
        raise OSError("the disk is gone")

    after(bench, PhaseEntered, "approach", break_down)
    bench.session.open(speed=100.0)
    bench.session.start(request())
    assert ended.wait(300)
    bench.session.close()
    assert bench.session.interlock.latched
    assert not bench.session.engine.busy
    assert [type(f) for f in bench.facts[-2:]] == [FaultRaised, RunFinished]


@pytest.mark.parametrize("after_facts", [0, 5, 20])
def test_a_disk_that_fails_stops_the_run_and_keeps_what_was_written(
    tmp_path, monkeypatch, after_facts
):
    bench = OracleSession(runs=tmp_path)
    plain = EventLog._append
    written: list[int] = []

    def failing(journal: EventLog, line: dict[str, object]) -> None:
        written.append(1)
        if len(written) > after_facts + 1:
            raise OSError(errno.EIO, "Input/output error")
        plain(journal, line)

    monkeypatch.setattr(EventLog, "_append", failing)
    bench.session.run(request())
    folder = bench.session.run_folder
    bench.session.close()
    assert [f.code for f in bench.session.interlock.faults] == ["JOURNAL-FAILED"]
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert bench.benches[-1].truth().stands is None
    assert len(list(read_events(folder))) == after_facts


@pytest.mark.promise("R5")
@pytest.mark.parametrize(
    ("voids", "fault", "outcome"),
    [(2, VOID, Outcome.PLACED), (2, LAPSED, Outcome.PLACED), (3, VOID, Outcome.ABORTED)],
)
def test_a_void_press_is_made_again_but_not_for_ever(voids, fault, outcome, monkeypatch):
    """With the faults of a real arm during a dropout in mid-press, of the arm or the program."""
    pressing: list[CommandedMotion] = []
    press = SimArm.press

    def remembered(arm: SimArm, command: PressCommand) -> ArmPress:
        pressing.append(press(arm, command))
        return pressing[-1]

    monkeypatch.setattr(SimArm, "press", remembered)
    bench = OracleSession(rate_hz=25.0)

    def lose(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press" and len(pressing) <= voids:
            pressing[-1].end(fault)

    bench.session.events.subscribe(lose)
    bench.session.run(request(trials=1))
    end = last_trial(bench)
    assert end.outcome is outcome, end.reason
    assert len(pressing) == (voids + end.probes if outcome is Outcome.PLACED else 3)
    told = [f.text for f in bench.of(Said) if "is void" in f.text]
    assert len(told) == 2
    assert len(bench.of(EpisodeRecorded)) == end.probes
    assert bench.benches[-1].gripper.status().holding is (outcome is Outcome.ABORTED)

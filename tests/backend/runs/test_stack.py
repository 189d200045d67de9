"""The whole loop on the stepped bench, checked by its events and the ground truth."""

from __future__ import annotations

import errno
import threading
from pathlib import Path

import pytest

from tests.backend.brisk import brisk_method
from tests.backend.runs.oracle_bench import Oracle, OracleSession, request
from touchdown.backend.config.method import (
    FusedSettings,
    PolicySettings,
    StackSettings,
    TowerSettings,
)
from touchdown.backend.core.events import (
    ActionChosen,
    ApprovalAwaited,
    BeliefUpdated,
    EpisodeRecorded,
    Event,
    FaultRaised,
    PatchEstimated,
    PhaseEntered,
    Released,
    RunFinished,
    RunStarted,
    Said,
    StabilityJudged,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.core.values import ContactPatch, Episode, Outcome
from touchdown.backend.devices.melfa.faults import VOID
from touchdown.backend.devices.protocols import CommandedMotion, PressCommand
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.event_log import EventLog, read_events
from touchdown.backend.runs.outcome import excluding_fault
from touchdown.backend.simulation.devices.arm import SimArm, SimPressMotion

PROBE = (PatchEstimated, BeliefUpdated, StabilityJudged, ActionChosen)


def one_probe() -> StackSettings:
    """Return the method that gives up after one probe."""
    return brisk_method().model_copy(update={"policy": PolicySettings(max_probes=1)})


def felt(bench: OracleSession) -> list[Episode]:
    """Return the judged episodes."""
    return bench.oracles[0].asked


def last_trial(bench: OracleSession) -> TrialFinished:
    fact = bench.of(TrialFinished)[-1]
    assert isinstance(fact, TrialFinished)
    return fact


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> OracleSession:
    """One undisturbed run, recorded with all its images."""
    bench = OracleSession(runs=tmp_path_factory.mktemp("whole"), rate_hz=25.0)
    bench.session.run(request())
    bench.session.close()
    return bench


def test_places_the_piece_and_tells_every_step(whole: OracleSession) -> None:
    bench = whole
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
    assert [f.kind for f in (a.action for a in bench.of(ActionChosen))][-1] == "release"


def test_the_journal_gives_the_run_back_and_every_episode_is_on_disk(whole: OracleSession) -> None:
    bench = whole
    folder = bench.session.run_folder
    assert folder is not None
    back = list(read_events(folder))
    assert [type(f) for f in back] == [type(f) for f in bench.facts]
    for fact, oracle in zip(bench.of(EpisodeRecorded), bench.oracles[0].asked, strict=True):
        assert isinstance(fact, EpisodeRecorded)
        episode = read_episode(folder / "episodes" / fact.path)
        assert episode.observation.tobytes() == oracle.observation.tobytes()
        assert episode.recording is not None
        assert len(episode.recording.frames) >= 100


def test_equal_seeds_give_equal_bits_live_and_stepped() -> None:
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
    assert felt(other)[0].observation.tobytes() != felt(stepped)[0].observation.tobytes()


def test_pick_and_place_always_starts_unstable_and_falls() -> None:
    bench = OracleSession()
    bench.session.run(request(strategy="pick-and-place", trials=3))
    ends = bench.of(TrialFinished)
    assert [e.outcome for e in ends] == [Outcome.FELL] * 3
    assert not bench.oracles[0].asked


def test_gives_up_after_max_probes_and_never_opens_the_gripper() -> None:
    bench = OracleSession(method=one_probe())
    bench.session.run(request())
    assert last_trial(bench).outcome is Outcome.GAVE_UP
    assert bench.benches[-1].gripper.status().holding
    assert not bench.of(Released)


def height_mm(bench: OracleSession) -> float:
    return bench.benches[-1].arm.pose(1.0).z_mm


@pytest.mark.promise("G4")
def test_without_contact_only_a_strategy_that_asks_for_it_presses_elsewhere() -> None:
    above = brisk_method().probe.model_copy(update={"max_travel_mm": 0.01, "start_height_mm": 3.0})
    changes = {"probe": above, "policy": PolicySettings(max_probes=2)}
    bench = OracleSession(method=brisk_method().model_copy(update=changes))
    bench.session.run(request(strategy="fused"))
    assert last_trial(bench).outcome is Outcome.GAVE_UP
    moved = [f.phase for f in bench.of(PhaseEntered) if isinstance(f, PhaseEntered)]
    assert moved.count("approach") == 2
    assert moved.count("shift") == 1
    assert bench.benches[-1].gripper.status().holding
    began_mm: list[float] = []
    after(bench, PhaseEntered, "approach", lambda: began_mm.append(height_mm(bench)))
    bench.session.run(request())
    assert height_mm(bench) == pytest.approx(began_mm[0], abs=0.05)
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert "NO-CONTACT" in [
        f.fault.code for f in bench.of(FaultRaised) if isinstance(f, FaultRaised)
    ]
    assert not bench.of(EpisodeRecorded)


def after(bench: OracleSession, kind: type[Event], phase: str, act: object) -> None:
    """Call ``act`` once when an event of ``kind`` (and phase) is published."""
    done = threading.Event()

    def listen(fact: Event) -> None:
        match = isinstance(fact, kind) and getattr(fact, "phase", phase) == phase
        if match and not done.is_set():
            done.set()
            act()  # type: ignore[operator]

    bench.session.events.subscribe(listen)


@pytest.mark.parametrize("phase", ["grip", "reference", "approach", "press", "hold", "lift"])
def test_stop_in_every_phase_ends_the_run_and_keeps_the_piece(phase: str) -> None:
    bench = OracleSession()
    after(bench, PhaseEntered, phase, bench.session.stop)
    bench.session.run(request())
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert last_trial(bench).probes == len(bench.of(PatchEstimated)), "only what was felt counts"
    assert excluding_fault(last_trial(bench), phase) == ""
    end = bench.facts[-1]
    assert isinstance(end, RunFinished)
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


def test_cancel_lifts_and_keeps_the_piece() -> None:
    bench = OracleSession()
    after(bench, PhaseEntered, "press", bench.session.engine.cancel)
    bench.session.run(request())
    assert last_trial(bench).outcome is Outcome.ABORTED
    end = bench.facts[-1]
    assert isinstance(end, RunFinished)
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
        ("arm:silent@1.0", "ARM-STALE", "arm"),
    ],
)
def test_a_failing_sensor_ends_in_one_clear_fault(
    fault: str, code: str, device: str, tmp_path: Path
) -> None:
    bench = OracleSession(fault, runs=tmp_path)
    bench.session.run(request())
    folder = bench.session.run_folder
    bench.session.close()
    faults = bench.of(FaultRaised)
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert len(faults) == 1
    raised = faults[0]
    assert isinstance(raised, FaultRaised)
    assert (raised.fault.code, raised.fault.device) == (code, device)
    phase = [f for f in bench.of(PhaseEntered) if isinstance(f, PhaseEntered)][-1].phase
    assert excluding_fault(last_trial(bench), phase) == ("" if code == "FT-TRIP" else code)
    for letting_go in ("release", "rise"):
        assert excluding_fault(last_trial(bench), letting_go) == ""
    assert bench.benches[-1].gripper.status().holding
    assert folder is not None
    assert isinstance(list(read_events(folder))[-1], RunFinished)


def test_a_short_nan_burst_voids_the_probe_and_the_run_goes_on() -> None:
    bench = OracleSession("force_torque:nan@4.0+0.2")
    bench.session.run(request())
    end = last_trial(bench)
    assert end.outcome is Outcome.PLACED
    presses = [f for f in bench.of(PhaseEntered) if getattr(f, "phase", "") == "press"]
    assert len(presses) == end.probes + 1
    assert len(bench.oracles[0].asked) == end.probes


def test_approve_mode_moves_only_after_a_yes_and_judges_again() -> None:
    bench = OracleSession()
    asked: list[str] = []

    def answer(fact: Event) -> None:
        if isinstance(fact, ApprovalAwaited):
            asked.append(fact.action.kind)
            force = bench.session.wrench.latest(bench.session.clock_s(), 1.0)[1][2]
            assert abs(force) < 1.0
            bench.session.answer(True)

    bench.session.events.subscribe(answer)
    bench.session.run(request(mode="approve"))
    assert last_trial(bench).outcome is Outcome.PLACED
    assert asked[-1] == "release"
    assert asked.count("release") == 1
    chosen = [f.action.kind for f in bench.of(ActionChosen) if isinstance(f, ActionChosen)]
    assert chosen[-2:] == ["release", "release"]


def test_a_no_keeps_the_piece() -> None:
    bench = OracleSession()
    bench.session.events.subscribe(
        lambda f: bench.session.answer(False) if isinstance(f, ApprovalAwaited) else None
    )
    bench.session.run(request(mode="approve"))
    assert last_trial(bench).outcome is Outcome.ABORTED
    assert bench.benches[-1].gripper.status().holding


def test_stacks_on_a_tower_of_two() -> None:
    bench = OracleSession()
    bench.session.run(request(piece="barrel", bottoms=("short", "long"), seed=5))
    assert last_trial(bench).outcome is Outcome.PLACED


@pytest.mark.parametrize(("lean_mm", "carried"), [(0.0, True), (30.0, False)])
def test_learned_fusion_lets_go_on_a_tower_only_where_the_entry_carries_it(
    lean_mm: float, carried: bool
) -> None:
    """Ready to let go of anything that the touched face might carry, it still asks the entry."""
    changes = {
        "policy": PolicySettings(max_probes=1),
        "fused": FusedSettings(risk=0.999, inset_mm=0.0),
        "tower": TowerSettings(offset_mm=((lean_mm, 0.0),), sigma_mm=1.0),
    }
    bench = OracleSession(method=brisk_method().model_copy(update=changes))
    bench.session.run(request(bottoms=("short", "long"), strategy="fused"))
    assert len(bench.of(ActionChosen)) == 1
    assert bool(bench.of(Released)) is carried
    if not carried:
        assert last_trial(bench).outcome is Outcome.GAVE_UP
        assert bench.benches[-1].gripper.status().holding


def test_a_verdict_that_comes_too_late_is_not_acted_on(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = OracleSession()
    plain = Oracle.estimate

    def slow(oracle: Oracle, episode: Episode) -> ContactPatch:
        if len(oracle.asked) == 1:
            for _ in range(160):
                bench.session.advance()
        return plain(oracle, episode)

    monkeypatch.setattr(Oracle, "estimate", slow)
    bench.session.run(request())
    chosen = [f.action.kind for f in bench.of(ActionChosen) if isinstance(f, ActionChosen)]
    assert chosen == ["shift", "release", "release"]
    assert len(bench.of(Released)) == 1
    assert last_trial(bench).probes == 3


@pytest.mark.allow_leaks
@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_dying_bench_thread_latches_a_fault_and_ends_the_run() -> None:
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
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, after_facts: int
) -> None:
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
    assert folder is not None
    assert len(list(read_events(folder))) == after_facts


@pytest.mark.promise("R5")
@pytest.mark.parametrize(("voids", "outcome"), [(2, Outcome.PLACED), (3, Outcome.ABORTED)])
def test_a_void_press_is_made_again_but_not_for_ever(
    voids: int, outcome: Outcome, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the faults of a real arm during a dropout in mid-press."""
    pressing: list[CommandedMotion] = []
    press = SimArm.press

    def remembered(arm: SimArm, command: PressCommand) -> SimPressMotion:
        pressing.append(press(arm, command))
        return pressing[-1]

    monkeypatch.setattr(SimArm, "press", remembered)
    bench = OracleSession(rate_hz=25.0)

    def lose(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "press" and len(pressing) <= voids:
            pressing[-1].end(VOID)

    bench.session.events.subscribe(lose)
    bench.session.run(request(trials=1))
    end = last_trial(bench)
    assert end.outcome is outcome, end.reason
    assert len(pressing) == (voids + end.probes if outcome is Outcome.PLACED else 3)
    told = [f.text for f in bench.of(Said) if "is void" in f.text]
    assert len(told) == 2
    assert len(bench.of(EpisodeRecorded)) == end.probes
    assert bench.benches[-1].gripper.status().holding is (outcome is Outcome.ABORTED)

"""Networks of learned fusion, and questions of a run where it is unsure."""

import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from tests.backend.bench.brisk import brisk_method, on
from tests.backend.runs.oracle_bench import OracleSession, request
from touchdown.backend.bench.assembly import SimulatedBenchChoice, simulated_session
from touchdown.backend.config.method import FusedSettings, PolicySettings, StackSettings
from touchdown.backend.core import (
    ActionChosen,
    ApprovalAwaited,
    Fault,
    FaultError,
    FaultRaised,
    InputError,
    Outcome,
    PhaseEntered,
    Progress,
    Released,
    RunFinished,
    Said,
    TrialFinished,
)
from touchdown.backend.devices import GuardedGripper
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import CLOSES
from touchdown.backend.experiments.run_report import run_text
from touchdown.backend.geometry import load_pieces, regions
from touchdown.backend.learning.fused import Guard, GuardCalibration, method_sha256
from touchdown.backend.placement.strategies import PaperStrategy
from touchdown.backend.runs import (
    LEARNED,
    RecordingOptions,
    StackRequest,
    messages,
    probe,
    release,
    stack,
)
from touchdown.backend.runs.stack import certificate_status, check_pieces
from touchdown.backend.sensing.slip import TurnDetector
from touchdown.backend.simulation.devices.end_effector import SimGripper
from touchdown.backend.simulation.gripper import JawEvents, SimulatedJaws

BOLD = {"risk": 0.999, "first_risk": 0.0, "inset_mm": 0.0}  # releases at the first place
SHY = {"risk": 1e-6, "inset_mm": 6.0}  # never does


def fused_bench(fused, guard=None, *, attended=False):
    """Return a bench on which ``fused`` decides after one probe, with a guard."""
    changes = {"policy": PolicySettings(max_probes=1), "fused": FusedSettings(**fused)}
    bench = OracleSession(method=brisk_method().model_copy(update=changes))
    bench.session.guard_of = lambda method: guard
    bench.session.prompt.attended = attended
    return bench


def withdrawn_guard():
    scores = {"pot": tuple(float(k) for k in range(100))}
    guard = Guard(
        GuardCalibration(bench="b", bench_sha256="b", code="c", date="2026-01-01", scores=scores)
    )
    for _ in range(5):
        guard.observe("pot", 1e9)
    assert guard.withdrawn
    return guard


def trial_of(bench):
    """Run one trial and return its end; without a release the piece stays in the gripper."""
    bench.session.run(request(strategy="fused"))
    (end,) = bench.of(TrialFinished)
    assert bench.benches[-1].gripper.status().holding is not bool(bench.of(Released))
    return end


def test_without_a_person_a_release_after_the_alarm_ends_as_asked():
    guard = withdrawn_guard()
    bench = fused_bench(BOLD, guard)
    end = trial_of(bench)
    assert end.outcome is Outcome.ASKED
    assert "Signals differ from calibration: each release is asked" in end.reason
    assert end.reason.endswith("No operator is present: the piece stays in the gripper.")
    assert not bench.of(ApprovalAwaited)
    assert len(guard.state.observed) == 6, "the trial itself is counted"
    assert any(said.text == guard.describe() for said in bench.of(Said)), "in the run log"


@pytest.mark.parametrize("strategy", ["paper", "fused", "pick-and-place"])
@pytest.mark.parametrize("attended", [False, True])
def test_a_failed_daily_check_asks_before_each_release_and_says_so_in_the_log(strategy, attended):
    bench = fused_bench(BOLD) if strategy == "fused" else OracleSession()
    bench.session.prompt.attended = attended
    why = "The daily check of 2026-01-01 is out of limits"
    bench.session.calibrations = SimpleNamespace(
        day_checks=lambda *_: SimpleNamespace(obstacle=lambda: why),
        status=lambda *_: SimpleNamespace(condition="missing"), in_use=lambda *_, **__: {},
    )  # fmt: skip
    on(bench.session, ApprovalAwaited, lambda _: bench.session.answer(True))
    bench.session.run(request(strategy=strategy))
    (end,) = bench.of(TrialFinished)
    assert [said.text for said in bench.of(Said)].count(why) == 1
    asked = [event.action for event in bench.of(ApprovalAwaited)]
    assert all(why in action.reason for action in asked)
    if attended:
        assert "release" in [action.kind for action in asked]
        assert bench.of(Released)
    else:
        assert (end.outcome, len(asked)) == (Outcome.ASKED, 0)
        assert why in end.reason
        assert not bench.of(Released)


def test_a_yes_presses_and_judges_again_before_the_jaws_open():
    bench = fused_bench(BOLD, withdrawn_guard(), attended=True)
    on(bench.session, ApprovalAwaited, lambda _: bench.session.answer(True))
    end = trial_of(bench)
    assert end.outcome in (Outcome.PLACED, Outcome.FELL)
    assert [asked.action.kind for asked in bench.of(ApprovalAwaited)] == ["release"]
    assert [chosen.action.kind for chosen in bench.of(ActionChosen)] == ["release"] * 2


def test_stop_works_while_the_question_is_open_and_no_answer_opens_the_jaws_after_it():
    bench = fused_bench(BOLD, withdrawn_guard(), attended=True)

    def stop(_: ApprovalAwaited) -> None:
        bench.session.stop()
        bench.session.answer(True)

    on(bench.session, ApprovalAwaited, stop)
    end = trial_of(bench)
    assert (end.outcome, end.reason) == (Outcome.ABORTED, "stopped by operator")
    assert [event.ending for event in bench.of(RunFinished)] == ["stopped"]


def test_without_an_answer_the_question_ends_and_a_late_yes_has_no_effect(monkeypatch):
    monkeypatch.setattr(stack, "PATIENCE_S", 1.0)
    bench = fused_bench(BOLD, withdrawn_guard(), attended=True)
    end = trial_of(bench)
    assert end.outcome is Outcome.ASKED
    assert "No answer within" in end.reason
    bench.session.answer(True)
    assert bench.session.prompt.reply is None
    assert not bench.session.interlock.latched, "no fault"


@pytest.mark.parametrize("attended", [False, True])
def test_where_no_place_is_sure_it_asks_whether_to_go_on(attended):
    bench = fused_bench(SHY, attended=attended)
    answers = iter((True, False))
    on(bench.session, ApprovalAwaited, lambda _: bench.session.answer(next(answers)))
    end = trial_of(bench)
    if not attended:
        assert end.outcome is Outcome.ASKED
        assert "after 1 probe: go on probing" in end.reason
        return
    assert (end.outcome, end.probes) == (Outcome.GAVE_UP, 2)
    assert end.reason.endswith("answered no: giving up, the piece stays in the gripper.")
    assert [asked.action.kind for asked in bench.of(ApprovalAwaited)] == ["ask", "ask"]


def test_an_answer_counts_for_its_own_question_only():
    prompt = OracleSession().session.prompt
    prompt.ask()
    first = prompt.number
    prompt.ask()
    prompt.answer(True, first)
    assert prompt.reply is None
    prompt.answer(True, prompt.number)
    assert prompt.withdraw() is True


@pytest.mark.parametrize("preset", ["mixed", "realistic"])
def test_a_shift_by_the_opening_fingers_is_told(preset):
    bench = OracleSession(preset=preset)
    bench.session.run(request())
    (end,) = bench.of(TrialFinished)
    (kick_mm,) = {one.truth().kick_mm for one in bench.benches}
    shifted = f"The fingers shifted the piece by {kick_mm:.1f} mm: "
    assert (shifted in end.reason, kick_mm > 0.05) == ((preset == "realistic",) * 2)


def test_the_outcome_of_a_release_says_why():
    told = messages.release_message
    assert told(True, 2.04) == "The piece stands, 2.0 mm inside its support."
    assert told(False, -0.3) == "The piece fell: its centre of mass was 0.3 mm outside its support."
    assert told(False, -0.3, 6.8).endswith("by 6.8 mm: 0.3 mm outside its support.")
    assert told(True, 0.2, 6.8).endswith("by 6.8 mm: 0.2 mm inside its support.")
    assert told(False, 5.0) == "The piece fell: it was released too high above its support."
    assert told(False, float("-inf")) == "The piece fell: nothing supported it."


def test_a_probe_rejected_twice_is_kept_twice_and_ends_the_run(monkeypatch):
    quality = SimpleNamespace(accepted=False, reasons=("slip", "late"))
    pressed = SimpleNamespace(episode=SimpleNamespace(quality=quality))
    kept, lifted = [], []
    bench = SimpleNamespace(
        now_s=lambda: 1.0,
        repaint_hold=SimpleNamespace(end=lambda: None),
        store=SimpleNamespace(keep=kept.append),
    )

    def press(*_, **__):
        yield from ()
        return pressed

    def lift(_, number):
        lifted.append(number)
        yield from ()

    monkeypatch.setattr(probe, "press_once", press)
    monkeypatch.setattr(probe.motions, "lift", lift)
    monkeypatch.setattr(probe.motions, "wait_until_durable", lambda _: iter(()))
    with pytest.raises(FaultError) as ended:
        list(probe.probe_until_accepted(bench, 3))
    assert ended.value.fault.code == "PROBE-REJECTED"
    assert ended.value.fault.what == "Probe 3 was rejected 2 times: slip; late."
    assert kept == [pressed.episode] * 2
    assert lifted == [3, 3]


def test_a_strategy_of_each_network_sets_its_rule_and_keeps_the_other_settings() -> None:
    base = StackSettings().model_copy(update={"fused": FusedSettings(risk=0.5, merge_mm=0.3)})
    found = {name: StackRequest(strategy=name).method(base) for name in LEARNED}
    assert {method.strategy for method in found.values()} == {"fused"}
    assert found["fused"].fused == base.fused
    assert [method.fused.weights for method in found.values()] == [
        "",
        "any",
        "any",
        "any",
        "wrench",
    ]
    assert [method.policy.max_probes for method in found.values()] == [8, 12, 8, 12, 12]
    assert found["fused-uneven"].fused.accepted_risk(12, 12) == 0.05
    assert all(method.fused.merge_mm == 0.3 for method in found.values())
    # Every rule is valid: the copies above are not checked.
    for method in found.values():
        assert StackSettings.model_validate(method.model_dump()) == method
    text = (Path(__file__).parents[3] / "docs" / "learned-fusion.md").read_text("utf-8")
    written = tomllib.loads(text.split("```toml\n")[1].split("```")[0])
    assert written == LEARNED["fused-any"]
    with pytest.raises(InputError, match="There is no strategy 'fused-all'"):
        StackRequest(strategy="fused-all")  # type: ignore[arg-type]


def test_the_certified_strategy_is_covered_on_its_bench() -> None:
    with simulated_session(
        SimulatedBenchChoice(preset="bench-v2"), keep=RecordingOptions(None)
    ) as session:
        covered = {
            name: certificate_status(
                session.identity, session.method, StackRequest(strategy=name)
            ).certificate
            is not None
            for name in LEARNED
        }
        plan = stack.stack_run(session, StackRequest(strategy="fused-certified"))
        started, said = next(plan), next(plan)
    assert [name for name, there in covered.items() if there] == ["fused-certified"]
    assert said.text.startswith("Unsafe \N{LESS-THAN OR EQUAL TO} 0.5 % of releases (95 %)")
    assert "strategy fused-certified, network any, seed 0" in run_text(started)


def test_only_networks_for_any_outline_take_a_ring() -> None:
    ring = replace(load_pieces().piece("short"), name="ring", face=regions.ring(20.0, 10.0))
    session = SimpleNamespace(
        catalogue=SimpleNamespace(pieces={"ring": ring}), method=StackSettings()
    )
    for name in ("fused-any", "fused-certified", "fused-uneven"):
        check_pieces(session, StackRequest(bottoms=("ring",), strategy=name))
    for name in ("fused", "fused-wrench"):
        with pytest.raises(InputError, match="fused-any"):
            check_pieces(session, StackRequest(bottoms=("ring",), strategy=name))


def staged_bench(monkeypatch, *turns, stages=2):
    """Return a bench whose releases open in stages; ``turns``: whether each of them turns."""
    base, given = brisk_method(), iter(turns)
    release = base.release.model_copy(update={"stages": stages})
    bench = OracleSession(method=base.model_copy(update={"release": release}), rate_hz=25.0)

    class Told(TurnDetector):
        def __init__(self, *streams):
            super().__init__(*streams)
            self.turns = next(given)

        def hold(self, since_s, now_s):
            return 99.0 if self.turns and super().hold(since_s, now_s) else 0.0

    monkeypatch.setattr("touchdown.backend.runs.release.TurnDetector", Told)
    return bench


def staged_trial(bench, **asked):
    bench.session.run(request(**asked))
    (end,) = bench.of(TrialFinished)
    return end, [said.text for said in bench.of(Said) if "turn" in said.text]


def test_a_release_in_stages_opens_step_by_step(monkeypatch):
    forces_n, unload = [], GuardedArm.unload

    def unloaded(arm, force_n, speed_mm_s):
        forces_n.append(force_n)
        return unload(arm, force_n, speed_mm_s)

    monkeypatch.setattr(GuardedArm, "unload", unloaded)
    bench, shown = staged_bench(monkeypatch, False), []
    for kind in (Progress, PhaseEntered):
        on(bench.session, kind, lambda _: shown.append(bench.session.status()))
    end, said = staged_trial(bench)
    assert (end.outcome, said) == (Outcome.PLACED, [])
    steps = [(look.phase, look.step, look.steps) for look in shown if look.steps]
    assert steps == [("release", 1, 2), ("release", 2, 2)], "none while the arm rises"
    assert forces_n == [0.8]  # the pot weighs less
    phases = [(fact.phase, fact.t_s) for fact in bench.of(PhaseEntered)]
    times = dict(phases)
    assert times["rise"] - times["release"] > 2.0
    assert "Opening in 2 steps of 0.1 mm, each held for 1 s." in [f.text for f in bench.of(Said)]
    assert bench.session.interlock.staged is None


def test_a_piece_that_turns_is_gripped_again_and_the_run_goes_on(monkeypatch):
    bench = staged_bench(monkeypatch, True, False)
    sigmas = []
    monkeypatch.setattr(PaperStrategy, "regrasped", lambda self, sigma: sigmas.append(sigma))
    end, said = staged_trial(bench)
    assert end.outcome is Outcome.PLACED
    assert said[0].endswith(
        "the piece begins to turn with the jaws opened by 0.1 mm: closing them."
    )
    assert sigmas == [0.3]
    assert len([fact for fact in bench.of(PhaseEntered) if fact.phase == "release"]) == 2


def test_a_piece_that_turns_twice_stays_in_the_gripper(monkeypatch):
    bench = staged_bench(monkeypatch, True, True)
    end, said = staged_trial(bench)
    assert (end.outcome, end.reason) == (Outcome.GAVE_UP, stack.TURNED)
    assert len(said) == 2
    assert bench.benches[-1].gripper.status().holding


def test_a_piece_that_is_lost_while_the_jaws_close_is_judged_as_released(monkeypatch):
    bench = staged_bench(monkeypatch, True)

    def lose(event):
        if isinstance(event, Said) and "closing them" in event.text:
            bench.benches[-1]._world.jaws.lose()

    bench.session.events.subscribe(lose)
    end, _ = staged_trial(bench)
    assert bench.of(Released)
    assert end.outcome in (Outcome.PLACED, Outcome.FELL)
    assert not bench.benches[-1].gripper.status().holding
    assert any("closed on nothing" in said.text for said in bench.of(Said))


def test_stop_during_the_stages_closes_the_jaws(monkeypatch):
    bench = staged_bench(monkeypatch, False)
    session = bench.session

    monkeypatch.setattr(TurnDetector, "keep", lambda *_: session.stop())
    result = session.run(request())
    assert result.ending == "stopped"
    devices = bench.benches[-1]
    devices.advance(1_500_000)
    assert devices.gripper.status().holding
    assert not bench.of(Released)


def test_stop_does_not_interrupt_jaws_that_close_because_the_piece_turns(monkeypatch):
    bench = staged_bench(monkeypatch, True)
    session, grip = bench.session, GuardedGripper.grip

    def grip_and_stop(gripper, force_n):
        loosened = session.interlock.staged is not None
        gripping = grip(gripper, force_n)
        if loosened:
            session.stop()
        return gripping

    monkeypatch.setattr(GuardedGripper, "grip", grip_and_stop)
    assert session.run(request()).ending == "stopped"
    devices = bench.benches[-1]
    devices.advance(1_500_000)
    assert devices.gripper.status().holding


def test_a_cancel_while_the_jaws_close_lifts_the_piece_with_them(monkeypatch):
    bench = staged_bench(monkeypatch, True)
    session, grip, below_mm = bench.session, GuardedGripper.grip, []

    def grip_and_cancel(gripper, force_n):
        if session.interlock.staged is not None:
            below_mm.append(bench.benches[-1].arm.pose(1.0).z_mm)
            session.engine.cancel()
        return grip(gripper, force_n)

    monkeypatch.setattr(GuardedGripper, "grip", grip_and_cancel)
    end, _ = staged_trial(bench)
    assert (end.outcome, end.reason) == (Outcome.ABORTED, "cancelled by the operator")
    devices = bench.benches[-1]
    assert devices.gripper.status().holding
    assert devices.arm.pose(1.0).z_mm > below_mm[0] + 1.0, "lifted"


def blind(*_):
    return None


@pytest.mark.parametrize("why", ["cancel", "refusal", "no markers", "still holding"])
def test_a_run_that_ends_during_the_stages_closes_the_jaws_and_lifts(monkeypatch, why):
    bench = staged_bench(monkeypatch, False, stages=3)
    keep, status, step = TurnDetector.keep, SimGripper.status, []

    def kept(*given):
        if why == "cancel":
            bench.session.engine.cancel()
        elif why == "refusal":
            monkeypatch.setattr(release.devices, "travelled_mm", lambda _: float("nan"))
        elif why == "no markers":
            monkeypatch.setattr("touchdown.backend.sensing.slip._marker_motion", blind)
        step.append(bench.benches[-1].arm.pose(1.0).z_mm)
        return keep(*given)

    def held(gripper):
        told = status(gripper)
        return replace(told, holding=told.holding or gripper._world.jaws.loosened)

    monkeypatch.setattr(TurnDetector, "keep", kept)
    if why == "still holding":
        monkeypatch.setattr(SimGripper, "status", held)
    end, _ = staged_trial(bench)
    assert end.outcome is Outcome.ABORTED
    refused = {"refusal": "ARM-MOVING", "no markers": "NOT-WATCHED", "still holding": "HOLDING"}
    assert refused.get(why, "cancelled") in end.reason
    devices, interlock = bench.benches[-1], bench.session.interlock
    assert (interlock.latched, interlock.staged) == (False, None)
    assert devices._world.jaws.holding
    assert devices.arm.pose(1.0).z_mm > step[0] + 1.0, "lifted"


def test_a_gripper_that_does_not_close_again_is_a_fault_and_opens_no_further(monkeypatch):
    bench = staged_bench(monkeypatch, True)

    def jam(event):
        if isinstance(event, Said) and "closing them" in event.text:
            monkeypatch.setattr(SimulatedJaws, "step", lambda *_: JawEvents())

    bench.session.events.subscribe(jam)
    end, _ = staged_trial(bench)
    assert (end.outcome, bench.of(Released)) == (Outcome.ABORTED, [])
    assert [fault.code for fault in bench.session.interlock.faults] == ["TIMEOUT"]
    assert not any("closed on nothing" in said.text for said in bench.of(Said))


def test_a_fault_during_the_stages_tells_that_the_jaws_close(monkeypatch):
    bench = staged_bench(monkeypatch, False)
    fault = Fault("TIMEOUT", "Late.", "The gripper was not opened.", "Wait.")

    def late(*_):
        raise FaultError(fault)

    monkeypatch.setattr(TurnDetector, "keep", late)
    staged_trial(bench)
    (raised,) = bench.of(FaultRaised)
    assert raised.fault.consequence == CLOSES


def test_a_new_grip_needs_a_new_approval(monkeypatch):
    bench = staged_bench(monkeypatch, True, False)
    bench.session.prompt.attended = True
    on(bench.session, ApprovalAwaited, lambda _: bench.session.answer(True))
    end, _ = staged_trial(bench, mode="approve")
    assert end.outcome is Outcome.PLACED
    asked = [event.action.kind for event in bench.of(ApprovalAwaited)]
    assert asked.count("release") == 2


def test_a_weak_watch_refuses_the_release(monkeypatch):
    bench = staged_bench(monkeypatch, False, False, False)
    monkeypatch.setattr(TurnDetector, "learn", lambda *_: False)
    end, _ = staged_trial(bench)
    assert (end.outcome, end.reason) == (Outcome.ABORTED, f"{release.UNWATCHED} [NOT-WATCHED]")
    assert bench.benches[-1].gripper.status().holding


def test_a_lean_is_judged_by_growth_and_by_the_load_beyond_the_weight():
    weight_n = 9.80665 * 10.0
    piece = SimpleNamespace(mass_g=10_000.0, com_xy_mm=(3.0, -2.0))
    bench = SimpleNamespace(settings=StackSettings(), piece=piece)
    free = np.array([0.0, 0.0, weight_n, -2e-3 * weight_n, -3e-3 * weight_n, 0.0])

    def leans(growth, load):
        return release._leans(bench, SimpleNamespace(growth=lambda: growth, load=lambda: load))

    assert not leans(11.9, free)
    assert leans(12.1, free)
    assert not leans(0.0, free + 5.0 * np.eye(6)[2])
    for axis, most in ((0, 0.8), (1, 0.8), (3, 0.032), (4, 0.032), (5, 0.032)):
        assert not leans(0.0, free + 0.99 * most * np.eye(6)[axis])
        assert leans(0.0, free + 1.01 * most * np.eye(6)[axis])


def test_a_staged_request_opens_in_stages_unless_the_method_says_how():
    base = StackSettings()
    assert StackRequest(staged=True).method(base).release.stages == 38
    assert StackRequest().method(base).release == base.release
    own = base.model_copy(update={"release": base.release.model_copy(update={"stages": 12})})
    assert StackRequest(staged=True).method(own).release == own.release
    blind = StackRequest(staged=True, strategy="pick-and-place")
    assert blind.method(base).release == base.release


def test_the_certificate_covers_stages_only_if_they_were_used():
    method = StackSettings()
    other = {"turn_sigmas": 5.0, "regrasp_sigma_mm": 1.0, "stage_mm": 0.05, "lean_sigmas": 3.0}
    without = method.model_copy(update={"release": method.release.model_copy(update=other)})
    assert method_sha256(without) == method_sha256(method)
    on = method.model_copy(update={"release": method.release.model_copy(update={"stages": 30})})
    assert method_sha256(on) != method_sha256(method)

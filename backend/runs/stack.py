"""Stacking run: trials of one strategy, each on its own scene with one outcome.

The autonomous loop probes, updates the belief, judges, and releases only where the piece will
stand. Pick-and-place is the baseline without probing.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from touchdown.backend import core, placement
from touchdown.backend.config import BenchIdentity, StackSettings
from touchdown.backend.devices import ReleaseEvidence
from touchdown.backend.learning import fused
from touchdown.backend.runs import messages, motions, outcome
from touchdown.backend.runs.bench import Bench, JudgedProbe, PressedProbe, RunContext
from touchdown.backend.runs.calibrate import check_weighing, weigh_empty, weigh_held
from touchdown.backend.runs.outcome import TrialResult, judge_release, trial_finished
from touchdown.backend.runs.plan import PausePoint, Plan, Wait, motion_done
from touchdown.backend.runs.probe import probe_until_accepted
from touchdown.backend.runs.recorder import wait_for_space
from touchdown.backend.runs.release import open_and_rise, release_piece
from touchdown.backend.runs.requests import StackRequest, request_record


def pick_and_place(bench: Bench) -> Plan[TrialResult]:
    """Release at the first place without a test: the paper's baseline, simulated benches only."""
    yield from motions.take_piece(bench)
    if bench.withheld:
        untested = core.PlaceAction("release", (0.0, 0.0), None, False, "Release without a test.")
        ended = yield from _unapproved(bench, untested, 1)
        if ended is not None:
            return ended
    yield from motions.zero_sensors(bench, 1)
    yield core.PhaseEntered(bench.now_s(), "approach", 1)
    motion = bench.arm.press(motions.probe_command(bench))
    yield Wait(lambda: motion.done or motion.onset_s is not None, 60.0, "contact")
    if motion.onset_s is None:
        motion.result()
    yield core.Said(bench.now_s(), "Pick and place: contact found, release without a test.")
    settings = bench.settings.release
    yield core.PhaseEntered(bench.now_s(), "unload", 1)
    unload = bench.arm.unload(settings.unload_n, bench.settings.probe.approach_mm_s)
    yield from motion_done(unload, motions.MOVE_S, "the arm to unload")
    yield from motions.wait(bench, settings.settle_s)
    yield core.PhaseEntered(bench.now_s(), "release", 1)
    status = bench.gripper.status()
    evidence = ReleaseEvidence(
        verdict_stable=False,
        verdict_of_last_probe=False,
        verdict_age_s=math.nan,
        margin_mm=math.nan,
        required_margin_mm=0.0,
        quality_accepted=False,
        slip_mm=0.0,
        press_n=bench.sensing.press_n(bench.now_s(), 0.1),
        wrench_age_s=0.0,
        wrench_age_limit_s=0.0,
        moved_mm=0.0,
        width_change_mm=0.0,
        holding=status.holding,
        approved=True,
    )
    yield from open_and_rise(bench, 1, evidence, status.width_mm)
    return (yield from judge_release(bench, 1))


DECLINED = "The operator declined the next move."
PATIENCE_S = 600.0  # a run that was to need no operator waits this long for one
NOBODY = "No operator is present: the piece stays in the gripper."
UNANSWERED = f"No answer within {PATIENCE_S / 60:.0f} min: the piece stays in the gripper."
MOST_TURNS = 2
TURNED = "The piece began to turn again while the jaws opened: giving up, it stays in the gripper."
REFUSED = "The operator answered no: giving up, the piece stays in the gripper."


def place_piece(bench: Bench) -> Plan[TrialResult]:
    """Place the piece by the strategy; else the trial ends knocked over, asked or given up."""
    yield from motions.take_piece(bench)
    here = bench.arm.pose(max_age_s=0.2)
    strategy = placement.make_strategy(grasped_piece(bench), bench.settings, (here.x_mm, here.y_mm))
    approved, counted = False, False
    probe = turns = 0
    while True:
        yield PausePoint()
        yield from wait_for_space(bench.store.obstacle)
        probe += 1
        pressed = yield from _probe_or_search(bench, probe, strategy)
        if isinstance(pressed, core.PlaceAction):
            yield core.Said(bench.now_s(), f"Probe {probe}: {pressed.reason}")
            yield from motions.lift(bench, probe)
            ended = yield from _unapproved(bench, pressed, probe)
            if ended is not None:
                return ended
            yield from _shift(bench, strategy, pressed, probe)
            continue
        judged = yield from _judge(bench, pressed, strategy)
        action = judged.action
        if not counted and action.kind != "shift":
            counted = True
            yield from _count_signals(bench, strategy)
        bench.store.keep(pressed.episode)
        held_s = judged.at_s - pressed.ended_s
        late = held_s > bench.settings.probe.verdict_wait_s
        if action.kind == "release" and not late and (approved or not _asks(bench, action)):
            ended = yield from _let_go(bench, judged, approved=True)
            if ended is not None:
                return ended
            if isinstance(strategy, placement.GraspStrategy):
                strategy.regrasped(bench.settings.release.regrasp_sigma_mm)
            turns, approved = turns + 1, False
            if turns == MOST_TURNS:
                return TrialResult(core.Outcome.GAVE_UP, TURNED, probe)
            continue
        yield from motions.lift(bench, probe)
        yield from _recorded(bench, pressed)
        if late:
            text = f"The estimate took {held_s:.1f} s, too long to hold the press"
            yield core.Said(bench.now_s(), f"{text}: lifted, probing again.")
            continue
        ended = yield from _unapproved(bench, action, probe)
        if ended is not None:
            return ended
        # An approval covers piece, pose and run: press and judge again, then release.
        approved = action.kind == "release"
        if approved:
            probe -= 1
        else:
            yield from _shift(bench, strategy, action, probe)


def grasped_piece(bench: Bench) -> placement.GraspedPiece:
    """Return the properties of the held piece that a strategy may use."""
    piece = bench.piece
    assert piece.grip_height_mm is not None
    return placement.GraspedPiece(
        piece.com_xy_mm, piece.grip_height_mm, bench.estimator.base_rate, bench.sensor_height_mm,
        bench.below, bench.estimator.calibration, bench.com_sigma_mm,
    )  # fmt: skip


def _judge(bench: Bench, pressed: PressedProbe, strategy: placement.Strategy) -> Plan[JudgedProbe]:
    """Estimate the contact patch and decide; events are published after the decision."""
    episode = pressed.episode
    here = (float(episode.offset_mm[0]), float(episode.offset_mm[1]))
    patch = bench.estimator.estimate(episode)
    concluded = strategy.conclude(placement.ProbeObservation(episode.observation, patch, here))
    stability, action = concluded.stability, concluded.action
    latency_ms = 1e3 * (bench.wall_s() - pressed.sampled_s)
    bench.repaint_hold.end()
    now_s = bench.now_s()
    yield core.PatchEstimated(now_s, patch, here, pressed.probe)
    yield core.BeliefUpdated(now_s, concluded.map, pressed.probe)
    yield core.StabilityJudged(now_s, stability, pressed.probe)
    yield core.ActionChosen(now_s, action, pressed.probe, latency_ms)
    yield core.Said(now_s, messages.decision_message(pressed.probe, patch, stability, action))
    return JudgedProbe(pressed, stability, action, now_s)


def _let_go(bench: Bench, judged: JudgedProbe, *, approved: bool) -> Plan[TrialResult | None]:
    """Release; return None, with the arm lifted, if the piece began to turn and is held again."""
    probe = judged.pressed.probe
    if not (yield from release_piece(bench, judged, approved=approved)):
        yield from motions.lift(bench, probe)
        yield from _recorded(bench, judged.pressed)
        return None
    # Publish the outcome first: a refused write of the episode must not hide it.
    ending = yield from judge_release(bench, probe)
    try:
        yield from _recorded(bench, judged.pressed)
    except core.FaultError as cause:
        bench.interlock.raise_fault(cause.fault)
        yield core.FaultRaised(bench.now_s(), cause.fault)
        return replace(ending, fault=cause.fault)
    return ending


def _probe_or_search(
    bench: Bench, probe: int, strategy: placement.Strategy
) -> Plan[PressedProbe | core.PlaceAction]:
    """Probe; without contact a searching strategy returns its next move instead."""
    try:
        return (yield from probe_until_accepted(bench, probe))
    except core.FaultError as cause:
        if cause.fault.code != "NO-CONTACT" or not isinstance(
            strategy, placement.SearchingStrategy
        ):
            raise
    here = bench.arm.pose(max_age_s=0.2)
    return strategy.missed((here.x_mm, here.y_mm))


def _asks(bench: Bench, action: core.PlaceAction) -> bool:
    """Return True if ``action`` needs the operator's yes."""
    unsure = action.kind == "ask" or (action.kind == "release" and _withheld(bench) != "")
    return unsure or bench.settings.mode != "auto"


def _withheld(bench: Bench) -> str:
    """Return why unattended release is withheld, "" if it is not."""
    if bench.guard is None or not bench.guard.withdrawn:
        return bench.withheld
    return f"{bench.guard.describe()} {bench.withheld}".rstrip()


def _unapproved(bench: Bench, action: core.PlaceAction, probe: int) -> Plan[TrialResult | None]:
    """Return the end of the trial, None if ``action`` may be carried out; the arm is lifted."""
    if action.kind == "give_up":
        return TrialResult(core.Outcome.GAVE_UP, action.reason, probe)
    if not _asks(bench, action):
        return None
    alone = bench.settings.mode == "auto"
    if alone:
        action = replace(action, reason=f"{action.reason} {_withheld(bench)}".rstrip())
    if alone and not bench.prompt.attended:
        return TrialResult(core.Outcome.ASKED, f"{action.reason} {NOBODY}", probe)
    patience_s = PATIENCE_S if alone else math.inf
    question = core.ApprovalAwaited(bench.now_s(), action, probe)
    reply = yield from motions.ask_operator(bench, question, "the operator", patience_s)
    if reply is None:
        return TrialResult(core.Outcome.ASKED, f"{action.reason} {UNANSWERED}", probe)
    if not reply and (alone or action.kind == "ask"):
        return TrialResult(core.Outcome.GAVE_UP, f"{action.reason} {REFUSED}", probe)
    return None if reply else TrialResult(core.Outcome.ABORTED, DECLINED, probe)


def _shift(
    bench: Bench, strategy: placement.Strategy, action: core.PlaceAction, probe: int
) -> Plan[None]:
    """Move to the next place; after the operator's yes to go on, to the one asked about."""
    if action.kind == "ask":
        assert isinstance(strategy, placement.SearchingStrategy)
        action = strategy.go_on()
    yield from motions.shift_piece(bench, action.step_mm, probe)


def _count_signals(bench: Bench, strategy: placement.Strategy) -> Plan[None]:
    """Compare the signals of the trial so far with those of the calibration, once a trial."""
    if bench.guard is None or not isinstance(strategy, placement.SearchingStrategy):
        return
    withdrawn = bench.guard.withdrawn
    bench.guard.observe(bench.piece.name, fused.signal_score(strategy.signal_distances()))
    if bench.guard.withdrawn and not withdrawn:
        yield core.Said(bench.now_s(), bench.guard.describe())


def _recorded(bench: Bench, pressed: PressedProbe) -> Plan[None]:
    """Publish the episode without its native-rate signals: 25 MB that stay in its file."""
    path = yield from motions.wait_until_durable(bench)
    episode = replace(pressed.episode, recording=None)
    yield core.EpisodeRecorded(
        bench.now_s(), episode, pressed.probe, "" if path is None else path.name
    )


def check_pieces(session: RunContext, request: StackRequest) -> None:
    """Raise ``InputError`` if the strategy cannot place this piece on these bottoms.

    Also if the centre of mass is unknown and not weighed, or is to be weighed and the piece is
    too light.
    """
    names, catalogue = (request.piece, *request.bottoms), session.catalogue
    known = [catalogue.pieces[name] for name in names if name in catalogue.pieces]
    method = request.method(session.method)
    placement.check_outlines(method, known)
    if request.piece in catalogue.pieces:
        check_weighing(catalogue.pieces[request.piece], method)


def certificate_status(
    bench: BenchIdentity, base: StackSettings, request: StackRequest
) -> fused.CertificateStatus:
    """Return the certificate that covers a run, or the reason why none does.

    Certificates lie beside the checkpoint, and in the calibrations of a laboratory. Raises
    ``InputError`` if the network cannot be read.
    """
    if not request.learned:
        return fused.CertificateStatus(None, "only learned fusion can have one")
    if request.weigh:
        return fused.CertificateStatus(None, "none covers a weighed centre of mass")
    method = request.method(base)
    weights = fused.network_path(method.fused.weights)
    own = () if bench.calibrations is None else (bench.calibrations,)
    claim = fused.ReleaseClaim(
        bench.name,
        bench.sha256,
        placement.load_network_of(method.fused).card.weights_sha256,
        method,
        request.piece,
        request.bottoms,
        (weights.parent, *own),
    )
    return fused.find_certificate(claim)


def release_record(
    bench: BenchIdentity, base: StackSettings, request: StackRequest, found: fused.CertificateStatus
) -> dict[str, Any]:
    """Return the part of a run's record that a certificate of its trials is made from."""
    method = request.method(base)
    return {
        "bench": bench.name,
        "bench_sha256": bench.sha256,
        "weights_sha256": placement.load_network_of(method.fused).card.weights_sha256,
        "method_sha256": fused.method_sha256(method),
        "risk": method.fused.risk,
        "weighed": request.weigh,
        "certificate": found.text,
        "scope": found.scope,
    }


def stack_run(session: RunContext, request: StackRequest) -> Plan[None]:
    """Run all trials; ends early when cancelled, stopped or on a fault."""
    method = request.method(session.method)
    check_pieces(session, request)
    guard = session.guard_of(method)
    record = {**session.check_scene(request.scene())}
    certified = request.learned
    if certified:
        status = certificate_status(session.identity, session.method, request)
        record["release"] = release_record(session.identity, session.method, request, status)
    settings = request_record(request, method, record)
    session.open_record()
    yield core.RunStarted(
        0.0, session.run_id, request.piece, "+".join(request.bottoms), request.strategy,
        request.seed, request.trials, session.simulated, settings,
    )  # fmt: skip
    if certified:
        yield core.Said(0.0, status.message)
    if guard is not None:
        yield core.Said(0.0, guard.describe())
    told = ""
    for trial in range(request.trials):
        if (withheld := session.day_checks.obstacle()) not in ("", told):
            yield core.Said(0.0, told := withheld)
        scene = session.set_scene(request.scene(trial), method)
        bench = replace(scene, guard=guard, withheld=withheld)
        seed = request.seed + trial
        start_mm = None if bench.scoring is None else bench.scoring.start_mm()
        yield core.TrialStarted(bench.now_s(), trial + 1, seed, start_mm)
        at_mm = outcome.trial_start_mm(session, request, trial) if bench.scoring is None else None
        ended = yield from motions.run_to_end(bench, _placing(bench, request, at_mm))
        if guard is not None and (problem := guard.save()):
            yield core.Said(bench.now_s(), problem)
        ending, run_ending = ended.value, ended.run_ending
        if ending is None:
            ending = TrialResult(core.Outcome.ABORTED, ended.reason, bench.status().estimated)
        elif ending.fault is not None:
            run_ending = "failed"
        if run_ending is None:
            ending = outcome.with_toppled_support(bench, ending)
        yield trial_finished(bench, trial + 1, seed, ending)
        if run_ending is not None:
            reason = ending.reason if ending.fault is None else ending.fault.what
            yield core.RunFinished(bench.now_s(), session.run_id, run_ending, reason)
            return
    yield from wait_for_space(bench.store.obstacle)
    yield core.RunFinished(bench.now_s(), session.run_id, "finished", "All trials are done.")


def _placing(
    bench: Bench, request: StackRequest, at_mm: tuple[float, float] | None
) -> Plan[TrialResult]:
    empty = (yield from weigh_empty(bench)) if bench.settings.weigh else None
    if at_mm is not None:
        yield from outcome.set_up_scene(bench, request, at_mm)
    if empty is not None:
        yield from motions.take_piece(bench)
        bench = yield from weigh_held(bench, empty)
    plan = pick_and_place if request.strategy == "pick-and-place" else place_piece
    return (yield from plan(bench))

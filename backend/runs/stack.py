"""The autonomous loop: probe, believe, judge, and release only where the piece will stand."""

from __future__ import annotations

from dataclasses import replace

from backend.core.facts import (
    ActionChosen,
    ApprovalAwaited,
    BeliefUpdated,
    EpisodeRecorded,
    FaultRaised,
    PatchEstimated,
    Said,
    StabilityJudged,
)
from backend.core.faults import FaultError
from backend.core.flow import Outcome, PlaceAction
from backend.placement.strategies import begin
from backend.placement.strategy import Held, Reasoner, SeekingReasoner, Touched
from backend.runs import words
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.judged import Felt, Judged
from backend.runs.motions import lift, release, shift, take_piece
from backend.runs.outcome import after_release
from backend.runs.plan import Checkpoint, Plan, Waiting
from backend.runs.probe import probe_until_accepted
from backend.runs.room import durable, room_awaited

OPERATOR_S = 24 * 3600.0
DECLINED = "The operator declined the next move."


def stack(bench: Bench) -> Plan[Ending]:
    """Place the piece by the chosen strategy; ends placed, fell, knocked over or gave up."""
    yield from take_piece(bench)
    here = bench.arm.pose(max_age_s=0.2)
    reasoner = begin(held_by(bench), bench.settings, (here.x_mm, here.y_mm))
    approved = bench.settings.mode == "auto"
    probe = 0
    while True:
        yield Checkpoint()
        yield from room_awaited(bench.store.obstacle)
        probe += 1
        felt = yield from _felt(bench, probe, reasoner)
        if isinstance(felt, PlaceAction):
            yield Said(bench.now_s(), f"Probe {probe}: {felt.reason}")
            yield from lift(bench, probe)
            if felt.kind == "give_up":
                return Ending(Outcome.GAVE_UP, felt.reason, probe)
            if not (yield from _asked(bench, felt, probe)):
                return Ending(Outcome.ABORTED, DECLINED, probe)
            yield from shift(bench, felt.step_mm, probe)
            continue
        judged = yield from _conclude(bench, felt, reasoner)
        bench.store.keep(felt.episode)
        held_s = judged.at_s - felt.ended_s
        late = held_s > bench.settings.probe.verdict_wait_s
        if judged.action.kind == "release" and approved and not late:
            return (yield from _let_go(bench, judged, approved=approved))
        yield from lift(bench, probe)
        yield from _recorded(bench, felt)
        if late:
            yield Said(bench.now_s(), words.late(held_s))
            continue
        if judged.action.kind == "give_up":
            return Ending(Outcome.GAVE_UP, judged.action.reason, probe)
        if not (yield from _asked(bench, judged.action, probe)):
            return Ending(Outcome.ABORTED, DECLINED, probe)
        if judged.action.kind == "release":
            # An approval covers piece, pose and run: press and judge again, then release.
            approved = True
            probe -= 1
        else:
            approved = bench.settings.mode == "auto"
            yield from shift(bench, judged.action.step_mm, probe)


def held_by(bench: Bench) -> Held:
    """Return what a strategy may know of the piece in the hand."""
    piece = bench.piece
    assert piece.grip_height_mm is not None
    return Held(
        piece.com_xy_mm,
        piece.grip_height_mm,
        bench.estimator.base_rate,
        bench.sensor_height_mm,
        bench.below,
    )


def _conclude(bench: Bench, felt: Felt, reasoner: Reasoner) -> Plan[Judged]:
    """Estimate, then conclude; announced only when the action is chosen."""
    episode = felt.episode
    here = (float(episode.offset_mm[0]), float(episode.offset_mm[1]))
    patch = bench.estimator.estimate(episode)
    concluded = reasoner.conclude(Touched(episode.observation, patch, here))
    stability, action = concluded.stability, concluded.action
    latency_ms = 1e3 * (bench.wall_s() - felt.sampled_s)
    bench.hush.end()
    now_s = bench.now_s()
    yield PatchEstimated(now_s, patch, here, felt.probe)
    yield BeliefUpdated(now_s, concluded.map, felt.probe)
    yield StabilityJudged(now_s, stability, felt.probe)
    yield ActionChosen(now_s, action, felt.probe, latency_ms)
    yield Said(now_s, words.decision(felt.probe, patch, stability, action))
    return Judged(felt, stability, action, now_s)


def _let_go(bench: Bench, judged: Judged, *, approved: bool) -> Plan[Ending]:
    """Release here and see how the piece does."""
    probe = judged.felt.probe
    yield from release(bench, judged, approved=approved)
    # What became of the piece is told first: a disk that refuses the episode must not hide it.
    ending = yield from after_release(bench, probe)
    try:
        yield from _recorded(bench, judged.felt)
    except FaultError as cause:
        bench.interlock.raise_fault(cause.fault)
        yield FaultRaised(bench.now_s(), cause.fault)
        return replace(ending, fault=cause.fault)
    return ending


def _felt(bench: Bench, probe: int, reasoner: Reasoner) -> Plan[Felt | PlaceAction]:
    """Probe; without a contact a strategy that asks for it says where to go instead."""
    try:
        return (yield from probe_until_accepted(bench, probe))
    except FaultError as cause:
        if cause.fault.code != "NO-CONTACT" or not isinstance(reasoner, SeekingReasoner):
            raise
    here = bench.arm.pose(max_age_s=0.2)
    return reasoner.missed((here.x_mm, here.y_mm))


def _asked(bench: Bench, action: PlaceAction, probe: int) -> Plan[bool]:
    """Wait for the operator in approve and step mode; the arm is lifted meanwhile."""
    if bench.settings.mode == "auto":
        return True
    bench.gate.ask()
    yield ApprovalAwaited(bench.now_s(), action, probe)
    yield Waiting(lambda: bench.gate.answered, OPERATOR_S, "the operator")
    return bench.gate.yes


def _recorded(bench: Bench, felt: Felt) -> Plan[None]:
    """Announce the episode without its native-rate signals: 25 MB that live in its file."""
    path = yield from durable(bench)
    episode = replace(felt.episode, recording=None)
    yield EpisodeRecorded(bench.now_s(), episode, felt.probe, "" if path is None else path.name)

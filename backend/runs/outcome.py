"""Outcome of a trial, judged by the bench or stated by the operator.

Trials that a device fault ended before the release are excluded from the success rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from touchdown.backend import core
from touchdown.backend.geometry import Piece, Tower, draw_start, start_generator
from touchdown.backend.runs import messages, motions
from touchdown.backend.runs.bench import Bench, RunContext
from touchdown.backend.runs.jig import approach_with_piece, pick_piece, with_handed_piece
from touchdown.backend.runs.plan import CancelledError, Plan, Wait
from touchdown.backend.runs.requests import StackRequest
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Outcome of a trial, the reason in words, and the number of probes.

    ``fault`` occurred after the release: the outcome holds and the run ends.
    """

    outcome: core.Outcome
    reason: str
    probes: int
    fault: core.Fault | None = None


# Codes of faults of a silent, lost or broken device. Failures of a press, a grip or an estimate
# (excessive force, no contact, no piece, stop) are not among them.
DEVICE_FAULTS = frozenset({
    "ARM-LINK", "ARM-STALE", "ARM-STALLED", "CAMERA-DARK", "CAMERA-FROZEN", "CAMERA-LINK",
    "CAMERA-STALE", "CONTROLLER", "FT-LINK", "FT-SENSOR", "FT-STALE", "GRIP-STALE", "MXT-ENDED",
    "MXT-LOST", "MXT-START", "PRESS-VOID", "WSG-DEVICE", "WSG-FAST-STOP", "WSG-FRAME", "WSG-LINK",
    "WSG-TIMEOUT",
})  # fmt: skip

AFTER = ("release", "rise")  # phases of the release: a fault here no longer excludes the trial


def excluding_fault(finished: core.TrialFinished, last_phase: str) -> str:
    """Return the code of the device fault that excludes a trial from the rate, "" if it counts.

    ``last_phase`` is the phase in which the trial ended. A trial counts once ``release`` has begun.
    """
    if finished.outcome is not core.Outcome.ABORTED or last_phase in AFTER:
        return ""
    # The reason of a trial that a fault ended is the text of the fault, with its code last.
    code = finished.reason.rpartition("[")[2].rstrip("]")
    return code if finished.reason.endswith(f"[{code}]") and code in DEVICE_FAULTS else ""


SIDE_N = 1.0  # lateral force that counts as contact with the opening fingers
# Three standard deviations of the wrist's slow error; lighter pieces are not weighed
WEIGHED_N = 0.75


def trial_start_mm(session: RunContext, request: StackRequest, trial: int) -> tuple[float, float]:
    """Return the start of trial 0, 1, ...: the face overlaps the bottom but would fall.

    Raises ``InputError`` if the two faces have no such place.
    """
    first, *others = (session.catalogue.piece(name) for name in request.bottoms)
    tower = Tower((first.body(),))
    for piece in others:
        tower = tower.with_top(piece.body())
    rng = start_generator(request.seed + trial, request.piece, *request.bottoms)
    return draw_start(rng, session.catalogue.piece(request.piece).body(), tower)


def set_up_scene(bench: Bench, request: StackRequest, at_mm: tuple[float, float]) -> Plan[None]:
    """Have the operator place the bottom and hand over the piece, then carry it over its start."""
    yield from motions.wait(bench, motions.FIRST_POSES_S)
    holds = bench.gripper.status().holding
    bottoms = "+".join(request.bottoms)
    question = core.SetUpAwaited(bench.now_s(), request.piece, bottoms, at_mm, holds)
    if not (yield from motions.ask_operator(bench, question, "the operator to set the scene")):
        raise CancelledError("the scene was not set")
    bench = with_handed_piece(bench)
    if not holds:
        yield from pick_piece(bench)
    sigma_mm = bench.settings.collect.origin_sigma_mm
    centre = bench.placed.origin(request.origin_mm, sigma_mm, bottoms)
    there = (centre.x_mm + at_mm[0], centre.y_mm + at_mm[1])
    yield from approach_with_piece(bench, motions.descent_start(bench, there))


def proposed_outcome(bench: Bench) -> tuple[core.Outcome, str]:
    """Return the outcome indicated by wrist and gripper, and why."""
    now_s, settings = bench.now_s(), bench.settings
    rising_s = settings.release.rise_mm / settings.probe.travel_mm_s
    since_s = now_s - 0.5 - rising_s
    wrench = bench.sensing.wrench.window(since_s, now_s).values
    side_n = float(np.hypot(wrench[:, 0], wrench[:, 1]).max()) if len(wrench) else float("nan")
    last = bench.sensing.wrench.window(now_s - 0.2, now_s).values
    left_n = float(last[:, 2].mean()) if len(last) else float("nan")
    holding = bench.gripper.status().holding
    return outcome_from_signals(bench.piece, side_n=side_n, left_n=left_n, holding=holding)


def outcome_from_signals(
    piece: Piece, *, side_n: float, left_n: float, holding: bool
) -> tuple[core.Outcome, str]:
    """Return the outcome indicated by the signals after a release, and why.

    ``side_n`` is the largest lateral force while the fingers opened and rose. ``left_n`` is the
    decrease of the vertical load since the tare, which was taken with the piece held.
    """
    weight_n = 1e-3 * piece.mass_g * STANDARD_GRAVITY_M_S2
    if holding:
        return core.Outcome.ABORTED, "The gripper still holds something."
    if weight_n > WEIGHED_N and left_n < 0.5 * weight_n:
        why = f"The load decreased by only {left_n:.1f} N of the piece's {weight_n:.1f} N."
        return core.Outcome.ABORTED, why
    if side_n > SIDE_N:
        return core.Outcome.FELL, f"The opening fingers met a lateral force of {side_n:.1f} N."
    if not side_n <= SIDE_N:
        return core.Outcome.FELL, "No wrench samples while the fingers opened."
    why = f"No lateral force on the fingers while they opened and rose ({side_n:.1f} N)."
    return core.Outcome.PLACED, why


def judge_release(bench: Bench, probe: int) -> Plan[TrialResult]:
    """Return and publish the outcome; without ground truth the operator is asked."""
    if bench.scoring is None:
        # The fingers are raised.
        (outcome, why), prompt = proposed_outcome(bench), bench.prompt
        prompt.ask()
        yield core.OutcomeAwaited(bench.now_s(), outcome, why)
        yield Wait(
            lambda: prompt.seen is not None, motions.OPERATOR_TIMEOUT_S, "the operator to judge"
        )
        assert prompt.seen is not None
        seen, reason = prompt.seen
        ending = TrialResult(seen, messages.seen_outcome_message(seen, reason), probe)
        yield core.Released(bench.now_s(), probe, ending.outcome is core.Outcome.PLACED, None, None)
        return ending
    verdict = bench.scoring.verdict()
    yield core.Released(bench.now_s(), probe, verdict.stands, verdict.margin_mm, verdict.fall)
    if verdict.knocked_over:
        return TrialResult(core.Outcome.KNOCKED_OVER, "The support was knocked over.", probe)
    outcome = core.Outcome.PLACED if verdict.stands else core.Outcome.FELL
    reason = messages.release_message(verdict.stands, verdict.margin_mm, verdict.kick_mm)
    if verdict.contradicted:
        reason = f"{reason} {messages.CONTRADICTED}"
    return TrialResult(outcome, reason, probe)


def with_toppled_support(bench: Bench, ending: TrialResult) -> TrialResult:
    """Return the outcome of a trial; one that knocked its support over has no other outcome."""
    if bench.scoring is None or not bench.scoring.verdict().knocked_over:
        return ending
    if ending.outcome is core.Outcome.KNOCKED_OVER:
        return ending
    reason = f"The support was knocked over. {ending.reason}"
    return replace(ending, outcome=core.Outcome.KNOCKED_OVER, reason=reason)


def trial_finished(bench: Bench, trial: int, seed: int, ending: TrialResult) -> core.TrialFinished:
    """Return the final event of a trial, with the ground truth where it is known."""
    margin_mm = excess = contradicted = None
    if bench.scoring is not None:
        verdict = bench.scoring.verdict()
        margin_mm, contradicted = verdict.margin_mm, verdict.contradicted
        if ending.outcome is core.Outcome.PLACED:
            excess = max(0, ending.probes - bench.scoring.least_probes())
    return core.TrialFinished(
        bench.now_s(), trial, seed, ending.outcome, ending.reason, ending.probes, excess,
        margin_mm, contradicted,
    )  # fmt: skip

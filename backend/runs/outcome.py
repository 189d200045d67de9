"""Outcome of a trial, as judged by the bench or stated by the operator.

Trials that a device fault ended before the release are left out of the success rate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import (
    Fault,
    Outcome,
    OutcomeAwaited,
    Released,
    SetUpAwaited,
    TrialFinished,
)
from touchdown.backend.geometry import Piece, Tower, draw_start
from touchdown.backend.runs import messages
from touchdown.backend.runs.bench import Bench, RunContext
from touchdown.backend.runs.jig import approach_with_piece, pick_piece, with_handed_piece
from touchdown.backend.runs.motions import descent_start, wait
from touchdown.backend.runs.plan import CancelledError, Plan, Wait
from touchdown.backend.runs.requests import StackRequest
from touchdown.backend.sensing import STANDARD_GRAVITY_M_S2


@dataclass(frozen=True, slots=True)
class TrialResult:
    """Outcome of a trial, the reason in words, and the number of probes.

    ``fault``: what failed once the piece was let go; the outcome holds, the run ends with it.
    """

    outcome: Outcome
    reason: str
    probes: int
    fault: Fault | None = None


DEVICE_FAULTS = frozenset({
    "ARM-LINK", "ARM-STALE", "CAMERA-DARK", "CAMERA-FROZEN", "CAMERA-LINK", "CAMERA-STALE",
    "CONTROLLER", "FT-LINK", "FT-SENSOR", "FT-STALE", "MXT-ENDED", "MXT-LOST", "MXT-START",
    "PRESS-VOID", "WSG-DEVICE", "WSG-FAST-STOP", "WSG-FRAME", "WSG-LINK", "WSG-TIMEOUT",
})  # fmt: skip
"""Codes of faults that say that a device was silent, lost or broken. What a press, a grip or an
estimate came to (too much force, no contact, no piece, a stop) is a failure and not among them.
"""

AFTER = ("release", "rise")
"""Phases in which the piece is let go: what fails here no longer excuses the trial."""


def excusing_fault(finished: TrialFinished, last_phase: str) -> str:
    """Return the code of the device fault that keeps a trial out of the rate, "" if it counts.

    ``last_phase``: that in which the trial ended; once ``release`` has begun nothing excuses.
    """
    if finished.outcome is not Outcome.ABORTED or last_phase in AFTER:
        return ""
    # A trial that a fault ended gives the fault's own words, which end with its code.
    code = finished.reason.rpartition("[")[2].rstrip("]")
    return code if finished.reason.endswith(f"[{code}]") and code in DEVICE_FAULTS else ""


OPERATOR_S = 24 * 3600.0
FIRST_POSES_S = 0.1
"""A scene that was just set has no pose of the arm yet."""
SIDE_N = 1.0
"""A force that counts as contact: with it something leans on the fingers that let go."""
WEIGHED_N = 0.75
"""Three standard deviations of the wrist's slow error: lighter pieces cannot be weighed."""
STARTS = 77
"""Number of the random stream of starts, the same as on the simulated bench."""


def trial_start_mm(host: RunContext, request: StackRequest, trial: int) -> tuple[float, float]:
    """Return the start of trial 0, 1, ...: where the face is over the bottom, and would fall.

    Raises ``InputError`` where the two faces have no such place.
    """
    first, *others = (host.catalogue.piece(name) for name in request.bottoms)
    tower = Tower((first.body(),))
    for piece in others:
        tower = tower.with_top(piece.body())
    seeds = np.random.SeedSequence([request.seed + trial, STARTS])
    rng = np.random.Generator(np.random.PCG64(seeds))
    return draw_start(rng, host.catalogue.piece(request.piece).body(), tower)


def set_up_scene(bench: Bench, request: StackRequest, at_mm: tuple[float, float]) -> Plan[None]:
    """Have the bottom put in place and the piece handed over, then carry it over its start."""
    yield from wait(bench, FIRST_POSES_S)
    holds = bench.gripper.status().holding
    bench.gate.ask()
    yield SetUpAwaited(bench.now_s(), request.piece, "+".join(request.bottoms), at_mm, holds)
    yield Wait(lambda: bench.gate.answered, OPERATOR_S, "the operator to set the scene")
    if not bench.gate.yes:
        raise CancelledError("the scene was not set")
    bench = with_handed_piece(bench)
    if not holds:
        yield from pick_piece(bench)
    sigma_mm = bench.settings.collect.origin_sigma_mm
    centre = bench.placed.origin(request.origin_mm, sigma_mm, "+".join(request.bottoms))
    there = (centre.x_mm + at_mm[0], centre.y_mm + at_mm[1])
    yield from approach_with_piece(bench, descent_start(bench, there))


def ask_outcome(bench: Bench, probe: int) -> Plan[TrialResult]:
    """Ask the operator what became of the piece that was let go; the fingers have risen."""
    outcome, why = proposed_outcome(bench)
    bench.gate.ask()
    yield OutcomeAwaited(bench.now_s(), outcome, why)
    yield Wait(lambda: bench.gate.seen is not None, OPERATOR_S, "the operator to judge")
    assert bench.gate.seen is not None
    seen, reason = bench.gate.seen
    return TrialResult(seen, messages.seen_outcome_message(seen, reason), probe)


def proposed_outcome(bench: Bench) -> tuple[Outcome, str]:
    """Return the outcome that wrist and gripper speak for, and why."""
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
) -> tuple[Outcome, str]:
    """Return what the signals after a release speak for, and why.

    ``side_n``: largest lateral force while the fingers opened and rose. ``left_n``: by how much the
    wrist was relieved since the tare, which was taken with the piece held.
    """
    weight_n = 1e-3 * piece.mass_g * STANDARD_GRAVITY_M_S2
    if holding:
        return Outcome.ABORTED, "The gripper still holds something."
    if weight_n > WEIGHED_N and left_n < 0.5 * weight_n:
        return (
            Outcome.ABORTED,
            f"The hand lost only {left_n:.1f} N of the {weight_n:.1f} N that the piece weighs.",
        )
    if side_n > SIDE_N:
        return Outcome.FELL, f"Something pushed the opening fingers with {side_n:.1f} N."
    if not side_n <= SIDE_N:
        return Outcome.FELL, "The wrist was silent while the fingers opened."
    return (
        Outcome.PLACED,
        f"Nothing pushed the fingers while they opened and rose ({side_n:.1f} N).",
    )


def judge_release(bench: Bench, probe: int) -> Plan[TrialResult]:
    """Announce what a bench with known truth says; without truth the operator is asked."""
    if bench.scoring is None:
        ending = yield from ask_outcome(bench, probe)
        yield Released(bench.now_s(), probe, ending.outcome is Outcome.PLACED, None, None)
        return ending
    verdict = bench.scoring.verdict()
    yield Released(bench.now_s(), probe, verdict.stands, verdict.margin_mm, verdict.fall)
    if verdict.knocked_over:
        return TrialResult(Outcome.KNOCKED_OVER, "The support was knocked over.", probe)
    outcome = Outcome.PLACED if verdict.stands else Outcome.FELL
    reason = messages.release_message(verdict.stands, verdict.margin_mm)
    if verdict.contradicted:
        reason = f"{reason} {messages.CONTRADICTED}"
    return TrialResult(outcome, reason, probe)


def trial_finished(bench: Bench, trial: int, seed: int, ending: TrialResult) -> TrialFinished:
    """Return the closing fact of a trial, with the truth where it is known."""
    margin_mm = excess = contradicted = None
    if bench.scoring is not None:
        verdict = bench.scoring.verdict()
        margin_mm, contradicted = verdict.margin_mm, verdict.contradicted
        if ending.outcome is Outcome.PLACED:
            excess = max(0, ending.probes - bench.scoring.least_probes())
    return TrialFinished(
        bench.now_s(),
        trial,
        seed,
        ending.outcome,
        ending.reason,
        ending.probes,
        excess,
        margin_mm,
        contradicted,
    )

"""A trial where the truth is not known: an operator sets the scene, and says what became of it.

The start is drawn from the offsets at which the piece would fall; afterwards wrist and gripper
propose an outcome, and the operator decides.
"""

from __future__ import annotations

import numpy as np

from backend.core.facts import OutcomeAwaited, SetUpAwaited
from backend.core.flow import Outcome
from backend.objects.catalogue import Piece
from backend.objects.starts import draw_start
from backend.objects.tower import Tower
from backend.runs import words
from backend.runs.bench import Bench
from backend.runs.descents import place_over
from backend.runs.ending import Ending
from backend.runs.host import RunHost
from backend.runs.jig import approach, handed, pick
from backend.runs.motions import rest
from backend.runs.plan import CancelledError, Plan, Waiting
from backend.runs.requests import StackRequest
from backend.sensing.tare import STANDARD_GRAVITY_M_S2

OPERATOR_S = 24 * 3600.0
FIRST_POSES_S = 0.1
"""A scene that was just set has no pose of the arm yet."""
SIDE_N = 1.0
"""A force that counts as contact: with it something leans on the fingers that let go."""
WEIGHED_N = 0.75
"""Three standard deviations of the wrist's slow error: lighter pieces cannot be weighed."""
STARTS = 77
"""Number of the random stream of starts, the same as on the simulated bench."""


def start_mm(host: RunHost, request: StackRequest, trial: int) -> tuple[float, float]:
    """Return the start of trial 0, 1, ...: where the face is over the bottom, and would fall.

    Raises ``InputError`` where the two faces have no such place.
    """
    first, *others = (host.piece(name) for name in request.bottoms)
    tower = Tower((first.body(),))
    for piece in others:
        tower = tower.with_top(piece.body())
    seeds = np.random.SeedSequence([request.seed + trial, STARTS])
    rng = np.random.Generator(np.random.PCG64(seeds))
    return draw_start(rng, host.piece(request.piece).body(), tower)


def set_up(bench: Bench, request: StackRequest, at_mm: tuple[float, float]) -> Plan[None]:
    """Have the bottom put in place and the piece handed over, then carry it over its start."""
    yield from rest(bench, FIRST_POSES_S)
    holds = bench.gripper.status().holding
    bench.gate.ask()
    yield SetUpAwaited(bench.now_s(), request.piece, "+".join(request.bottoms), at_mm, holds)
    yield Waiting(lambda: bench.gate.answered, OPERATOR_S, "the operator to set the scene")
    if not bench.gate.yes:
        raise CancelledError("the scene was not set")
    bench = handed(bench)
    if not holds:
        yield from pick(bench)
    sigma_mm = bench.settings.collect.origin_sigma_mm
    centre = bench.placed.origin(request.origin_mm, sigma_mm, "+".join(request.bottoms))
    there = (centre.x_mm + at_mm[0], centre.y_mm + at_mm[1])
    yield from approach(bench, place_over(bench, there))


def seen_outcome(bench: Bench, probe: int) -> Plan[Ending]:
    """Ask the operator what became of the piece that was let go; the fingers have risen."""
    outcome, why = proposed(bench)
    bench.gate.ask()
    yield OutcomeAwaited(bench.now_s(), outcome, why)
    yield Waiting(lambda: bench.gate.seen is not None, OPERATOR_S, "the operator to judge")
    assert bench.gate.seen is not None
    seen, reason = bench.gate.seen
    return Ending(seen, words.seen(seen, reason), probe)


def proposed(bench: Bench) -> tuple[Outcome, str]:
    """Return the outcome that wrist and gripper speak for, and why."""
    now_s, settings = bench.now_s(), bench.settings
    rising_s = settings.release.rise_mm / settings.probe.travel_mm_s
    since_s = now_s - 0.5 - rising_s
    wrench = bench.sensing.wrench.window(since_s, now_s).values
    side_n = float(np.hypot(wrench[:, 0], wrench[:, 1]).max()) if len(wrench) else float("nan")
    last = bench.sensing.wrench.window(now_s - 0.2, now_s).values
    left_n = float(last[:, 2].mean()) if len(last) else float("nan")
    holding = bench.gripper.status().holding
    return judged(bench.piece, side_n=side_n, left_n=left_n, holding=holding)


def judged(piece: Piece, *, side_n: float, left_n: float, holding: bool) -> tuple[Outcome, str]:
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

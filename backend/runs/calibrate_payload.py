"""Weigh the empty gripper in six poses: what it weighs, and how the sensor is turned."""

from __future__ import annotations

import math

import numpy as np

from backend.calibration.estimate import Estimate
from backend.calibration.payload import POSES, estimate_level_payload, estimate_payload
from backend.calibration.wrist import estimate_wrist
from backend.core.facts import PhaseEntered, Progress
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray, Pose
from backend.core.turning import turn_of
from backend.runs.bench import Bench
from backend.runs.motions import go, rest, zero_wrench
from backend.runs.plan import Checkpoint, Plan
from backend.runs.requests import CalibrateRequest

RAISE_MM = 60.0
"""The hand leans only this far above where it is."""
LEAN = math.radians(14.0)
LEANS = (
    (0.0, 0.0), (LEAN, 0.0), (-LEAN, 0.0), (0.0, LEAN), (0.0, -LEAN), (0.7 * LEAN, 0.7 * LEAN),
)  # fmt: skip
"""Turns about x and y, rad."""
LEVEL_MM = ((0.0, 0.0), (30.0, 0.0), (-30.0, 0.0), (0.0, 30.0), (0.0, -30.0), (0.0, 0.0))
"""Places of a hand that stays level: cables pull differently at each."""
SETTLE_S, WEIGH_S = 0.5, 1.0


def measure_payload(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    """Return what hangs below the sensor; refused while a piece is held.

    An arm that cannot turn its hand stays level: mass and place in the plane only.
    """
    turns, wrenches = yield from _weighed(bench)
    if bench.arm.rotates:
        return estimate_payload(turns, wrenches)
    return estimate_level_payload(wrenches)


def measure_wrist(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    """Return how the wrist sensor is turned; refused where the hand cannot lean."""
    if not bench.arm.rotates:
        raise RefusedError("CANNOT-TURN", "This arm keeps its hand level: the yaw shows no weight.")
    turns, wrenches = yield from _weighed(bench)
    return estimate_wrist(turns, wrenches)


def _weighed(bench: Bench) -> Plan[tuple[FloatArray, FloatArray]]:
    """Return turns (6, 3, 3) and mean untared wrenches (6, 6); refused while a piece is held."""
    if bench.gripper.status().holding:
        raise RefusedError("HOLDING", "A piece is held: put it away, the gripper is weighed empty.")
    # What leaning changes must not look like a contact.
    yield from zero_wrench(bench)
    here = bench.arm.pose(max_age_s=0.2)
    turns, wrenches = [], []
    for at, place in enumerate(_poses(here, rotates=bench.arm.rotates)):
        yield Checkpoint()
        yield Progress(bench.now_s(), at, POSES, f"pose {at + 1} of {POSES}")
        yield PhaseEntered(bench.now_s(), "shift", 0)
        yield from go(bench, place, "the hand to lean")
        yield from rest(bench, SETTLE_S + WEIGH_S)
        turns.append(turn_of(bench.arm.pose(max_age_s=0.2)))
        wrenches.append(_mean(bench))
    yield Progress(bench.now_s(), POSES, POSES, "back to level")
    high = Pose(here.x_mm, here.y_mm, here.z_mm + RAISE_MM)
    yield from go(bench, high, "the hand to level")
    return np.stack(turns), np.stack(wrenches)


def _poses(here: Pose, *, rotates: bool) -> list[Pose]:
    high_mm = here.z_mm + RAISE_MM
    if rotates:
        return [Pose(here.x_mm, here.y_mm, high_mm, rx, ry) for rx, ry in LEANS]
    return [Pose(here.x_mm + x, here.y_mm + y, high_mm) for x, y in LEVEL_MM]


def _mean(bench: Bench) -> FloatArray:
    """Return the mean untared wrench (6,) of the last ``WEIGH_S``; NaN without samples."""
    now_s = bench.now_s()
    window = bench.sensing.raw.samples.window(now_s - WEIGH_S, now_s)
    if not len(window.t_s):
        return np.full(6, np.nan)
    return np.asarray(window.values.mean(axis=0), dtype=np.float64)

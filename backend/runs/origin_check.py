"""Check where the bottom is: feel its edges on both sides, the centre lies between them.

The moment of a press would need no search, but the tilt of a board of 0.2 degrees shifts the centre
of pressure by several mm; whether there is a contact at all depends on the outlines alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.core.facts import OriginChecked, PhaseEntered
from backend.core.faults import FaultError, RefusedError
from backend.core.flow import FloatArray, Pose
from backend.devices.protocols import PressCommand
from backend.runs.bench import Bench
from backend.runs.collected import Origin
from backend.runs.jig import approach
from backend.runs.motions import MOVE_S, rest
from backend.runs.plan import Plan, Waiting, motion_done

SEARCH_MM = 3.0
"""An edge is looked for this far on both sides of where it should be."""
RESOLUTION_MM = 0.1
BELOW_MM = 1.2
"""No contact down to this far below the centre's height: the piece is beside the bottom."""
DEPTH_MM, TOUCH_S = 0.1, 0.1
SETTLE_S = 0.3


@dataclass(frozen=True, slots=True)
class Check:
    """``residual_mm`` (2,): felt centre of the bottom minus the origin; standard uncertainty.

    The uncertainty holds resolution, arm, and the piece in this very grasp.
    """

    residual_mm: FloatArray
    sigma_mm: float

    @property
    def agrees(self) -> bool:
        """Whether the residual is within three standard uncertainties on both axes."""
        return bool(np.abs(self.residual_mm).max() <= 3.0 * self.sigma_mm)


def check_origin(bench: Bench, origin: Origin) -> Plan[Check]:
    """Touch with the held piece at known displacements around all four edges.

    Raises ``RefusedError`` "ORIGIN-FAR" if an edge is more than ``SEARCH_MM`` off.
    """
    start_mm = (bench.piece.grip_height_mm or 0.0) + bench.settings.probe.start_height_mm
    yield from approach(bench, Pose(origin.x_mm, origin.y_mm, start_mm))
    centre = np.array([origin.x_mm, origin.y_mm])
    contact_mm = yield from _touched_mm(bench, centre, start_mm, 2.0 * BELOW_MM)
    if contact_mm is None:
        raise RefusedError(
            "ORIGIN-FAR", "Nothing is felt where the centre of the bottom should be."
        )
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    reach = np.add(bench.piece.face.half_extents_mm, bench.outline.half_extents_mm)
    for axis in range(2):
        edges = []
        for side in (-1.0, 1.0):
            edge = yield from _edge_mm(bench, centre, axis, side * float(reach[axis]), start_mm)
            edges.append(edge)
        centre[axis] += 0.5 * (edges[0] + edges[1])
    collect = bench.settings.collect
    touch = math.hypot(RESOLUTION_MM / math.sqrt(12.0), collect.arm_sigma_mm) / math.sqrt(2.0)
    check = Check(centre - (origin.x_mm, origin.y_mm), math.hypot(touch, collect.grip_sigma_mm))
    x_mm, y_mm = check.residual_mm.tolist()
    yield OriginChecked(bench.now_s(), (x_mm, y_mm), check.sigma_mm, check.agrees)
    return check


def _edge_mm(
    bench: Bench, centre: FloatArray, axis: int, expected_mm: float, start_mm: float
) -> Plan[float]:
    """Return how far from ``centre`` along ``axis`` contact ends, by halving."""
    side = math.copysign(1.0, expected_mm)
    inside, outside = abs(expected_mm) - SEARCH_MM, abs(expected_mm) + SEARCH_MM
    least, most = inside, outside
    while outside - inside > RESOLUTION_MM:
        middle = 0.5 * (inside + outside)
        place = centre.copy()
        place[axis] += side * middle
        touched = yield from _touched_mm(bench, place, start_mm, BELOW_MM)
        if touched is None:
            outside = middle
        else:
            inside = middle
    if inside == least or outside == most:
        raise RefusedError(
            "ORIGIN-FAR", f"The bottom is more than {SEARCH_MM:.0f} mm from where it should be."
        )
    return side * 0.5 * (inside + outside)


def _touched_mm(
    bench: Bench, place: FloatArray, start_mm: float, below_mm: float
) -> Plan[float | None]:
    """Descend at ``place`` (2,); return the height of contact, None if there is none."""
    probe = bench.settings.probe
    x_mm, y_mm = place.tolist()
    motion = bench.arm.move_to(Pose(x_mm, y_mm, start_mm), probe.travel_mm_s)
    yield from motion_done(motion, MOVE_S, "the arm to shift")
    yield from rest(bench, SETTLE_S)
    yield PhaseEntered(bench.now_s(), "approach", 0)
    press = bench.arm.press(
        PressCommand(
            depth_mm=DEPTH_MM,
            ramp_s=TOUCH_S,
            hold_s=2.0 * TOUCH_S,
            approach_mm_s=probe.approach_mm_s,
            threshold_n=probe.threshold_n,
            max_travel_mm=probe.start_height_mm + below_mm,
            stiffness_n_mm=probe.stiffness_n_mm,
        )
    )
    yield Waiting(lambda: press.done, MOVE_S, "the touch to end")
    onset_s = press.onset_s
    try:
        press.result()
    except FaultError as cause:
        if cause.fault.code != "NO-CONTACT":
            raise
    height_mm = None if onset_s is None else _height_mm(bench, onset_s)
    yield PhaseEntered(bench.now_s(), "lift", 0)
    up = bench.arm.move_to(Pose(x_mm, y_mm, start_mm), probe.travel_mm_s)
    yield from motion_done(up, MOVE_S, "the arm to lift")
    return height_mm


def _height_mm(bench: Bench, t_s: float) -> float:
    poses = bench.arm.poses.window(t_s - 0.1, t_s + 0.1)
    return float(np.interp(t_s, poses.t_s, poses.values[:, 2]))

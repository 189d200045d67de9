"""Touch probing with the held piece: height of a surface, position of its edges."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from touchdown.backend import core
from touchdown.backend.runs.bench import Bench
from touchdown.backend.runs.jig import approach_with_piece
from touchdown.backend.runs.motions import (
    MOVE_S,
    TOUCH_TRIES,
    move_to,
    press_command,
    retry_if_void,
    wait,
)
from touchdown.backend.runs.plan import Plan, Wait

SEARCH_MM = 3.0  # search range on both sides of the expected edge
RESOLUTION_MM, FINE_MM = 0.1, 0.05
BELOW_MM = 1.2  # Without contact this far below the centre's height, the piece is beside the bottom
DEPTH_MM, TOUCH_S = 0.1, 0.1
SETTLE_S = 0.3


def find_height(bench: Bench, centre: core.FloatArray) -> Plan[float]:
    """Carry the piece over ``centre`` (2,), touch, and return the height of contact.

    Raises ``RefusedError`` "ORIGIN-FAR" without contact.
    """
    x_mm, y_mm = centre.tolist()
    start_mm = (bench.piece.grip_height_mm or 0.0) + bench.settings.probe.start_height_mm
    yield from approach_with_piece(bench, core.Pose(x_mm, y_mm, start_mm))
    contact_mm = yield from touch_height_mm(bench, centre, start_mm, 2.0 * BELOW_MM)
    if contact_mm is None:
        raise core.RefusedError("ORIGIN-FAR", "No contact at the expected centre of the bottom.")
    return contact_mm


def edge_mm(
    bench: Bench,
    centre: core.FloatArray,
    axis: int,
    side: float,
    start_mm: float,
    to_mm: float = RESOLUTION_MM,
) -> Plan[float]:
    """Return the distance from ``centre`` along ``axis`` where contact ends, by bisection to
    ``to_mm``.

    ``side`` is +1 or -1; descents begin at ``start_mm``. Raises ``RefusedError`` "ORIGIN-FAR" if
    the edge is more than ``SEARCH_MM`` off.
    """
    expected_mm = bench.piece.face.half_extents_mm[axis] + bench.outline.half_extents_mm[axis]
    inside, outside = expected_mm - SEARCH_MM, expected_mm + SEARCH_MM
    least, most = inside, outside
    while outside - inside > to_mm:
        middle = 0.5 * (inside + outside)
        place = centre.copy()
        place[axis] += side * middle
        touched = yield from touch_height_mm(bench, place, start_mm, BELOW_MM)
        if touched is None:
            outside = middle
        else:
            inside = middle
    if inside == least or outside == most:
        raise core.RefusedError(
            "ORIGIN-FAR", f"The bottom is more than {SEARCH_MM:.0f} mm from where it should be."
        )
    return side * 0.5 * (inside + outside)


def touch_height_mm(
    bench: Bench, place: core.FloatArray, start_mm: float, below_mm: float
) -> Plan[float | None]:
    """Descend at ``place`` (2,) from ``start_mm``; return the height of contact, None without one.

    The descent ends ``below_mm`` below the usual contact height. The arm ends at ``start_mm``. A
    void touch is repeated.
    """
    touch = partial(_touched_mm, bench, place, start_mm, below_mm)
    return (yield from retry_if_void(bench, touch, void_touch(bench, start_mm), TOUCH_TRIES))


def void_touch(bench: Bench, start_mm: float) -> Callable[[core.Fault], Plan[None]]:
    """Return the plan after a void touch: say why, rise to ``start_mm``."""

    def after_void(fault: core.Fault) -> Plan[None]:
        yield core.Said(bench.now_s(), f"The touch is void: {fault.what} Touching again.")
        yield from rise_from_contact(bench, start_mm)

    return after_void


def rise_from_contact(bench: Bench, start_mm: float) -> Plan[None]:
    """Rise straight up to ``start_mm`` from where the contact pushed the arm, without dragging."""
    yield core.PhaseEntered(bench.now_s(), "lift", 0)
    here = bench.arm.pose(max_age_s=0.2)
    up = core.Pose(here.x_mm, here.y_mm, start_mm)
    yield from move_to(bench, up, "the arm to lift")


def _touched_mm(
    bench: Bench, place: core.FloatArray, start_mm: float, below_mm: float
) -> Plan[float | None]:
    x_mm, y_mm = place.tolist()
    yield from move_to(bench, core.Pose(x_mm, y_mm, start_mm), "the arm to shift")
    yield from wait(bench, SETTLE_S)
    yield core.PhaseEntered(bench.now_s(), "approach", 0)
    press = bench.arm.press(press_command(bench, DEPTH_MM, TOUCH_S, 2.0 * TOUCH_S, below_mm))
    yield Wait(lambda: press.done, MOVE_S, "the touch to end")
    onset_s = press.onset_s
    try:
        press.result()
    except core.FaultError as cause:
        if cause.fault.code != "NO-CONTACT":
            raise
    height_mm = None
    if onset_s is not None:
        poses = bench.arm.poses.window(onset_s - 0.1, onset_s + 0.1)
        height_mm = float(np.interp(onset_s, poses.t_s, poses.values[:, 2]))
    yield from rise_from_contact(bench, start_mm)
    return height_mm

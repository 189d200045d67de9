"""Where and how far the hand may turn: high over the surface, leaning little, free of force.

Turns are (3, 3) in the bench frame throughout; ``surface_mm`` is the height of ``G`` at which a
held piece touches the support, NaN where nobody knows.
"""

from __future__ import annotations

import math

import numpy as np

from backend.core.faults import RefusedError
from backend.core.flow import Pose
from backend.core.turning import (
    LEVEL_RAD,
    room_to_tilt_rad,
    tilt_rad,
    turn_of,
    turned_rad,
)
from backend.devices.interlock import Limits
from backend.devices.jog_limits import Way, refuse_outside, refuse_unknown

SLACK_RAD = 1e-6
"""A hand that was turned to its limit is at it, whatever the last digit says."""


def refuse_turning(pose: Pose, surface_mm: float, press_n: float, limits: Limits) -> None:
    """Raise ``RefusedError`` unless the hand may turn, or stay turned, at this place."""
    refuse_unknown(press_n)
    if not abs(press_n) <= limits.contact_n:
        raise RefusedError(
            "TURN-PRESSING", f"Fz is {press_n:.1f} N: lift first, then turn the hand."
        )
    if math.isnan(surface_mm):
        raise RefusedError(
            "TURN-LOW", "The height of the surface is not known: the hand cannot turn over it."
        )
    up_mm = surface_mm + limits.turn_clear_mm - pose.z_mm
    if not up_mm <= 0.0:
        raise RefusedError(
            "TURN-LOW",
            f"The hand turns only {limits.turn_clear_mm:.0f} mm or more above the surface: "
            f"jog +Z by {up_mm:.1f} mm first.",
        )


def refuse_place(pose: Pose, surface_mm: float, limits: Limits) -> None:
    """Raise ``RefusedError`` unless the hand may be at ``pose``, turned as that says."""
    refuse_outside(pose, limits)
    lean_rad = tilt_rad(turn_of(pose))
    if not lean_rad <= limits.tilt_rad + SLACK_RAD:
        raise RefusedError(
            "TILT",
            f"The hand would lean by {math.degrees(lean_rad):.1f}\N{DEGREE SIGN}: "
            f"{math.degrees(limits.tilt_rad):.0f}\N{DEGREE SIGN} is the most.",
        )
    if turned_rad(pose) > LEVEL_RAD:
        refuse_turning(pose, surface_mm, 0.0, limits)


def room_rad(pose: Pose, axis: Way, limits: Limits) -> float:
    """Return how far the hand may turn about ``axis`` (unit, bench frame) until it leans too far.

    Half a turn at most: the shorter way round is the other one.
    """
    room = room_to_tilt_rad(turn_of(pose), np.array(axis), limits.tilt_rad)
    return min(room, math.pi)


def falls_mm(pose: Pose, surface_mm: float, limits: Limits) -> float:
    """Return how far a turned hand may go down; the soft limit alone holds an unturned one."""
    if turned_rad(pose) <= LEVEL_RAD:
        return math.inf
    return max(pose.z_mm - surface_mm - limits.turn_clear_mm, 0.0)

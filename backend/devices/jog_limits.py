"""Limits of a jog: how far each axis may go."""

from __future__ import annotations

import math

import numpy as np

from touchdown.backend.core import (
    LEVEL_RAD,
    Pose,
    RefusedError,
    pose_rotation,
    rotation_angle_rad,
    tilt_margin_rad,
    tilt_rad,
)
from touchdown.backend.devices.interlock import Limits

Way = tuple[float, float, float]


def room_mm(pose: Pose, way: Way, limits: Limits) -> float:
    """Return how far ``G`` may go along ``way`` before the workspace ends; 0 outside of it."""
    across = way[0] ** 2 + way[1] ** 2
    inside = limits.reach_mm**2 - pose.x_mm**2 - pose.y_mm**2
    outwards = pose.x_mm * way[0] + pose.y_mm * way[1]
    room = math.inf
    if across > 0.0:
        root = outwards**2 + across * inside
        room = (math.sqrt(root) - outwards) / across if root > 0.0 else 0.0
    if way[2] > 0.0:
        room = min(room, (limits.highest_mm - pose.z_mm) / way[2])
    elif way[2] < 0.0:
        room = min(room, (limits.lowest_mm - pose.z_mm) / way[2])
    sides = (
        (pose.x_mm, way[0], limits.least_x_mm, limits.most_x_mm),
        (pose.y_mm, way[1], limits.least_y_mm, limits.most_y_mm),
    )
    for at, part, least, most in sides:
        if part != 0.0:
            room = min(room, ((most if part > 0.0 else least) - at) / part)
    return max(room, 0.0)


def outside_box_mm(pose: Pose, limits: Limits) -> float:
    """Return how far ``pose`` is outside the sides of the workspace box; 0 inside."""
    return max(
        0.0,
        limits.least_x_mm - pose.x_mm,
        pose.x_mm - limits.most_x_mm,
        limits.least_y_mm - pose.y_mm,
        pose.y_mm - limits.most_y_mm,
    )


def refuse_outside(target: Pose, limits: Limits) -> None:
    """Raise ``RefusedError`` unless ``target`` is in the workspace."""
    over = math.hypot(target.x_mm, target.y_mm) - limits.reach_mm
    if not over <= 0.0:
        raise RefusedError("REACH", f"The target is {over:.1f} mm outside the workspace.")
    over = outside_box_mm(target, limits)
    if not over <= 0.0:
        raise RefusedError("BOX", f"The target is {over:.1f} mm outside the workspace box.")
    if not limits.lowest_mm <= target.z_mm <= limits.highest_mm:
        raise RefusedError(
            "HEIGHT",
            f"z = {target.z_mm:.1f} mm is not within {limits.lowest_mm:.0f} to "
            f"{limits.highest_mm:.0f} mm.",
        )


def refuse_unknown(press_n: float) -> None:
    """Raise ``RefusedError`` where the wrist has no young number to tell."""
    if not math.isfinite(press_n):
        raise RefusedError("FT-UNKNOWN", "The force at the wrist is not known.")


def refuse_forced(
    press_n: float, way: Way, limits: Limits, *, recovering: bool, degraded: str = ""
) -> None:
    """Raise ``RefusedError`` if the wrist feels a force that forbids ``way``; NaN refuses.

    ``degraded``: which device is late or slow, in words; then only the way out of contact is free.
    """
    refuse_unknown(press_n)
    # Below the force of a contact the sign is noise, and up is away from whatever may be below.
    up = press_n >= -limits.contact_n
    if (way[2] if up else -way[2]) > 0.99:
        return
    free = "+Z" if up else "\N{MINUS SIGN}Z"
    if abs(press_n) > limits.jog_guard_n:
        raise RefusedError(
            "JOG-FORCE",
            f"Fz is {press_n:.1f} N, over the guard of {limits.jog_guard_n:.0f} N: "
            f"only {free} is possible.",
        )
    if recovering:
        raise RefusedError(
            "RECOVERY", f"After a fault only {free}, away from contact, is possible."
        )
    if degraded:
        raise RefusedError("DEGRADED", f"{degraded} Until it is well only {free} is possible.")
    if abs(press_n) > limits.contact_n and math.hypot(way[0], way[1]) > 1e-6:
        raise RefusedError("DRAGGING", f"Fz is {press_n:.1f} N: lift first, then move sideways.")


def fastest_mm_s(
    pose: Pose, surface_mm: float, press_n: float, limits: Limits, *, recovering: bool
) -> tuple[float, str]:
    """Return the highest speed here and why it is lower than usual ("" if it is not).

    ``surface_mm``: height of ``G`` at which a held piece touches the support; NaN is near.
    """
    if not abs(press_n) <= limits.contact_n:
        return limits.contact_speed_mm_s, f"|Fz| over {limits.contact_n:.0f} N"
    if not pose.z_mm - surface_mm >= limits.near_mm:
        return limits.contact_speed_mm_s, f"within {limits.near_mm:.0f} mm of the surface"
    if recovering:
        return limits.recovery_mm_s, "recovery"
    return limits.jog_mm_s, ""


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
    lean_rad = tilt_rad(pose_rotation(pose))
    if not lean_rad <= limits.tilt_rad + SLACK_RAD:
        raise RefusedError(
            "TILT",
            f"The hand would lean by {math.degrees(lean_rad):.1f}\N{DEGREE SIGN}: "
            f"{math.degrees(limits.tilt_rad):.0f}\N{DEGREE SIGN} is the most.",
        )
    if rotation_angle_rad(pose) > LEVEL_RAD:
        refuse_turning(pose, surface_mm, 0.0, limits)


def room_rad(pose: Pose, axis: Way, limits: Limits) -> float:
    """Return how far the hand may turn about ``axis`` (unit, bench frame) until it leans too far.

    Half a turn at most: the shorter way round is the other one.
    """
    room = tilt_margin_rad(pose_rotation(pose), np.array(axis), limits.tilt_rad)
    return min(room, math.pi)


def falls_mm(pose: Pose, surface_mm: float, limits: Limits) -> float:
    """Return how far a turned hand may go down; the soft limit alone holds an unturned one."""
    if rotation_angle_rad(pose) <= LEVEL_RAD:
        return math.inf
    return max(pose.z_mm - surface_mm - limits.turn_clear_mm, 0.0)

"""Whether a jog may go a way from here, how fast, and how far: asked before and during it.

Every limit says its reason when it refuses. Speeds and ways are in mm along axes, in rad for what
turns.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import astuple, dataclass

from backend.core.faults import RefusedError, StaleSampleError
from backend.core.flow import Pose
from backend.core.turning import turn_of
from backend.devices.guarded import GuardedArm
from backend.devices.interlock import Interlock
from backend.devices.jog_axes import (
    JOINTS,
    Axis,
    Frame,
    Room,
    amount,
    axes_of,
    joint_speeds,
    signed_name,
    turns,
    way_of,
)
from backend.devices.jog_limits import Way, fastest_mm_s, refuse_forced, room_mm
from backend.devices.turn_limits import falls_mm, refuse_place, refuse_turning, room_rad

REPEAT_S = 0.14
"""The arm is told to move this long at a time, as a controller's own jog time-out does."""
CREEP_MM_S, CREEP_RAD_S = 0.2, math.radians(0.2)
"""Slower than this at a limit is standing still."""
FINE_RAD = math.radians(0.5)
"""The way of a joint to the edge of the workspace is looked for this finely."""
POSE_AGE_S = 0.2


@dataclass(frozen=True, slots=True)
class Around:
    """What a jog must know of the bench; NaN is unknown.

    ``press_n``: press force. ``surface_mm``: height of ``G`` at which a held piece touches the
    support. ``busy``: whether a run has the bench. ``wall_s``: a lease also ends by this clock, as
    a simulated bench may fall behind real time.
    """

    now_s: Callable[[], float]
    wall_s: Callable[[], float]
    press_n: Callable[[], float]
    surface_mm: Callable[[], float]
    busy: Callable[[], bool]


class Permit:
    """Asks the arm where it is and the interlock what it allows; moves nothing."""

    def __init__(self, arm: GuardedArm, interlock: Interlock, around: Around) -> None:
        self._arm, self._interlock, self._around = arm, interlock, around
        self._joint_rooms: tuple[tuple[float, ...], dict[tuple[Axis, int], float]] = ((), {})

    def here(self) -> Pose:
        """Return the pose of the hand; raises ``RefusedError`` if nobody knows it."""
        try:
            return self._arm.pose(max_age_s=POSE_AGE_S)
        except StaleSampleError as error:
            raise RefusedError("NO-POSE", "The position of the arm is not known.") from error

    def way(self, axis: Axis, frame: Frame, signed: float) -> Way:
        """Return the unit vector of a way from here, in the bench frame."""
        return way_of(axis, frame, signed, turn_of(self.here()))

    def refuse(self, axis: Axis, frame: Frame, signed: float) -> None:
        """Raise ``RefusedError`` if force, recovery or height forbid this way."""
        press_n, interlock = self._around.press_n(), self._interlock
        if not turns(axis):
            way = self.way(axis, frame, signed)
            refuse_forced(
                press_n,
                way,
                interlock.limits,
                recovering=interlock.recovering,
                degraded=interlock.degraded,
            )
            return
        if not self._arm.rotates:
            raise RefusedError("NO-TURN", "This arm keeps its hand straight down.")
        if interlock.recovering:
            raise RefusedError("RECOVERY", "After a fault: jog away from contact first.")
        if interlock.degraded:
            raise RefusedError("DEGRADED", f"{interlock.degraded} Turn once it is well.")
        refuse_turning(self.here(), self._around.surface_mm(), press_n, interlock.limits)

    def left(self, axis: Axis, frame: Frame, signed: float) -> float:
        """Return how far this way goes until a limit ends it, whatever the force."""
        limits, here = self._interlock.limits, self.here()
        if axis in JOINTS:
            return self._joint_left(axis, 1 if signed > 0 else -1)
        way = self.way(axis, frame, signed)
        if turns(axis):
            return room_rad(here, way, limits)
        room = room_mm(here, way, limits)
        if way[2] < 0.0:
            room = min(room, falls_mm(here, self._around.surface_mm(), limits) / -way[2])
        return room

    def rooms(self, frame: Frame) -> dict[str, Room]:
        """Return what is left each way of a frame, by names such as "+x" and "-j4"."""
        found = {}
        for axis in axes_of(frame):
            if turns(axis) and not self._arm.rotates:
                continue
            for sign, signed in (("+", 1.0), ("-", -1.0)):
                try:
                    self.refuse(axis, frame, signed)
                    room = Room(self.left(axis, frame, signed))
                except RefusedError as error:
                    room = Room(0.0, error.reason)
                found[sign + axis] = room
        return found

    def speed(self, axis: Axis, frame: Frame, signed: float) -> tuple[float, str]:
        """Return how fast a held jog may go now, and why slower than asked ("" if it is not)."""
        self.refuse(axis, frame, signed)
        if not turns(axis):
            return self._line_speed(axis, frame, signed)
        interlock, asked = self._interlock, abs(signed)
        if not 0.0 < asked <= interlock.limits.turn_rad_s * (1 + 1e-9):
            raise RefusedError("SPEED", f"{math.degrees(asked):.1f}\N{DEGREE SIGN}/s is too fast.")
        speed = asked * interlock.override
        slow = "" if speed == asked else f"override {100 * interlock.override:.0f} %"
        if axis in JOINTS:
            most = self.joint_most(axis, speed if signed > 0 else -speed)
            speed, slow = (speed, slow) if most == speed else (most, "the hand at its top speed")
        left = self.left(axis, frame, signed)
        if left / REPEAT_S < speed:
            speed, slow = left / REPEAT_S, f"{amount(axis, left)} to the limit"
        if not speed >= min(asked * interlock.override, CREEP_RAD_S):
            raise RefusedError("LIMIT", left_words(axis, frame, signed, left))
        return speed, slow

    def joint_most(self, axis: Axis, signed: float) -> float:
        """Return ``signed``, rad/s, unsigned, or less where the hand would go too fast."""
        now = self._arm.joints_rad(max_age_s=POSE_AGE_S)
        ahead = self._arm.place_of(_added(now, joint_speeds(axis, signed * REPEAT_S)))
        mm_s = math.dist(astuple(self._arm.place_of(now))[:3], astuple(ahead)[:3]) / REPEAT_S
        # A hair below it, as the way of the hand is an arc.
        most = 0.99 * self._interlock.limits.jog_mm_s
        return abs(signed) if mm_s <= most else abs(signed) * most / mm_s

    def line_zone(self) -> tuple[float, str]:
        """Return the highest speed along an axis here, mm/s, and why it is lower than usual."""
        interlock, around = self._interlock, self._around
        return fastest_mm_s(
            self.here(),
            around.surface_mm(),
            around.press_n(),
            interlock.limits,
            recovering=interlock.recovering,
        )

    # -- inside -----------------------------------------------------------------------------------

    def _line_speed(self, axis: Axis, frame: Frame, signed: float) -> tuple[float, str]:
        interlock, asked = self._interlock, abs(signed)
        if not 0.0 < asked <= interlock.limits.jog_mm_s:
            raise RefusedError("SPEED", f"{asked:.1f} mm/s is no jog speed.")
        zone, why = self.line_zone()
        speed, override = min(asked * interlock.override, zone), interlock.override
        slow = "" if speed == asked else why or f"override {100 * override:.0f} %"
        left_mm = self.left(axis, frame, signed)
        if left_mm / REPEAT_S < speed:
            speed, slow = left_mm / REPEAT_S, f"{left_mm:.1f} mm to the limit"
        if not speed >= min(asked * override, CREEP_MM_S):
            raise RefusedError("LIMIT", left_words(axis, frame, signed, left_mm))
        return speed, slow

    def _joint_left(self, axis: Axis, sign: int) -> float:
        now = self._arm.joints_rad(max_age_s=POSE_AGE_S)
        key = tuple(round(angle, 4) for angle in now)
        if self._joint_rooms[0] != key:
            self._joint_rooms = (key, {})
        rooms = self._joint_rooms[1]
        if (axis, sign) not in rooms:
            rooms[axis, sign] = self._search(now, axis, sign)
        return rooms[axis, sign]

    def _search(self, now: tuple[float, ...], axis: Axis, sign: int) -> float:
        """Return how far one joint may turn until its own range or the workspace ends."""
        low, high = self._arm.joint_limits_rad[JOINTS.index(axis)]
        at = now[JOINTS.index(axis)]
        end = max(high - at if sign > 0 else at - low, 0.0)
        good, bad, step = 0.0, math.inf, FINE_RAD
        while good < end and bad - good > FINE_RAD:
            tried = min(good + step, end) if math.isinf(bad) else 0.5 * (good + bad)
            if self._inside(_added(now, joint_speeds(axis, sign * tried))):
                good, step = tried, 2.0 * step
            else:
                bad = tried
        return good

    def _inside(self, joints_rad: tuple[float, ...]) -> bool:
        try:
            there = self._arm.place_of(joints_rad)
            refuse_place(there, self._around.surface_mm(), self._interlock.limits)
        except RefusedError:
            return False
        return True


def left_words(axis: Axis, frame: Frame, signed: float, left: float) -> str:
    """Return the refusal of a way that is longer than what is left."""
    name = signed_name(axis, signed)
    return f"{name} ({frame}): {amount(axis, left)} left to the soft limit."


def _added(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip(first, second, strict=True))

"""Jogging of the arm while a button is held.

The pressed button renews a lease. A renewal is accepted if its number is greater than the last and
it is younger than the lease. There is no queue: a newer renewal replaces the older. ``tick`` runs
on the bench clock and commands motion for ``REPEAT_S`` at a time, so that braking ends before the
lease expires. Every refusal has a reason. Speeds are in mm/s along axes, rad/s for turns.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import astuple, dataclass, replace
from typing import Literal

import numpy as np

from touchdown.backend.core import (
    IDENTITY_ROTATION,
    FaultError,
    FloatArray,
    Pose,
    RefusedError,
    StaleSampleError,
    pose_rotation,
    rotation_from_vector,
    rotation_vector,
)
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import (
    LEASE_S,
    Direction,
    Interlock,
    distance_to_limit_mm,
    fastest_mm_s,
    refuse_forced,
    refuse_place,
    refuse_turning,
    turn_to_limit_rad,
    turned_descent_mm,
)
from touchdown.backend.devices.protocols import STILL, Motion, RobotMode
from touchdown.backend.devices.streamed import ACCELERATION_MM_S2, ACCELERATION_RAD_S2

Axis = Literal["x", "y", "z", "rx", "ry", "rz", "j1", "j2", "j3", "j4", "j5", "j6"]
Frame = Literal["XYZ", "TOOL", "JOINT"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
TURNS: tuple[Axis, ...] = ("rx", "ry", "rz")
JOINTS: tuple[Axis, ...] = ("j1", "j2", "j3", "j4", "j5", "j6")
FRAMES: tuple[Frame, ...] = ("XYZ", "TOOL", "JOINT")
# Tool axes in the bench frame while the hand points down; z is the direction of approach.
TOOL_SIGNS: Direction = (1.0, -1.0, -1.0)


@dataclass(frozen=True, slots=True)
class JogRange:
    """Range of a jog, mm or rad; ``why`` is the reason of an empty range."""

    left: float
    why: str = ""


def axes_of(frame: Frame) -> tuple[Axis, ...]:
    """Return the axes of a frame."""
    return JOINTS if frame == "JOINT" else (*AXES, *TURNS)


def turns(axis: Axis) -> bool:
    """Return True if speeds and distances of this axis are angles."""
    return axis not in AXES


def direction_of(
    axis: Axis, frame: Frame, signed: float, turn: FloatArray = IDENTITY_ROTATION
) -> Direction:
    """Return the unit vector in the bench frame for a signed value along or about an axis.

    ``turn`` (3, 3) of the hand: the axes of TOOL turn with it.
    """
    at = (AXES if axis in AXES else TURNS).index(axis)
    sign = 1.0 if signed > 0 else -1.0
    if frame == "TOOL":
        sign *= TOOL_SIGNS[at]
    unit = np.zeros(3)
    unit[at] = sign
    x, y, z = (turn @ unit if frame == "TOOL" and turn is not IDENTITY_ROTATION else unit).tolist()
    return x, y, z


def joint_speeds(axis: Axis, speed_rad_s: float) -> tuple[float, ...]:
    """Return the speeds of all six joints while one of them is driven."""
    return tuple(speed_rad_s if axis == joint else 0.0 for joint in JOINTS)


def signed_name(axis: Axis, signed: float) -> str:
    """Return the name of a direction such as "+X" or "-J4", with a minus sign."""
    return f"{'+' if signed > 0 else chr(0x2212)}{axis.upper()}"


def distance_text(axis: Axis, value: float) -> str:
    """Return a distance as text: mm along an axis, degrees of a turn."""
    return f"{math.degrees(value):.1f}\N{DEGREE SIGN}" if turns(axis) else f"{value:.1f} mm"


# Motion is commanded for this time, like the jog time-out of a controller.
REPEAT_S = 0.14
CREEP_MM_S, CREEP_RAD_S = 0.2, math.radians(0.2)  # slower at a limit counts as standing
# Resolution of the search for the edge of the workspace.
FINE_RAD = math.radians(0.5)
POSE_AGE_S = 0.2


@dataclass(frozen=True, slots=True)
class JogSurroundings:
    """State of the bench for a jog; NaN is unknown. ``press_n``: press force. ``surface_mm``:
    height of ``G`` at which a held piece touches the support. ``busy``: True while a run uses the
    bench. ``wall_s``: a lease also ends by this clock, because a simulated bench may be slower than
    real time.
    """

    now_s: Callable[[], float]
    wall_s: Callable[[], float]
    press_n: Callable[[], float]
    surface_mm: Callable[[], float]
    busy: Callable[[], bool]


class JogPermission:
    """Checks of a jog against the pose of the arm and the interlock; moves nothing."""

    def __init__(self, arm: GuardedArm, interlock: Interlock, around: JogSurroundings) -> None:
        self._arm, self._interlock, self._around = arm, interlock, around
        self._joint_rooms: tuple[tuple[float, ...], dict[tuple[Axis, int], float]] = ((), {})

    def here(self) -> Pose:
        """Return the pose of the hand; raises ``RefusedError`` if it is unknown."""
        try:
            return self._arm.pose(max_age_s=POSE_AGE_S)
        except StaleSampleError as error:
            raise RefusedError("NO-POSE", "The position of the arm is not known.") from error

    def way(self, axis: Axis, frame: Frame, signed: float) -> Direction:
        """Return the unit vector of a direction, in the bench frame."""
        return direction_of(axis, frame, signed, pose_rotation(self.here()))

    def refuse(self, axis: Axis, frame: Frame, signed: float, press_n: float | None = None) -> None:
        """Raise ``RefusedError`` if force, recovery or height forbid this direction."""
        press_n = self._around.press_n() if press_n is None else press_n
        interlock = self._interlock
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
        """Return the range in this direction up to a limit, regardless of the force."""
        limits, here = self._interlock.limits, self.here()
        if axis in JOINTS:
            return self._joint_left(axis, 1 if signed > 0 else -1)
        way = self.way(axis, frame, signed)
        if turns(axis):
            return turn_to_limit_rad(here, way, limits)
        room = distance_to_limit_mm(here, way, limits)
        if way[2] < 0.0:
            room = min(room, turned_descent_mm(here, self._around.surface_mm(), limits) / -way[2])
        return room

    def rooms(self, frame: Frame) -> dict[str, JogRange]:
        """Return the range in each direction of a frame, by names such as "+x" and "-j4"."""
        press_n, found = self._around.press_n(), {}
        for axis in axes_of(frame):
            if turns(axis) and not self._arm.rotates:
                continue
            for sign, signed in (("+", 1.0), ("-", -1.0)):
                try:
                    self.refuse(axis, frame, signed, press_n)
                    room = JogRange(self.left(axis, frame, signed))
                except RefusedError as error:
                    room = JogRange(0.0, error.reason)
                found[sign + axis] = room
        return found

    def speed(self, axis: Axis, frame: Frame, signed: float) -> tuple[float, str]:
        """Return the permitted speed of a held jog, and the reason if it is reduced, else ""."""
        self.refuse(axis, frame, signed)
        limits, override, asked = self._interlock.limits, self._interlock.override, abs(signed)
        top, creep = limits.jog_mm_s, CREEP_MM_S
        if turns(axis):
            top, creep = limits.turn_rad_s * (1 + 1e-9), CREEP_RAD_S
        if not 0.0 < asked <= top:
            raise RefusedError("SPEED", f"{distance_text(axis, asked)}/s is not a jog speed.")
        wanted = speed = asked * override
        slow = "" if speed == asked else f"override {100 * override:.0f} %"
        if axis in AXES:
            zone, why = self.line_zone()
            speed = min(wanted, zone)
            slow = "" if speed == asked else why or slow
        elif axis in JOINTS:
            speed = self.joint_most(axis, wanted if signed > 0 else -wanted)
            slow = slow if speed == wanted else "the hand at its top speed"
        left = self.left(axis, frame, signed)
        if left / REPEAT_S < speed:
            speed, slow = left / REPEAT_S, f"{distance_text(axis, left)} to the limit"
        if not speed >= min(wanted, creep):
            raise RefusedError("LIMIT", range_text(axis, frame, signed, left))
        return speed, slow

    def joint_most(self, axis: Axis, signed: float) -> float:
        """Return the magnitude of ``signed``, rad/s, reduced if the hand would move too fast."""
        now = self._arm.joints_rad(max_age_s=POSE_AGE_S)
        ahead = self._arm.place_of(_added(now, joint_speeds(axis, signed * REPEAT_S)))
        mm_s = math.dist(astuple(self._arm.place_of(now))[:3], astuple(ahead)[:3]) / REPEAT_S
        # Slightly below, because the hand moves on an arc.
        most = 0.99 * self._interlock.limits.jog_mm_s
        return abs(signed) if mm_s <= most else abs(signed) * most / mm_s

    def line_zone(self) -> tuple[float, str]:
        """Return the highest speed along an axis here, mm/s, and the reason if it is reduced."""
        interlock, around = self._interlock, self._around
        return fastest_mm_s(
            self.here(),
            around.surface_mm(),
            around.press_n(),
            interlock.limits,
            recovering=interlock.recovering,
        )

    # -- inside -----------------------------------------------------------------------------------

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
        """Return the range of one joint up to its own limit or the edge of the workspace."""
        low, high = self._arm.joint_limits_rad[JOINTS.index(axis)]
        at = now[JOINTS.index(axis)]
        end = max(high - at if sign > 0 else at - low, 0.0)
        good, bad, step = 0.0, math.inf, FINE_RAD
        while good < end and bad - good > FINE_RAD:
            tried = min(good + step, end) if math.isinf(bad) else 0.5 * (good + bad)
            there = self._arm.place_of(_added(now, joint_speeds(axis, sign * tried)))
            try:
                refuse_place(there, self._around.surface_mm(), self._interlock.limits)
            except RefusedError:
                bad = tried
            else:
                good, step = tried, 2.0 * step
        return good


def range_text(axis: Axis, frame: Frame, signed: float, left: float) -> str:
    """Return the refusal text of a step that exceeds the range."""
    name = signed_name(axis, signed)
    return f"{name} ({frame}): {distance_text(axis, left)} left to the soft limit."


def _added(first: tuple[float, ...], second: tuple[float, ...]) -> tuple[float, ...]:
    return tuple(a + b for a, b in zip(first, second, strict=True))


STEPS_MM = (0.1, 0.5, 1.0, 5.0)
STEPS_DEG = (0.5, 1.0, 5.0)
# Time from a command to standstill: delays of the wires and lag of the servos.
SETTLE_S = 0.05
LATE_S = 0.1  # a longer gap between ticks is caused by a busy computer


@dataclass(frozen=True, slots=True)
class JogOrder:
    """One renewal. ``hold`` is the number of the button press; ``sequence`` increases within it.
    ``sent_s`` is on the bench clock; ``speed`` is signed along or about ``axis`` of ``frame``, mm/s
    for x, y, z, else rad/s.
    """

    hold: int
    sequence: int
    sent_s: float
    axis: Axis
    frame: Frame
    speed: float


@dataclass(frozen=True, slots=True)
class JogState:
    """State of the jog: ``speed`` after limits, ``slow`` the reason for a reduced speed."""

    order: JogOrder | None = None
    speed: float = 0.0
    slow: str = ""


class Jog:
    """Jog with one lease at a time. ``tell`` gets the reason when the motion ends by itself."""

    def __init__(
        self,
        arm: GuardedArm,
        interlock: Interlock,
        around: JogSurroundings,
        tell: Callable[[RefusedError], None],
    ) -> None:
        self._arm, self._interlock, self._around, self._tell = arm, interlock, around, tell
        self._lock = threading.Lock()
        self._order: JogOrder | None = None
        self._taken_s = self._ticked_s = self._late_s = 0.0
        self._ended = 0
        self._step: tuple[Motion, Axis, Frame, float] | None = None
        self._held: Motion | None = None
        self._permit = JogPermission(arm, interlock, around)
        self.state: JogState = JogState()
        interlock.on_stop(self._stopped)

    @property
    def active(self) -> bool:
        """True while the arm is jogged."""
        return self._order is not None or self._step is not None

    def rooms(self, frame: Frame) -> dict[str, JogRange]:
        """Return the range in each direction of a frame, by names such as "+x" and "-j4"."""
        return self._permit.rooms(frame)

    # -- from any thread --------------------------------------------------------------------------

    def renew(self, order: JogOrder) -> None:
        """Process a renewal; raises ``RefusedError`` and ends the hold if it is refused."""
        age_s = self._around.now_s() - order.sent_s
        with self._lock:
            last = self._order
            if order.hold <= self._ended:
                raise RefusedError("JOG-ENDED", "This jog has ended: press again.")
            if last is not None and order.hold != last.hold:
                raise RefusedError("JOG-BUSY", "Another jog is being held.")
            if last is not None and order.sequence <= last.sequence:
                raise RefusedError("JOG-REPLAYED", "A jog renewal came twice or too late.")
            if not 0.0 <= age_s <= LEASE_S:
                raise RefusedError("JOG-STALE", f"A jog renewal is {1e3 * age_s:.0f} ms old.")
        try:
            self._refuse_if_taken()
            self._permit.speed(order.axis, order.frame, order.speed)
        except RefusedError:
            self.end(order.hold)
            raise
        with self._lock:
            if order.hold > self._ended:
                wall_s = self._around.wall_s()
                self._order, self._taken_s = order, wall_s
                self._ticked_s, self._late_s = wall_s, 0.0

    def end(self, hold: int) -> None:
        """End a hold and stand still; may be called repeatedly."""
        with self._lock:
            mine = self._order is not None and self._order.hold == hold
            self._ended = max(self._ended, hold)
            if mine:
                self._order = self._held = None
        if mine:
            self._halt()

    def step(self, axis: Axis, frame: Frame, distance: float, speed: float) -> None:
        """Move once by a signed distance; raises ``RefusedError`` with the available range. Units:
        mm and mm/s along an axis, rad and rad/s for turns.
        """
        self._refuse_taken_or_moving()
        permit = self._permit
        permit.refuse(axis, frame, distance)
        left = permit.left(axis, frame, distance)
        if abs(distance) > left:
            raise RefusedError("LIMIT", range_text(axis, frame, distance, left))
        self._interlock.renew_lease(self._around.now_s())
        self._step = (self._stepped(axis, frame, distance, abs(speed)), axis, frame, distance)

    def level(self, speed_rad_s: float) -> None:
        """Turn the hand back to straight down, in place; raises ``RefusedError``."""
        self._refuse_taken_or_moving()
        here = self._permit.here()
        self._permit.refuse("rz", "XYZ", 1.0)
        self._interlock.renew_lease(self._around.now_s())
        target = Pose(here.x_mm, here.y_mm, here.z_mm)
        motion = self._arm.move_to(target, self._interlock.limits.speed_mm_s, speed_rad_s)
        self._step = (motion, "rz", "XYZ", 1.0)

    # -- on the bench clock -----------------------------------------------------------------------

    def tick(self) -> None:
        """Renew, slow down or end the motion; call once per advance of the bench."""
        if self._step is not None:
            self._watch_step(*self._step)
        with self._lock:
            order, wall_s = self._order, self._around.wall_s()
            silent_s = wall_s - self._taken_s
            self._late_s, self._ticked_s = max(self._late_s, wall_s - self._ticked_s), wall_s
        if order is None:
            return
        try:
            silent_s = max(silent_s, self._around.now_s() - order.sent_s)
            if silent_s > LEASE_S:
                raise RefusedError("JOG-LEASE", _silence_reason(silent_s, self._late_s))
            self._refuse_if_taken()
            motion, self._held = self._held, None
            if motion is not None and motion.done and (failure := _failure(motion)):
                raise failure  # the arm ended the motion by itself
            speed, slow = self._permit.speed(order.axis, order.frame, order.speed)
            self._interlock.renew_lease(self._around.now_s())
            braking = ACCELERATION_RAD_S2 if turns(order.axis) else ACCELERATION_MM_S2
            for_s = min(REPEAT_S, LEASE_S - silent_s - speed / braking - SETTLE_S)
            if for_s > 0.0:
                self._held = self._driven(order, speed, for_s)
            self.state = JogState(order, speed, slow)
        except (RefusedError, FaultError) as error:
            self.end(order.hold)
            if isinstance(error, FaultError):
                self._interlock.raise_fault(error.fault)
            else:
                self._tell(error)

    # -- inside -----------------------------------------------------------------------------------

    def _stopped(self) -> None:
        """Handle a STOP: the arm halts by itself; the button must be pressed again."""
        with self._lock:
            if self._order is not None:
                self._ended = max(self._ended, self._order.hold)
            self._order = self._step = self._held = None
        self.state = JogState()

    def _driven(self, order: JogOrder, speed: float, for_s: float) -> Motion:
        signed = speed if order.speed > 0 else -speed
        if order.axis in JOINTS:
            return self._arm.jog_joints(joint_speeds(order.axis, signed), for_s)
        x, y, z = (part * speed for part in self._permit.way(order.axis, order.frame, order.speed))
        if turns(order.axis):
            return self._arm.jog(STILL, for_s, (x, y, z))
        return self._arm.jog((x, y, z), for_s)

    def _stepped(self, axis: Axis, frame: Frame, signed: float, speed: float) -> Motion:
        arm, here, size = self._arm, self._permit.here(), abs(signed)
        if axis in JOINTS:
            speed = self._permit.joint_most(axis, speed if signed > 0 else -speed)
            now = arm.joints_rad(max_age_s=POSE_AGE_S)
            way = joint_speeds(axis, signed)
            return arm.move_joints(_added(now, way), speed)
        x, y, z = (part * size for part in self._permit.way(axis, frame, signed))
        if turns(axis):
            turn = rotation_from_vector(np.array([x, y, z])) @ pose_rotation(here)
            rx, ry, rz = rotation_vector(turn).tolist()
            target = replace(here, rx_rad=rx, ry_rad=ry, rz_rad=rz)
            return arm.move_to(target, self._interlock.limits.speed_mm_s, speed)
        target = replace(here, x_mm=here.x_mm + x, y_mm=here.y_mm + y, z_mm=here.z_mm + z)
        # The arm applies the override itself; the limit near the surface is independent of it.
        most = self._permit.line_zone()[0] / self._interlock.override
        return arm.move_to(target, min(speed, most))

    def _watch_step(self, motion: Motion, axis: Axis, frame: Frame, signed: float) -> None:
        """Renew the lease during a step, while the limits permit it."""
        if motion.done:
            self._step = None
            if failure := _failure(motion):
                self._tell(failure)
            return
        try:
            self._permit.refuse(axis, frame, signed)
            self._interlock.renew_lease(self._around.now_s())
        except RefusedError as error:
            self._halt()
            self._step = None
            self._tell(error)

    def _refuse_taken_or_moving(self) -> None:
        self._refuse_if_taken()
        if self.active:
            raise RefusedError("JOG-BUSY", "The last step is still under way.")

    def _refuse_if_taken(self) -> None:
        if self._around.busy():
            raise RefusedError("BUSY", "A run is going on: cancel it first.")
        if self._interlock.latched:
            raise RefusedError("LATCHED", "The bench is stopped: press Reset first.")
        if self._arm.status().robot_mode is RobotMode.SERVO_OFF:
            raise RefusedError("SERVO-OFF", "The servo of the arm is off: switch it on first.")

    def _halt(self) -> None:
        # A run uses the bench and moves the arm: do not halt it here.
        if not self._around.busy():
            self._arm.halt()
            self._interlock.drop_lease()
        self.state = JogState()


def _silence_reason(silent_s: float, late_s: float) -> str:
    """Return the reason of an expired lease: the window hangs, or the whole computer is busy."""
    said = f"The jog ended: nothing renewed it for {1e3 * silent_s:.0f} ms."
    if late_s > LATE_S:
        return (
            f"{said} The bench came late as well, by {1e3 * late_s:.0f} ms: this computer is "
            "overloaded. Close what else runs, then hold again."
        )
    return f"{said} The window hung; hold again."


def _failure(motion: Motion) -> RefusedError | None:
    """Return the reason of a motion that failed, None after success or a command to end."""
    try:
        motion.result()
    except FaultError as error:
        fault = error.fault
        if fault.code not in ("STOPPED", "REPLACED"):
            return RefusedError(fault.code, f"{fault.what} {fault.next_step}")
    return None

"""Jogging as a lease: whoever holds the button renews it, and silence ends the motion.

A renewal is taken only if its number is greater than the last and it is younger than the lease.
There is no queue: a newer renewal replaces the older. ``tick`` runs on the bench's own time and
tells the arm to move for ``REPEAT_S`` at a time, and never for so long that it would still brake
when the lease is over: it stands by then, whatever became of the window or of ``tick``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from backend.core.faults import Fault, FaultError, RefusedError
from backend.core.flow import Pose
from backend.core.turning import turn_about, turn_of, vector_of
from backend.devices.guarded import GuardedArm
from backend.devices.interlock import LEASE_S, Interlock
from backend.devices.jog_axes import (
    JOINTS,
    Axis,
    Frame,
    Room,
    joint_speeds,
    turns,
)
from backend.devices.jog_permit import POSE_AGE_S, REPEAT_S, Around, Permit, left_words
from backend.devices.protocols import STILL, Motion, RobotMode
from backend.devices.streamed.programs import ACCELERATION_MM_S2
from backend.devices.streamed.turning import ACCELERATION_RAD_S2

__all__ = ["STEPS_DEG", "STEPS_MM", "Around", "Jog", "JogOrder", "JogState"]

STEPS_MM = (0.1, 0.5, 1.0, 5.0)
STEPS_DEG = (0.5, 1.0, 5.0)
SETTLE_S = 0.05
"""From a command to the arm that stands: wires that are late, and the lag of its servos."""
LATE_S = 0.1
"""A bench that is not served for so long has no computer to itself."""


@dataclass(frozen=True, slots=True)
class JogOrder:
    """One renewal. ``hold``: number of the press; ``sequence`` counts up within it.

    ``sent_s``: bench clock; ``speed`` is signed along or about ``axis`` of ``frame``: mm/s for
    x, y, z and rad/s for everything that turns.
    """

    hold: int
    sequence: int
    sent_s: float
    axis: Axis
    frame: Frame
    speed: float


@dataclass(frozen=True, slots=True)
class JogState:
    """What the jog does now. ``speed`` after limits; ``slow``: why it is lower than asked."""

    order: JogOrder | None = None
    speed: float = 0.0
    slow: str = ""


class Jog:
    """One lease at a time. ``tell`` is called when the motion ended by itself, with the reason."""

    def __init__(
        self,
        arm: GuardedArm,
        interlock: Interlock,
        around: Around,
        tell: Callable[[RefusedError], None],
    ) -> None:
        self._arm, self._interlock, self._around, self._tell = arm, interlock, around, tell
        self._lock = threading.Lock()
        self._order: JogOrder | None = None
        self._taken_s = self._ticked_s = self._late_s = 0.0
        self._ended = 0
        self._step: tuple[Motion, _Going] | None = None
        self._held: Motion | None = None
        self._permit = Permit(arm, interlock, around)
        self.state = JogState()
        interlock.on_stop(self._stopped)

    @property
    def active(self) -> bool:
        """Whether the arm moves by hand."""
        return self._order is not None or self._step is not None

    def rooms(self, frame: Frame) -> dict[str, Room]:
        """Return how far each way of a frame goes from here, by names such as "+x" and "-j4"."""
        return self._permit.rooms(frame)

    # -- from any thread --------------------------------------------------------------------------

    def renew(self, order: JogOrder) -> None:
        """Take a renewal; raises ``RefusedError`` and ends the hold if it cannot go on."""
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
        """End a hold, from any cause and any number of times: the arm stands still."""
        with self._lock:
            mine = self._order is not None and self._order.hold == hold
            self._ended = max(self._ended, hold)
            if mine:
                self._order = self._held = None
        if mine:
            self._halt()

    def step(self, axis: Axis, frame: Frame, distance: float, speed: float) -> None:
        """Move once by a signed distance; raises ``RefusedError`` with the way that is left.

        mm and mm/s along an axis, rad and rad/s for what turns.
        """
        self._refuse_taken_or_moving()
        permit = self._permit
        permit.refuse(axis, frame, distance)
        left = permit.left(axis, frame, distance)
        if abs(distance) > left:
            raise RefusedError("LIMIT", left_words(axis, frame, distance, left))
        self._interlock.renew_lease(self._around.now_s())
        going = _Going(axis, frame, distance)
        self._step = (self._stepped(going, abs(speed)), going)

    def level(self, speed_rad_s: float) -> None:
        """Turn the hand back to straight down, where it stands; raises ``RefusedError``."""
        self._refuse_taken_or_moving()
        here, going = self._permit.here(), _Going("rz", "XYZ", 1.0)
        self._permit.refuse(going.axis, going.frame, going.signed)
        self._interlock.renew_lease(self._around.now_s())
        target = Pose(here.x_mm, here.y_mm, here.z_mm)
        motion = self._arm.move_to(target, self._interlock.limits.speed_mm_s, speed_rad_s)
        self._step = (motion, going)

    # -- on the bench's own time ------------------------------------------------------------------

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
                raise RefusedError("JOG-LEASE", _silence_words(silent_s, self._late_s))
            self._refuse_if_taken()
            self._refuse_failed()
            speed, slow = self._permit.speed(order.axis, order.frame, order.speed)
            self._interlock.renew_lease(self._around.now_s())
            for_s = min(REPEAT_S, LEASE_S - silent_s - _braking_s(order.axis, speed))
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
        """STOP halts the arm itself; what was held needs a new press."""
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

    def _stepped(self, going: _Going, speed: float) -> Motion:
        arm, here, size = self._arm, self._permit.here(), abs(going.signed)
        if going.axis in JOINTS:
            speed = self._permit.joint_most(going.axis, speed if going.signed > 0 else -speed)
            now = arm.joints_rad(max_age_s=POSE_AGE_S)
            way = joint_speeds(going.axis, going.signed)
            return arm.move_joints(tuple(a + b for a, b in zip(now, way, strict=True)), speed)
        x, y, z = (part * size for part in self._permit.way(going.axis, going.frame, going.signed))
        if turns(going.axis):
            turn = turn_about(np.array([x, y, z])) @ turn_of(here)
            rx, ry, rz = vector_of(turn).tolist()
            target = replace(here, rx_rad=rx, ry_rad=ry, rz_rad=rz)
            return arm.move_to(target, self._interlock.limits.speed_mm_s, speed)
        target = replace(here, x_mm=here.x_mm + x, y_mm=here.y_mm + y, z_mm=here.z_mm + z)
        # The arm applies the override itself; the zone near the surface holds whatever it is.
        most = self._permit.line_zone()[0] / self._interlock.override
        return arm.move_to(target, min(speed, most))

    def _watch_step(self, motion: Motion, going: _Going) -> None:
        """Keep the permission to move as long as a step lasts, and the limits let it go on."""
        if motion.done:
            self._step = None
            self._tell_failure(motion)
            return
        try:
            self._permit.refuse(going.axis, going.frame, going.signed)
            self._interlock.renew_lease(self._around.now_s())
        except RefusedError as error:
            self._halt()
            self._step = None
            self._tell(error)

    def _refuse_failed(self) -> None:
        """Raise the reason for which the arm ended the held motion by itself."""
        motion, self._held = self._held, None
        if motion is not None and motion.done:
            fault = _failure(motion)
            if fault is not None:
                raise RefusedError(fault.code, f"{fault.what} {fault.next_step}")

    def _tell_failure(self, motion: Motion) -> None:
        fault = _failure(motion)
        if fault is not None:
            self._tell(RefusedError(fault.code, f"{fault.what} {fault.next_step}"))

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
        # A run that has the bench moves the arm itself: it is not to be halted from here.
        if not self._around.busy():
            self._arm.halt()
            self._interlock.drop_lease()
        self.state = JogState()


@dataclass(frozen=True, slots=True)
class _Going:
    """Which way a step goes, and how far: mm, or rad for what turns."""

    axis: Axis
    frame: Frame
    signed: float


def _braking_s(axis: Axis, speed: float) -> float:
    """Return how long an arm whose order has ended still moves."""
    acceleration = ACCELERATION_RAD_S2 if turns(axis) else ACCELERATION_MM_S2
    return speed / acceleration + SETTLE_S


def _silence_words(silent_s: float, late_s: float) -> str:
    """Say why a lease ran out: a window alone that is silent hangs, else the whole computer."""
    said = f"The jog ended: nothing renewed it for {1e3 * silent_s:.0f} ms."
    if late_s > LATE_S:
        return (
            f"{said} The bench came late as well, by {1e3 * late_s:.0f} ms: this computer is "
            "overloaded. Close what else runs, then hold again."
        )
    return f"{said} The window hung; hold again."


def _failure(motion: Motion) -> Fault | None:
    """Return why the arm ended a motion by itself; None if it ended well, or was told to end."""
    try:
        motion.result()
    except FaultError as error:
        return None if error.fault.code in ("STOPPED", "REPLACED") else error.fault
    return None

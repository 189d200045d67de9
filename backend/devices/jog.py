"""Jogging as a lease: whoever holds the button renews it, and silence ends the motion.

A renewal is taken only if its number is greater than the last and it is younger than the lease.
There is no queue: a newer renewal replaces the older. ``tick`` runs on the bench's own time and
ends the motion when the lease is over, whatever became of the window; behind it the arm stops by
itself after ``REPEAT_S``.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from backend.core.faults import FaultError, RefusedError, StaleSampleError
from backend.core.flow import Pose
from backend.devices.guarded import GuardedArm
from backend.devices.interlock import LEASE_S, Interlock
from backend.devices.jog_limits import Way, fastest_mm_s, refuse_forced, room_mm
from backend.devices.protocols import Motion

Axis = Literal["x", "y", "z"]
Frame = Literal["XYZ", "TOOL"]
AXES: tuple[Axis, ...] = ("x", "y", "z")
STEPS_MM = (0.1, 0.5, 1.0, 5.0)
REPEAT_S = 0.14
"""The arm is told to move this long at a time, as a controller's own jog time-out does."""
CREEP_MM_S = 0.2
"""Slower than this at a limit is standing still."""
TOOL_SIGNS: Way = (1.0, -1.0, -1.0)
"""The tool's axes in the bench frame while the hand points down: z is the direction of approach."""


@dataclass(frozen=True, slots=True)
class JogOrder:
    """One renewal. ``hold``: number of the press; ``sequence`` counts up within it.

    ``sent_s``: bench clock; ``speed_mm_s`` is signed along ``axis`` of ``frame``.
    """

    hold: int
    sequence: int
    sent_s: float
    axis: Axis
    frame: Frame
    speed_mm_s: float


@dataclass(frozen=True, slots=True)
class JogState:
    """What the jog does now. ``speed_mm_s`` after limits; ``slow``: why it is lower than asked."""

    order: JogOrder | None = None
    speed_mm_s: float = 0.0
    slow: str = ""


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
        self._taken_s = 0.0
        self._ended = 0
        self._step: tuple[Motion, Way] | None = None
        self.state = JogState()
        interlock.on_stop(self._stopped)

    @property
    def active(self) -> bool:
        """Whether the arm moves by hand."""
        return self._order is not None or self._step is not None

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
            self._permitted(order)
        except RefusedError:
            self.end(order.hold)
            raise
        with self._lock:
            if order.hold > self._ended:
                self._order, self._taken_s = order, self._around.wall_s()

    def end(self, hold: int) -> None:
        """End a hold, from any cause and any number of times: the arm stands still."""
        with self._lock:
            mine = self._order is not None and self._order.hold == hold
            self._ended = max(self._ended, hold)
            if mine:
                self._order = None
        if mine:
            self._halt()

    def step(self, axis: Axis, frame: Frame, distance_mm: float, speed_mm_s: float) -> None:
        """Move once by a signed distance; raises ``RefusedError`` with the way that is left."""
        self._refuse_if_taken()
        if self.active:
            raise RefusedError("JOG-BUSY", "The last step is still under way.")
        way = way_of(axis, frame, distance_mm)
        here = self._here()
        speed = self._speed(way, abs(speed_mm_s), here)
        left_mm = room_mm(here, way, self._interlock.limits)
        if abs(distance_mm) > left_mm:
            raise RefusedError("LIMIT", _left(axis, frame, distance_mm, left_mm))
        x, y, z = (part * abs(distance_mm) for part in way)
        target = Pose(here.x_mm + x, here.y_mm + y, here.z_mm + z)
        self._interlock.renew_lease(self._around.now_s())
        self._step = (self._arm.move_to(target, speed), way)

    # -- on the bench's own time ------------------------------------------------------------------

    def tick(self) -> None:
        """Renew, slow down or end the motion; call once per advance of the bench."""
        if self._step is not None:
            self._watch_step(*self._step)
        with self._lock:
            order, taken_s = self._order, self._taken_s
        if order is None:
            return
        try:
            around = self._around
            if max(around.now_s() - order.sent_s, around.wall_s() - taken_s) > LEASE_S:
                raise RefusedError("JOG-LEASE", "The jog was not renewed in time: it ended.")
            self._refuse_if_taken()
            speed, slow = self._permitted(order)
            x, y, z = (part * speed for part in way_of(order.axis, order.frame, order.speed_mm_s))
            self._interlock.renew_lease(self._around.now_s())
            self._arm.jog((x, y, z), REPEAT_S)
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
            self._order = self._step = None
        self.state = JogState()

    def _watch_step(self, motion: Motion, way: Way) -> None:
        try:
            refuse_forced(self._around.press_n(), way, self._interlock.limits, recovering=False)
        except RefusedError as error:
            if not motion.done:
                self._halt()
                self._tell(error)
        if motion.done:
            self._step = None

    def _permitted(self, order: JogOrder) -> tuple[float, str]:
        """Return (speed, why it is lower than asked); raises ``RefusedError``."""
        way, here = way_of(order.axis, order.frame, order.speed_mm_s), self._here()
        asked = abs(order.speed_mm_s)
        if not 0.0 < asked <= self._interlock.limits.jog_mm_s:
            raise RefusedError("SPEED", f"{asked:.1f} mm/s is no jog speed.")
        speed, override = self._speed(way, asked, here), self._interlock.override
        slow = "" if speed == asked else self._zone(here)[1] or f"override {100 * override:.0f} %"
        left_mm = room_mm(here, way, self._interlock.limits)
        if left_mm / REPEAT_S < speed:
            speed, slow = left_mm / REPEAT_S, f"{left_mm:.1f} mm to the limit"
        if not speed >= min(asked * override, CREEP_MM_S):
            raise RefusedError("LIMIT", _left(order.axis, order.frame, order.speed_mm_s, left_mm))
        return speed, slow

    def _speed(self, way: Way, asked_mm_s: float, here: Pose) -> float:
        interlock = self._interlock
        refuse_forced(
            self._around.press_n(), way, interlock.limits, recovering=interlock.recovering
        )
        return min(asked_mm_s * interlock.override, self._zone(here)[0])

    def _zone(self, here: Pose) -> tuple[float, str]:
        interlock, press_n = self._interlock, self._around.press_n()
        return fastest_mm_s(
            here,
            self._around.surface_mm(),
            press_n,
            interlock.limits,
            recovering=interlock.recovering,
        )

    def _here(self) -> Pose:
        try:
            return self._arm.pose(max_age_s=0.2)
        except StaleSampleError as error:
            raise RefusedError("NO-POSE", "The position of the arm is not known.") from error

    def _refuse_if_taken(self) -> None:
        if self._around.busy():
            raise RefusedError("BUSY", "A run is going on: cancel it first.")
        if self._interlock.latched:
            raise RefusedError("LATCHED", "The bench is stopped: press Reset first.")

    def _halt(self) -> None:
        # A run that has the bench moves the arm itself: it is not to be halted from here.
        if not self._around.busy():
            self._arm.halt()
            self._interlock.drop_lease()
        self.state = JogState()


def way_of(axis: Axis, frame: Frame, signed: float) -> Way:
    """Return the unit vector in the bench frame for a signed value along an axis of a frame."""
    at = AXES.index(axis)
    sign = 1.0 if signed > 0 else -1.0
    if frame == "TOOL":
        sign *= TOOL_SIGNS[at]
    x, y, z = (sign if index == at else 0.0 for index in range(3))
    return x, y, z


def _left(axis: Axis, frame: Frame, signed: float, left_mm: float) -> str:
    sign = "+" if signed > 0 else "\N{MINUS SIGN}"
    return f"{sign}{axis.upper()} ({frame}): {left_mm:.1f} mm left to the soft limit."

"""Motion programs of the simulated arm, in cycles of 10 ms.

A program computes the commanded position of ``G`` at the end of each cycle from the forces measured
before it. Programs with rotation check the next pose before each cycle and stop if it is not
allowed. ``simulation.world`` computes measured position and forces.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from touchdown.backend.core import (
    IDENTITY_ROTATION,
    Fault,
    FloatArray,
    OnsetDetector,
    OnsetRule,
    rotation_from_vector,
    rotation_vector,
)
from touchdown.backend.devices import PressCommand
from touchdown.backend.devices.streamed import (
    ACCELERATION_MM_S2,
    ACCELERATION_RAD_S2,
    UNLOAD_MM,
    JogVelocity,
    no_contact_fault,
    not_unloaded_fault,
)


@dataclass(frozen=True, slots=True)
class ArmCycle:
    """One cycle: start and end (bench clock), and the wrist samples of the cycle before.

    ``heard_t_s`` (n,), ``heard_n`` (n,): untared Fz as delivered, empty without samples.
    """

    start_s: float
    end_s: float
    heard_t_s: FloatArray
    heard_n: FloatArray


class SimProgram:
    """One command in progress.

    ``done``: it ended, with or without ``failure``. ``turn`` (3, 3): rotation of the hand after the
    last cycle; None: unchanged.
    """

    done = False
    failure: Fault | None = None
    turn: FloatArray | None = None

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the command (3,) at the end of ``cycle``."""
        raise NotImplementedError


def travelled_mm(
    elapsed_s: float, length_mm: float, speed_mm_s: float, acceleration_mm_s2: float
) -> float:
    """Return the path length along a trapezoidal speed profile (triangular if short)."""
    speed = min(speed_mm_s, math.sqrt(length_mm * acceleration_mm_s2))
    if speed <= 0.0:
        return length_mm
    rise_s = speed / acceleration_mm_s2
    total_s = length_mm / speed + rise_s
    if elapsed_s >= total_s:
        return length_mm
    if elapsed_s < rise_s:
        return 0.5 * acceleration_mm_s2 * elapsed_s**2
    if elapsed_s > total_s - rise_s:
        return length_mm - 0.5 * acceleration_mm_s2 * (total_s - elapsed_s) ** 2
    return speed * (elapsed_s - 0.5 * rise_s)


class SimTravel(SimProgram):
    """A straight move with a trapezoidal speed profile."""

    def __init__(self, start_mm: FloatArray, target_mm: FloatArray, speed_mm_s: float) -> None:
        self._start_mm, self._target_mm = start_mm.copy(), target_mm.copy()
        self._length_mm = float(np.linalg.norm(target_mm - start_mm))
        self._speed_mm_s, self._elapsed_s = speed_mm_s, 0.0

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next point of the line."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        way = travelled_mm(self._elapsed_s, self._length_mm, self._speed_mm_s, ACCELERATION_MM_S2)
        if way >= self._length_mm:
            self.done = True
            return self._target_mm.copy()
        share = way / self._length_mm
        return np.asarray(self._start_mm + share * (self._target_mm - self._start_mm))


class SimJog(SimProgram):
    """Follows a velocity until it expires, then brakes. A renewal continues without a jerk."""

    def __init__(self) -> None:
        self._velocity = JogVelocity(np.zeros(3), ACCELERATION_MM_S2)

    def renew(self, velocity_mm_s: FloatArray, until_s: float) -> None:
        """Set another velocity (3,), valid until ``until_s`` on the bench clock."""
        self._velocity.renew(velocity_mm_s, until_s)

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next point; the acceleration is limited."""
        dt_s = cycle.end_s - cycle.start_s
        self.done = self._velocity.step(cycle.start_s, dt_s)
        return np.asarray(command_mm + self._velocity.now * dt_s)


class SimPress(SimProgram):
    """Descent at constant speed until contact is declared, then a ramp from the back-dated onset.

    The command never rises: the overshoot of the descent is kept until the ramp passes it. ``air``
    (n,), (n,): times and forces just before, as the baseline of an early contact.
    """

    def __init__(
        self,
        law: PressCommand,
        start_z_mm: float,
        start_s: float,
        air: tuple[FloatArray, FloatArray],
    ) -> None:
        self._law, self._start_z_mm = law, start_z_mm
        self._detector = OnsetDetector(OnsetRule(threshold_n=law.threshold_n))
        if len(air[0]):
            self._detector.feed(*air)
        self._way: list[tuple[float, float]] = [(start_s, start_z_mm)]
        self._zero_mm: float | None = None
        self._y_mm = 0.0  # where the drag begins

    @property
    def detected_s(self) -> float | None:
        """Time at which contact was declared."""
        return self._detector.detected_s

    @property
    def onset_s(self) -> float | None:
        """Back-dated time of first contact."""
        return self._detector.onset_s

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next command of the press."""
        law, after = self._law, command_mm.copy()
        if cycle.start_s > self._way[0][0] and len(cycle.heard_n):
            self._detector.feed(cycle.heard_t_s, cycle.heard_n)
        onset_s = self._detector.onset_s
        if onset_s is None:
            after[2] -= law.approach_mm_s * (cycle.end_s - cycle.start_s)
            if self._start_z_mm - after[2] > law.max_travel_mm:
                self.done, self.failure = True, no_contact_fault(law.max_travel_mm)
                return command_mm
        else:
            if self._zero_mm is None:
                t_s, z_mm = zip(*self._way, strict=True)
                self._zero_mm = float(np.interp(onset_s, t_s, z_mm))
                self._y_mm = float(command_mm[1])
            share = min(1.0, (cycle.end_s - onset_s) / law.ramp_s)
            after[2] = min(after[2], self._zero_mm - share * law.depth_mm)
            after[1] = self._y_mm + share * law.drag_mm
            self.done = cycle.end_s >= onset_s + law.hold_s
        self._way.append((cycle.end_s, float(after[2])))
        return after


class SimUnload(SimProgram):
    """Rises while pressing until the force over ``tare_n`` has fallen to ``force_n``."""

    def __init__(self, force_n: float, tare_n: float, speed_mm_s: float, start_z_mm: float) -> None:
        self._force_n, self._tare_n = force_n, tare_n
        self._speed_mm_s, self._start_z_mm = speed_mm_s, start_z_mm

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next command; unchanged without force samples."""
        if not len(cycle.heard_n) or not np.isfinite(cycle.heard_n).all():
            return command_mm
        press_n = float(np.mean(cycle.heard_n)) - self._tare_n
        if press_n <= self._force_n:
            self.done = True
            return command_mm
        after = command_mm.copy()
        after[2] += self._speed_mm_s * (cycle.end_s - cycle.start_s)
        if after[2] - self._start_z_mm > UNLOAD_MM:
            self.done, self.failure = True, not_unloaded_fault(press_n)
        return after


class ArmDrive:
    """Holds the commanded position of ``G`` and at most one program; ``drop`` from any thread."""

    def __init__(self, command_mm: FloatArray) -> None:
        self._command_mm = command_mm.copy()
        self.turn: FloatArray = IDENTITY_ROTATION  # (3, 3) commanded turn of the hand
        self._program: SimProgram | None = None
        self._lock = threading.Lock()

    @property
    def command_mm(self) -> FloatArray:
        """Return a copy of the commanded position (3,)."""
        return self._command_mm.copy()

    @property
    def moving(self) -> bool:
        """True if a program is under way."""
        return self._program is not None

    def run(self, program: SimProgram) -> None:
        """Run ``program`` from the next cycle on, in place of any other."""
        with self._lock:
            self._program = program

    def drop(self) -> None:
        """Stand still from the next cycle on."""
        with self._lock:
            self._program = None

    def step(self, cycle: ArmCycle, *, stalled: bool) -> FloatArray:
        """Return the command (3,) at the end of ``cycle``; ``stalled``: the motors do not move."""
        with self._lock:
            program = self._program
            if program is not None and not stalled:
                self._command_mm = program.next_mm(self._command_mm, cycle)
                if program.turn is not None:
                    self.turn = program.turn
                if program.done:
                    self._program = None
            return self._command_mm.copy()


# Position (3,) of ``G``, mm, and rotation (3, 3) of the hand.
HandPose = tuple[FloatArray, FloatArray]
PoseCheck = Callable[[HandPose], Fault | None]


@dataclass(frozen=True, slots=True)
class JointKinematics:
    """Forward kinematics and check of poses."""

    chain: Callable[[FloatArray], HandPose]  # from joints (6,), rad
    allowed: PoseCheck


class _CheckedProgram(SimProgram):
    """Base of programs with rotation, which end at the first pose that is not allowed."""

    def __init__(self, start: HandPose, allowed: PoseCheck) -> None:
        self.turn = start[1]
        self._allowed = allowed

    def _go(self, command_mm: FloatArray, place: HandPose) -> FloatArray:
        """Return the command of ``place``, or stop for good if it is not allowed."""
        self.failure = self._allowed(place)
        if self.failure is not None:
            self.done = True
            return command_mm
        self.turn = place[1]
        return place[0]


class SimRotationTravel(_CheckedProgram):
    """Straight move with uniform rotation of the hand; both speeds are limited."""

    def __init__(
        self, start: HandPose, end: HandPose, speeds: tuple[float, float], allowed: PoseCheck
    ) -> None:
        """``speeds``: mm/s and rad/s."""
        super().__init__(start, allowed)
        self._start, self._end = start, end
        self._way_mm = end[0] - start[0]
        self._way_rad = rotation_vector(end[1] @ start[1].T)
        ways = (float(np.linalg.norm(self._way_mm)), float(np.linalg.norm(self._way_rad)))
        accelerations = (ACCELERATION_MM_S2, ACCELERATION_RAD_S2)
        self._per_s = min((v / w for v, w in zip(speeds, ways, strict=True) if w), default=math.inf)
        self._per_s2 = min(
            (a / w for a, w in zip(accelerations, ways, strict=True) if w), default=math.inf
        )
        self._elapsed_s = 0.0

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next point of the way."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        share = 1.0
        if math.isfinite(self._per_s):
            share = travelled_mm(self._elapsed_s, 1.0, self._per_s, self._per_s2)
        if share >= 1.0:
            command = self._go(command_mm, self._end)
            self.done = True
            return command.copy()
        turn = rotation_from_vector(share * self._way_rad) @ self._start[1]
        return self._go(command_mm, (self._start[0] + share * self._way_mm, turn))


class SimRotationJog(_CheckedProgram):
    """Follows a velocity and a rotation rate until they expire, then brakes."""

    def __init__(self, start: HandPose, allowed: PoseCheck) -> None:
        super().__init__(start, allowed)
        self._velocity = JogVelocity(np.zeros(3), ACCELERATION_MM_S2)
        self._turning = JogVelocity(np.zeros(3), ACCELERATION_RAD_S2)

    def renew(self, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float) -> None:
        """Set another velocity (3,) and rate (3,), valid until ``until_s`` on the bench clock."""
        self._velocity.renew(velocity_mm_s, until_s)
        self._turning.renew(turn_rad_s, until_s)

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return the next point; both accelerations are limited."""
        dt_s = cycle.end_s - cycle.start_s
        stands = self._velocity.step(cycle.start_s, dt_s)
        self.done = self._turning.step(cycle.start_s, dt_s) and stands
        assert self.turn is not None
        turn = rotation_from_vector(self._turning.now * dt_s) @ self.turn
        return self._go(command_mm, (command_mm + self._velocity.now * dt_s, turn))


class SimJointTravel(_CheckedProgram):
    """Moves all joints at once; the longest path determines the duration."""

    def __init__(
        self, start_rad: FloatArray, end_rad: FloatArray, speed_rad_s: float, how: JointKinematics
    ) -> None:
        super().__init__(how.chain(start_rad), how.allowed)
        self._start, self._way, self._how = start_rad, end_rad - start_rad, how
        self._speed_rad_s, self._elapsed_s = speed_rad_s, 0.0

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return where the next joints put ``G``."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        longest = float(np.abs(self._way).max())
        gone = travelled_mm(self._elapsed_s, longest, self._speed_rad_s, ACCELERATION_RAD_S2)
        share = 1.0 if longest == 0.0 else gone / longest
        after = self._go(command_mm, self._how.chain(self._start + share * self._way))
        self.done = self.done or share >= 1.0
        return after


class SimJointJog(_CheckedProgram):
    """Turns joints until its time is up, then brakes. Renewed in place."""

    def __init__(self, start_rad: FloatArray, how: JointKinematics) -> None:
        super().__init__(how.chain(start_rad), how.allowed)
        self._joints, self._how = start_rad.copy(), how
        self._speeds = JogVelocity(np.zeros(6), ACCELERATION_RAD_S2)

    def renew(self, speeds_rad_s: FloatArray, until_s: float) -> None:
        """Take other joint speeds (6,), good until ``until_s`` on the bench clock."""
        self._speeds.renew(speeds_rad_s, until_s)

    def next_mm(self, command_mm: FloatArray, cycle: ArmCycle) -> FloatArray:
        """Return where the next joints put ``G``."""
        dt_s = cycle.end_s - cycle.start_s
        self.done = self._speeds.step(cycle.start_s, dt_s)
        joints = self._joints + self._speeds.now * dt_s
        after = self._go(command_mm, self._how.chain(joints))
        if self.failure is None:
            self._joints = joints
        return after

"""Motion programs of a streamed arm, one command per controller cycle.

Each program returns the next command for ``G`` in the bench frame. It advances by one cycle per
call; missed cycles are skipped, never made up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from touchdown.backend.core import (
    IDENTITY_ROTATION,
    Fault,
    FloatArray,
    rotation_from_vector,
    rotation_vector,
)
from touchdown.backend.devices.protocols import NOTHING_MOVED, CommandedMotion, arm_fault
from touchdown.backend.devices.streamed.compliance import Compliance

ACCELERATION_MM_S2, ACCELERATION_RAD_S2 = 500.0, 2.0
AT_REST, AT_ZERO = np.zeros(3), np.zeros(6)
UNLOAD_MM = 10.0
# A move ends when the measured position is this near to its end, or after this time.
ARRIVED_MM, ARRIVED_S = 0.02, 0.3
# At this multiple of that distance the arm has not arrived: 0.5 mm, 5e-4 rad of a joint.
FAR = 25.0
NOT_ARRIVED = arm_fault(
    "ARM-STALLED",
    "The arm stands although its motion was commanded to the end.",
    "Look for an obstacle and at the controller of the arm; then press Reset.",
)


@dataclass(frozen=True, slots=True)
class CycleInput:
    """One cycle: bench time, cycle length, command and measured place (3,), new wrench samples.

    ``t_s`` (n,), ``force_n`` (n, 3): environment on tool, untared. ``turn`` (3, 3): commanded turn
    of the hand. ``sent_rad``, ``measured_rad`` (6,): joints as commanded and as measured.
    """

    now_s: float
    cycle_s: float
    command_mm: FloatArray
    measured_mm: FloatArray
    t_s: FloatArray
    force_n: FloatArray
    turn: FloatArray = field(default_factory=lambda: IDENTITY_ROTATION)
    sent_rad: FloatArray = field(default_factory=lambda: AT_ZERO)
    measured_rad: FloatArray = field(default_factory=lambda: AT_ZERO)


class MotionProgram(Protocol):
    """Program of one motion. It may continue (compliant) after its motion has ended."""

    @property
    def motion(self) -> CommandedMotion:
        """The motion that was returned to the caller."""

    @property
    def speed_mm_s(self) -> float:
        """Highest speed, from which the lead limit follows, mm/s."""

    @property
    def fragile(self) -> bool:
        """True if a hold makes the motion invalid."""

    @property
    def turn(self) -> FloatArray | None:
        """Turn (3, 3) of the hand after the next cycle; None leaves it unchanged."""

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next command (3,)."""

    def cut(self, command_mm: FloatArray) -> None:
        """Handle a command that the lead limit reduced to (3,)."""

    def still(self) -> None:
        """Handle a standstill: restart from zero speed."""


class TravelSpeed:
    """Speed along a path: at most ``most``, with braking in whole cycles to its end."""

    def __init__(self, most: float, acceleration: float) -> None:
        self.now, self._most, self._acceleration = 0.0, most, acceleration

    def step(self, left: float, cycle_s: float) -> float:
        """Change ``now`` by one cycle; return the way of this cycle. ``left``: rest of the path."""
        a_t = self._acceleration * cycle_s
        # Whole cycles of braking from v cover v (v + a T) / 2 a: solved for v.
        braking = 0.5 * a_t * (math.sqrt(1.0 + 8.0 * left / (a_t * cycle_s)) - 1.0)
        self.now = min(self.now + a_t, self._most, braking)
        return self.now * cycle_s


class JogVelocity:
    """Velocity (n,) of a jog: as requested until that expires, then zero; acceleration limited."""

    def __init__(self, now: FloatArray, acceleration: float) -> None:
        """``now`` (n,): initial velocity; ``acceleration``: limit of its change per second."""
        self.now, self._acceleration = now.copy(), acceleration
        self._asked = (np.zeros_like(now), -math.inf)

    def renew(self, velocity: FloatArray, until_s: float) -> None:
        """Request a velocity (n,) until ``until_s``."""
        self._asked = (velocity.copy(), until_s)

    def step(self, now_s: float, cycle_s: float) -> bool:
        """Change ``now`` by one cycle; return True if the request has expired and ``now`` is 0."""
        wanted, until_s = self._asked
        over = now_s >= until_s
        if over:
            wanted = np.zeros_like(self.now)
        change, most = wanted - self.now, self._acceleration * cycle_s
        size = float(np.linalg.norm(change))
        self.now = wanted.copy() if size <= most else np.asarray(self.now + change * (most / size))
        return over and not self.now.any()


class HandProgram:
    """Defaults of a program of the hand."""

    fragile = False
    turn: FloatArray | None = None

    def cut(self, command_mm: FloatArray) -> None:
        """Do nothing: the next cycle starts at the present command."""


class Arrival:
    """Ends ``motion`` after its last command: when the arm is there, at the latest after 0.3 s."""

    def __init__(self, motion: CommandedMotion, within: float) -> None:
        """``within``: distance from the end at which the arm is there, mm or rad."""
        self._motion, self._within, self._commanded_s = motion, within, math.inf

    def check(self, now_s: float, away: float) -> None:
        """Check once per cycle from the last command on; an arm far ``away`` is a fault."""
        self._commanded_s = min(self._commanded_s, now_s)
        if away <= self._within:
            self._motion.end()
        elif now_s - self._commanded_s >= ARRIVED_S:
            self._motion.end(None if away <= FAR * self._within else NOT_ARRIVED)


class TravelProgram(HandProgram):
    """Straight motion to a position."""

    def __init__(self, motion: CommandedMotion, target_mm: FloatArray, speed_mm_s: float) -> None:
        self.motion, self.speed_mm_s = motion, speed_mm_s
        self._target_mm = target_mm.copy()
        self._speed = TravelSpeed(speed_mm_s, ACCELERATION_MM_S2)
        self._arrival = Arrival(motion, ARRIVED_MM)

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next point of the line."""
        way = self._target_mm - felt.command_mm
        left_mm = float(np.linalg.norm(way))
        step_mm = self._speed.step(left_mm, felt.cycle_s)
        if left_mm - step_mm <= 1e-4:
            self._speed.now = 0.0
            away_mm = float(np.linalg.norm(felt.measured_mm - self._target_mm))
            self._arrival.check(felt.now_s, away_mm)
            return self._target_mm.copy()
        return np.asarray(felt.command_mm + way * (step_mm / left_mm))

    def still(self) -> None:
        """Restart from zero speed."""
        self._speed.now = 0.0


class JogProgram(HandProgram):
    """Motion at a velocity until its time is up, then braking. A renewal is smooth."""

    def __init__(
        self,
        motion: CommandedMotion,
        velocity_mm_s: FloatArray = AT_REST,
        turn_rad_s: FloatArray | None = None,
    ) -> None:
        """``velocity_mm_s`` and ``turn_rad_s`` (3,) are the initial velocity and turn rate; None
        keeps the turn. The arm brakes unless renewed.
        """
        self.motion, self.turns = motion, turn_rad_s is not None
        self._velocity = JogVelocity(velocity_mm_s, ACCELERATION_MM_S2)
        rate_rad_s = AT_REST if turn_rad_s is None else turn_rad_s
        self._turning = JogVelocity(rate_rad_s, ACCELERATION_RAD_S2)
        self.speed_mm_s = float(np.linalg.norm(velocity_mm_s))

    def renew(
        self, velocity_mm_s: FloatArray, until_s: float, turn_rad_s: FloatArray = AT_REST
    ) -> None:
        """Set a new velocity (3,) and turn rate (3,), valid until ``until_s``."""
        self._velocity.renew(velocity_mm_s, until_s)
        self._turning.renew(turn_rad_s, until_s)
        self.speed_mm_s = max(self.speed_mm_s, float(np.linalg.norm(velocity_mm_s)))

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next point; ``turn`` is the turn there."""
        stands = self._velocity.step(felt.now_s, felt.cycle_s)
        if self._turning.step(felt.now_s, felt.cycle_s) and stands:
            self.motion.end()
        if self.turns:
            self.turn = rotation_from_vector(self._turning.now * felt.cycle_s) @ felt.turn
        return np.asarray(felt.command_mm + self._velocity.now * felt.cycle_s)

    def still(self) -> None:
        """Restart from zero speed."""
        self._velocity.now = self._turning.now = np.zeros(3)


class UnloadProgram(HandProgram):
    """Lift in contact until the press force has fallen to ``force_n``, then stand stiffly."""

    def __init__(
        self, motion: CommandedMotion, compliance: Compliance, force_n: float, speed_mm_s: float
    ) -> None:
        self.motion, self.speed_mm_s = motion, speed_mm_s
        self._compliance, self._force_n = compliance, force_n
        self._start_mm: float | None = None

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next command; the reference stands without a measured force."""
        comply = self._compliance
        if self._start_mm is None:
            comply.rebase(felt.command_mm)
            self._start_mm = float(comply.reference_mm[2])
        # Also after the end: the release conditions use this force.
        comply.feel(felt.now_s, felt.t_s, felt.force_n)
        if self.motion.done:
            return felt.command_mm
        press_n = float(comply.felt_n[2])
        if press_n <= self._force_n:
            self.motion.end()
            return felt.command_mm
        if math.isfinite(press_n):
            comply.reference_mm[2] += self.speed_mm_s * felt.cycle_s
        if comply.reference_mm[2] - self._start_mm > UNLOAD_MM:
            self.motion.end(not_unloaded_fault(press_n))
            return felt.command_mm
        return comply.command_mm(felt.now_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Continue from the limited command."""
        self._compliance.cut(command_mm)

    def still(self) -> None:
        """Do nothing: the law has its own speed."""


def not_unloaded_fault(press_n: float) -> Fault:
    """Return the fault of a lift that did not reduce the force."""
    return arm_fault(
        "NOT-UNLOADED",
        f"{press_n:.1f} N press force after rising {UNLOAD_MM:.0f} mm.",
        "Check the force/torque sensor.",
    )


def tilted_fault(lean_rad: float, pendant: str) -> Fault:
    """Return the fault of a hand that does not point straight down; ``pendant``: of this arm."""
    return arm_fault(
        "TILTED",
        f"The hand leans {math.degrees(lean_rad):.1f}° away from straight down.",
        f"Point it down with the {pendant}, then connect again.",
        NOTHING_MOVED,
    )


ARRIVED_RAD = 2e-5


class RotationTravelProgram(HandProgram):
    """Straight motion to a position while the hand turns evenly, within both speeds."""

    def __init__(
        self,
        motion: CommandedMotion,
        target: tuple[FloatArray, FloatArray],
        speeds: tuple[float, float],
    ) -> None:
        """``target``: (3,) mm and (3, 3) turn; ``speeds``: mm/s and rad/s."""
        self.motion, (self.speed_mm_s, self.speed_rad_s) = motion, speeds
        self._target_mm, self._target_turn = target
        # In shares of the full speed per second, so that both motions end together.
        per_s = min(ACCELERATION_MM_S2 / speeds[0], ACCELERATION_RAD_S2 / speeds[1])
        self._pace, self._arrival = TravelSpeed(1.0, per_s), Arrival(motion, ARRIVED_RAD)

    def next_mm(self, felt: CycleInput) -> FloatArray:
        """Return the next point of the path; ``turn`` is the turn there."""
        way_mm = self._target_mm - felt.command_mm
        way_rad = rotation_vector(self._target_turn @ felt.turn.T)
        left_mm, left_rad = float(np.linalg.norm(way_mm)), float(np.linalg.norm(way_rad))
        left_s = max(left_mm / self.speed_mm_s, left_rad / self.speed_rad_s)  # at full speed
        step_s = self._pace.step(left_s, felt.cycle_s)
        if left_s - step_s <= 1e-6:
            self._pace.now = 0.0
            self.turn = self._target_turn
            behind_rad = float(np.abs(felt.sent_rad - felt.measured_rad).max())
            self._arrival.check(felt.now_s, behind_rad)
            return self._target_mm.copy()
        share = step_s / left_s
        self.turn = rotation_from_vector(share * way_rad) @ felt.turn
        return np.asarray(felt.command_mm + share * way_mm)

    def still(self) -> None:
        """Restart from zero speed."""
        self._pace.now = 0.0


class JointTravelProgram:
    """Motion of all joints to their ends, ending together, at most at ``speed_rad_s``."""

    fragile = False

    def __init__(self, motion: CommandedMotion, target_rad: FloatArray, speed_rad_s: float) -> None:
        self.motion, self.speed_rad_s = motion, speed_rad_s
        self._target_rad = target_rad.copy()
        self._speed = TravelSpeed(speed_rad_s, ACCELERATION_RAD_S2)
        self._arrival = Arrival(motion, ARRIVED_RAD)

    def next_rad(self, felt: CycleInput) -> FloatArray:
        """Return the next joints (6,)."""
        way = self._target_rad - felt.sent_rad
        left = float(np.abs(way).max())
        step_rad = self._speed.step(left, felt.cycle_s)
        if left - step_rad <= 1e-7:
            self._speed.now = 0.0
            behind_rad = float(np.abs(self._target_rad - felt.measured_rad).max())
            self._arrival.check(felt.now_s, behind_rad)
            return self._target_rad.copy()
        return np.asarray(felt.sent_rad + way * (step_rad / left))

    def still(self) -> None:
        """Restart from zero speed."""
        self._speed.now = 0.0


class JointJogProgram:
    """Motion at joint speeds until the time is up, then braking."""

    fragile = False

    def __init__(self, motion: CommandedMotion, now_rad_s: FloatArray = AT_ZERO) -> None:
        """``now_rad_s`` are the initial joint speeds (6,); the arm brakes unless renewed."""
        self.motion = motion
        self._speeds = JogVelocity(now_rad_s, ACCELERATION_RAD_S2)
        self.speed_rad_s = float(np.abs(now_rad_s).max())

    def renew(self, speeds_rad_s: FloatArray, until_s: float) -> None:
        """Set new joint speeds (6,), valid until ``until_s``."""
        self._speeds.renew(speeds_rad_s, until_s)
        self.speed_rad_s = max(self.speed_rad_s, float(np.abs(speeds_rad_s).max()))

    def next_rad(self, felt: CycleInput) -> FloatArray:
        """Return the next joints (6,)."""
        if self._speeds.step(felt.now_s, felt.cycle_s):
            self.motion.end()
        return np.asarray(felt.sent_rad + self._speeds.now * felt.cycle_s)

    def still(self) -> None:
        """Restart from zero speed."""
        self._speeds.now = np.zeros(6)


JointProgram = JointTravelProgram | JointJogProgram

"""Moves of a streamed arm."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from touchdown.backend.core import IDENTITY_ROTATION, Fault, FloatArray, RefusedError
from touchdown.backend.devices.protocols import CommandedMotion
from touchdown.backend.devices.streamed.compliance import Compliance

ARM = "arm"
HELD = "The arm stands still; the gripper was not opened."
NOTHING_MOVED = "Nothing was moved."


class ArmPress(CommandedMotion):
    """A press with its contact times on the bench clock."""

    detected_s: float | None = None
    onset_s: float | None = None


STOPPED = Fault(
    "STOPPED", "The motion was stopped.", HELD, "Look at the bench, then press Reset.", ARM
)
REPLACED = Fault(
    "REPLACED",
    "Another command took the place of this motion.",
    "The arm follows the newer command.",
    "Wait for a motion to end before the next command.",
    ARM,
)
NOT_CONNECTED = Fault(
    "NOT-CONNECTED",
    "The device 'arm' is not connected.",
    NOTHING_MOVED,
    "Connect the device first.",
    ARM,
)
NO_WRENCH = Fault(
    "FT-STALE",
    "No force was measured within the last second.",
    NOTHING_MOVED,
    "Check the force/torque sensor, then press again.",
    ARM,
)


def refused_fault(error: RefusedError) -> Fault:
    """Return the fault of a motion whose next command may not go out."""
    return Fault(error.reason, error.detail, HELD, "Choose another way or place.", ARM)


ACCELERATION_MM_S2 = 500.0
AT_ZERO = np.zeros(6)
UNLOAD_MM = 10.0
ARRIVED_MM, ARRIVED_S = 0.02, 0.3
"""A move has ended when the arm is measured this near its end, or this long after its command."""


@dataclass(frozen=True, slots=True)
class Felt:
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


class Program(Protocol):
    """One command in progress. It may go on (compliant) after its motion has ended."""

    @property
    def motion(self) -> CommandedMotion:
        """What whoever ordered it watches."""

    @property
    def speed_mm_s(self) -> float:
        """Highest speed it moves with: the lead limit follows from it."""

    @property
    def fragile(self) -> bool:
        """Whether a hold in between makes it void."""

    @property
    def turn(self) -> FloatArray | None:
        """Turn (3, 3) of the hand after the next cycle; None: it stays as it is."""

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next command (3,)."""

    def cut(self, command_mm: FloatArray) -> None:
        """Take note that the command was cut to (3,) by the lead limit."""

    def still(self) -> None:
        """Take note that the arm stands: begin again from zero speed."""


def eased_mm_s(speed_mm_s: float, most_mm_s: float, left_mm: float, cycle_s: float) -> float:
    """Return the speed of the next cycle: up by the acceleration, and down in time for the end."""
    faster = speed_mm_s + ACCELERATION_MM_S2 * cycle_s
    return min(faster, most_mm_s, braked(ACCELERATION_MM_S2, left_mm, cycle_s))


def braked(acceleration: float, left: float, cycle_s: float) -> float:
    """Return the highest speed from which whole cycles of braking end within ``left``."""
    a_t = acceleration * cycle_s
    # Whole cycles of braking from v cover v (v + a T) / 2 a: solved for v.
    return 0.5 * a_t * (math.sqrt(1.0 + 8.0 * left / (a_t * cycle_s)) - 1.0)


class Travel:
    """Straight to a place."""

    fragile = False
    turn: FloatArray | None = None

    def __init__(self, motion: CommandedMotion, target_mm: FloatArray, speed_mm_s: float) -> None:
        self.motion, self.speed_mm_s = motion, speed_mm_s
        self._target_mm, self._now_mm_s = target_mm.copy(), 0.0
        self._told_s: float | None = None

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next point of the line."""
        way = self._target_mm - felt.command_mm
        left_mm = float(np.linalg.norm(way))
        speed = eased_mm_s(self._now_mm_s, self.speed_mm_s, left_mm, felt.cycle_s)
        step_mm = speed * felt.cycle_s
        if left_mm - step_mm <= 1e-4:
            self._now_mm_s = 0.0
            self._watch_arrival(felt)
            return self._target_mm.copy()
        self._now_mm_s = speed
        return np.asarray(felt.command_mm + way * (step_mm / left_mm))

    def _watch_arrival(self, felt: Felt) -> None:
        self._told_s = felt.now_s if self._told_s is None else self._told_s
        away_mm = float(np.linalg.norm(felt.measured_mm - self._target_mm))
        if away_mm <= ARRIVED_MM or felt.now_s - self._told_s >= ARRIVED_S:
            self.motion.end()

    def cut(self, command_mm: FloatArray) -> None:
        """Nothing: the next cycle sets out from where the command is."""

    def still(self) -> None:
        """Begin again from zero speed."""
        self._now_mm_s = 0.0


class Follow:
    """Follows a velocity until its time is up, then brakes. Renewed in place: it never jerks."""

    fragile = False
    turn: FloatArray | None = None

    def __init__(self, motion: CommandedMotion, velocity_mm_s: FloatArray | None = None) -> None:
        """``velocity_mm_s``: what it begins with; it brakes unless renewed."""
        self.motion = motion
        self._asked_mm_s, self._until_s = np.zeros(3), -math.inf
        self._now_mm_s = np.zeros(3) if velocity_mm_s is None else velocity_mm_s.copy()
        self.speed_mm_s = float(np.linalg.norm(self._now_mm_s))

    def renew(self, velocity_mm_s: FloatArray, until_s: float) -> None:
        """Take another velocity (3,), good until ``until_s``."""
        self._asked_mm_s, self._until_s = velocity_mm_s.copy(), until_s
        self.speed_mm_s = max(self.speed_mm_s, float(np.linalg.norm(velocity_mm_s)))

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next point."""
        over = felt.now_s >= self._until_s
        wanted = np.zeros(3) if over else self._asked_mm_s
        change = wanted - self._now_mm_s
        size, most = float(np.linalg.norm(change)), ACCELERATION_MM_S2 * felt.cycle_s
        if size <= most:
            self._now_mm_s = wanted.copy()
        else:
            self._now_mm_s = self._now_mm_s + change * (most / size)
        if over and not self._now_mm_s.any():
            self.motion.end()
        return np.asarray(felt.command_mm + self._now_mm_s * felt.cycle_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Nothing: the next cycle sets out from where the command is."""

    def still(self) -> None:
        """Begin again from zero speed."""
        self._now_mm_s = np.zeros(3)


class Unload:
    """Rises in contact until the press force has fallen to ``force_n``, then stands stiffly."""

    fragile = False
    turn: FloatArray | None = None

    def __init__(
        self, motion: CommandedMotion, compliance: Compliance, force_n: float, speed_mm_s: float
    ) -> None:
        self.motion, self.speed_mm_s = motion, speed_mm_s
        self._compliance, self._force_n = compliance, force_n
        self._start_mm: float | None = None

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next command; the reference stands while nothing is felt."""
        comply = self._compliance
        if self._start_mm is None:
            comply.rebase(felt.command_mm)
            self._start_mm = float(comply.reference_mm[2])
        # Also once it has ended: whether the piece may be let go is asked of this force.
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
            self.motion.end(not_unloaded(press_n))
            return felt.command_mm
        return comply.command_mm(felt.now_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Give way from where the command really is."""
        self._compliance.cut(command_mm)

    def still(self) -> None:
        """Nothing: the law has its own speed."""


def not_unloaded(press_n: float) -> Fault:
    """Return the fault of rising without being relieved."""
    return Fault(
        "NOT-UNLOADED",
        f"{press_n:.1f} N press force after rising {UNLOAD_MM:.0f} mm.",
        HELD,
        "Check the force/torque sensor.",
        ARM,
    )

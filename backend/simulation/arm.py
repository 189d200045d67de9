"""What the simulated arm is told: straight moves, presses and unloading, in cycles of 10 ms.

A program gives the commanded position of ``G`` at the end of each cycle from what was felt until
its beginning. Measured position and forces are the business of the world.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from backend.core.faults import Fault
from backend.core.flow import FloatArray
from backend.core.onset import OnsetDetector, OnsetRule
from backend.core.turning import UNTURNED

ACCELERATION_MM_S2 = 500.0
_HELD = "The arm stands still; the gripper was not opened."


@dataclass(frozen=True, slots=True)
class Cycle:
    """One cycle: its beginning and end (bench clock), and the wrist samples of the cycle before.

    ``heard_t_s`` (n,), ``heard_n`` (n,): untared Fz as delivered, empty if the sensor is silent.
    """

    start_s: float
    end_s: float
    heard_t_s: FloatArray
    heard_n: FloatArray


class Program(Protocol):
    """One command in progress."""

    @property
    def done(self) -> bool:
        """Whether the program ended, well or not."""

    @property
    def failure(self) -> Fault | None:
        """Why it failed, None if it did not."""

    @property
    def turn(self) -> FloatArray | None:
        """Turn (3, 3) of the hand after the last cycle; None: it stays as it is."""

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the command (3,) at the end of ``cycle``."""


def travelled_mm(
    elapsed_s: float, length_mm: float, speed_mm_s: float, acceleration_mm_s2: float
) -> float:
    """Return the way along a trapezoidal speed profile (a triangle when the way is short)."""
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


class Travel:
    """A straight move with a trapezoidal speed profile."""

    failure: Fault | None = None
    turn: FloatArray | None = None

    def __init__(self, start_mm: FloatArray, target_mm: FloatArray, speed_mm_s: float) -> None:
        self._start_mm, self._target_mm = start_mm.copy(), target_mm.copy()
        self._length_mm = float(np.linalg.norm(target_mm - start_mm))
        self._speed_mm_s, self._elapsed_s = speed_mm_s, 0.0
        self.done = False

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next point of the line."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        way = travelled_mm(self._elapsed_s, self._length_mm, self._speed_mm_s, ACCELERATION_MM_S2)
        if way >= self._length_mm:
            self.done = True
            return self._target_mm.copy()
        share = way / self._length_mm
        return np.asarray(self._start_mm + share * (self._target_mm - self._start_mm))


class Jog:
    """Follows a velocity until its time is up, then brakes. Renewed in place: it never jerks."""

    failure: Fault | None = None
    turn: FloatArray | None = None

    def __init__(self) -> None:
        self._asked: tuple[FloatArray, float] = (np.zeros(3), -math.inf)
        self._velocity_mm_s = np.zeros(3)
        self.done = False

    def renew(self, velocity_mm_s: FloatArray, until_s: float) -> None:
        """Take another velocity (3,), good until ``until_s`` on the bench clock."""
        self._asked = (velocity_mm_s.copy(), until_s)

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next point; the velocity changes by the acceleration at most."""
        asked, until_s = self._asked
        over = cycle.start_s >= until_s
        wanted = np.zeros(3) if over else asked
        dt_s = cycle.end_s - cycle.start_s
        change = wanted - self._velocity_mm_s
        size, most = float(np.linalg.norm(change)), ACCELERATION_MM_S2 * dt_s
        self._velocity_mm_s = (
            wanted.copy() if size <= most else self._velocity_mm_s + change * (most / size)
        )
        self.done = over and not self._velocity_mm_s.any()
        return np.asarray(command_mm + self._velocity_mm_s * dt_s)


@dataclass(frozen=True, slots=True)
class PressLaw:
    """Descent, contact rule, ramp and hold of one press (units in the names)."""

    depth_mm: float
    ramp_s: float
    hold_s: float
    approach_mm_s: float
    threshold_n: float
    max_travel_mm: float


class Press:
    """Down at constant speed until contact is declared, then the ramp from the back-dated onset.

    The command never rises: what the descent overshot before contact was declared is kept until
    the ramp passes it. ``air`` (n,), (n,): times and forces heard just before, so that a contact
    soon after the start is known from the air, too.
    """

    failure: Fault | None = None
    turn: FloatArray | None = None

    def __init__(
        self, law: PressLaw, start_z_mm: float, start_s: float, air: tuple[FloatArray, FloatArray]
    ) -> None:
        self._law, self._start_z_mm = law, start_z_mm
        self._detector = OnsetDetector(OnsetRule(threshold_n=law.threshold_n))
        if len(air[0]):
            self._detector.feed(*air)
        self._way: list[tuple[float, float]] = [(start_s, start_z_mm)]
        self._zero_mm: float | None = None
        self.done = False

    @property
    def detected_s(self) -> float | None:
        """When contact was declared."""
        return self._detector.detected_s

    @property
    def onset_s(self) -> float | None:
        """Back-dated time of first contact."""
        return self._detector.onset_s

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next command of the press."""
        law, after = self._law, command_mm.copy()
        if cycle.start_s > self._way[0][0] and len(cycle.heard_n):
            self._detector.feed(cycle.heard_t_s, cycle.heard_n)
        onset_s = self._detector.onset_s
        if onset_s is None:
            after[2] -= law.approach_mm_s * (cycle.end_s - cycle.start_s)
            if self._start_z_mm - after[2] > law.max_travel_mm:
                self._miss()
                return command_mm
        else:
            if self._zero_mm is None:
                t_s, z_mm = zip(*self._way, strict=True)
                self._zero_mm = float(np.interp(onset_s, t_s, z_mm))
            depth_mm = law.depth_mm * min(1.0, (cycle.end_s - onset_s) / law.ramp_s)
            after[2] = min(after[2], self._zero_mm - depth_mm)
            self.done = cycle.end_s >= onset_s + law.hold_s
        self._way.append((cycle.end_s, float(after[2])))
        return after

    def _miss(self) -> None:
        self.done = True
        self.failure = Fault(
            "NO-CONTACT",
            f"No contact on {self._law.max_travel_mm:.1f} mm of descent.",
            _HELD,
            "Check the height of the support and the force/torque sensor.",
            "arm",
        )


class Unload:
    """Rises while pressing until the force over ``tare_n`` has fallen to ``force_n``."""

    LONGEST_MM = 10.0

    failure: Fault | None = None
    turn: FloatArray | None = None

    def __init__(self, force_n: float, tare_n: float, speed_mm_s: float, start_z_mm: float) -> None:
        self._force_n, self._tare_n = force_n, tare_n
        self._speed_mm_s, self._start_z_mm = speed_mm_s, start_z_mm
        self.done = False

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next command; stands still while nothing is heard."""
        if not len(cycle.heard_n) or not np.isfinite(cycle.heard_n).all():
            return command_mm
        press_n = float(np.mean(cycle.heard_n)) - self._tare_n
        if press_n <= self._force_n:
            self.done = True
            return command_mm
        after = command_mm.copy()
        after[2] += self._speed_mm_s * (cycle.end_s - cycle.start_s)
        if after[2] - self._start_z_mm > self.LONGEST_MM:
            self.done = True
            self.failure = Fault(
                "NOT-UNLOADED",
                f"{press_n:.1f} N press force after rising {self.LONGEST_MM:.0f} mm.",
                _HELD,
                "Check the force/torque sensor.",
                "arm",
            )
        return after


class ArmDrive:
    """Holds the commanded place of ``G`` and at most one program; ``drop`` from any thread."""

    def __init__(self, command_mm: FloatArray) -> None:
        self._command_mm = command_mm.copy()
        self.turn: FloatArray = UNTURNED
        """(3, 3) commanded turn of the hand."""
        self._program: Program | None = None
        self._lock = threading.Lock()

    @property
    def command_mm(self) -> FloatArray:
        """Return a copy of the commanded position (3,)."""
        return self._command_mm.copy()

    @property
    def moving(self) -> bool:
        """Whether a program is under way."""
        return self._program is not None

    def run(self, program: Program) -> None:
        """Take ``program`` from the next cycle on, in place of any other."""
        with self._lock:
            self._program = program

    def drop(self) -> None:
        """Stand still from the next cycle on."""
        with self._lock:
            self._program = None

    def step(self, cycle: Cycle, *, stalled: bool) -> FloatArray:
        """Return the command (3,) at the end of ``cycle``; ``stalled``: motors do not follow."""
        with self._lock:
            program = self._program
            if program is not None and not stalled:
                self._command_mm = program.next_mm(self._command_mm, cycle)
                if program.turn is not None:
                    self.turn = program.turn
                if program.done:
                    self._program = None
            return self._command_mm.copy()

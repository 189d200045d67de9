"""What the simulated arm is told where its hand turns: places, velocities, single joints.

Each program asks ``allowed`` before every cycle: a place that the arm cannot have, or one so low
that a turned piece might touch, ends it where it stands.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from backend.core.faults import Fault
from backend.core.flow import FloatArray
from backend.core.turning import turn_about, vector_of
from backend.simulation.arm import ACCELERATION_MM_S2, Cycle, travelled_mm

ACCELERATION_RAD_S2 = 2.0
Place = tuple[FloatArray, FloatArray]
"""Position (3,) of ``G``, mm, and turn (3, 3) of the hand."""
Allowed = Callable[[Place], Fault | None]
Chain = Callable[[FloatArray], Place]
"""From joints (6,), rad, to the place of the hand."""


def eased(now: FloatArray, wanted: FloatArray, most: float) -> FloatArray:
    """Return the velocity of the next cycle: ``wanted``, changed by ``most`` at the most."""
    change = wanted - now
    size = float(np.linalg.norm(change))
    return wanted.copy() if size <= most else np.asarray(now + change * (most / size))


@dataclass(frozen=True, slots=True)
class Driving:
    """How joints become places, and which places are allowed."""

    chain: Chain
    allowed: Allowed


class _Turning:
    """What the programs share: where they are, and how they end where they may not go on."""

    def __init__(self, start: Place, allowed: Allowed) -> None:
        self.turn: FloatArray | None = start[1]
        self.failure: Fault | None = None
        self.done = False
        self._allowed = allowed

    def _go(self, command_mm: FloatArray, place: Place) -> FloatArray:
        """Return the command of ``place``, or stand still for good where it is not allowed."""
        self.failure = self._allowed(place)
        if self.failure is not None:
            self.done = True
            return command_mm
        self.turn = place[1]
        return place[0]


class TurningTravel(_Turning):
    """Straight to a place while the hand turns evenly: neither goes faster than its speed."""

    def __init__(
        self, start: Place, end: Place, speeds: tuple[float, float], allowed: Allowed
    ) -> None:
        """``speeds``: mm/s and rad/s."""
        super().__init__(start, allowed)
        self._start, self._end = start, end
        self._way_mm = end[0] - start[0]
        self._way_rad = vector_of(end[1] @ start[1].T)
        ways = (float(np.linalg.norm(self._way_mm)), float(np.linalg.norm(self._way_rad)))
        accelerations = (ACCELERATION_MM_S2, ACCELERATION_RAD_S2)
        self._per_s = min((v / w for v, w in zip(speeds, ways, strict=True) if w), default=math.inf)
        self._per_s2 = min(
            (a / w for a, w in zip(accelerations, ways, strict=True) if w), default=math.inf
        )
        self._elapsed_s = 0.0

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next point of the way."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        share = 1.0
        if math.isfinite(self._per_s):
            share = travelled_mm(self._elapsed_s, 1.0, self._per_s, self._per_s2)
        if share >= 1.0:
            command = self._go(command_mm, self._end)
            self.done = True
            return command.copy()
        turn = turn_about(share * self._way_rad) @ self._start[1]
        return self._go(command_mm, (self._start[0] + share * self._way_mm, turn))


class TurningJog(_Turning):
    """Follows a velocity and a turn until its time is up, then brakes. Renewed in place."""

    def __init__(self, start: Place, allowed: Allowed) -> None:
        super().__init__(start, allowed)
        self._asked: tuple[FloatArray, FloatArray, float] = (np.zeros(3), np.zeros(3), -math.inf)
        self._mm_s, self._rad_s = np.zeros(3), np.zeros(3)

    def renew(self, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float) -> None:
        """Take another velocity (3,) and turn (3,), good until ``until_s`` on the bench clock."""
        self._asked = (velocity_mm_s.copy(), turn_rad_s.copy(), until_s)

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return the next point; the velocities change by the accelerations at most."""
        velocity, turning, until_s = self._asked
        over, dt_s = cycle.start_s >= until_s, cycle.end_s - cycle.start_s
        rest = np.zeros(3)
        self._mm_s = eased(self._mm_s, rest if over else velocity, ACCELERATION_MM_S2 * dt_s)
        self._rad_s = eased(self._rad_s, rest if over else turning, ACCELERATION_RAD_S2 * dt_s)
        self.done = over and not self._mm_s.any() and not self._rad_s.any()
        assert self.turn is not None
        turn = turn_about(self._rad_s * dt_s) @ self.turn
        return self._go(command_mm, (command_mm + self._mm_s * dt_s, turn))


class JointTravel(_Turning):
    """All joints to their ends at once; the one with the longest way sets the pace."""

    def __init__(
        self, start_rad: FloatArray, end_rad: FloatArray, speed_rad_s: float, how: Driving
    ) -> None:
        super().__init__(how.chain(start_rad), how.allowed)
        self._start, self._way, self._how = start_rad, end_rad - start_rad, how
        self._speed_rad_s, self._elapsed_s = speed_rad_s, 0.0

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return where the next joints put ``G``."""
        self._elapsed_s += cycle.end_s - cycle.start_s
        longest = float(np.abs(self._way).max())
        gone = travelled_mm(self._elapsed_s, longest, self._speed_rad_s, ACCELERATION_RAD_S2)
        share = 1.0 if longest == 0.0 else gone / longest
        after = self._go(command_mm, self._how.chain(self._start + share * self._way))
        self.done = self.done or share >= 1.0
        return after


class JointJog(_Turning):
    """Turns joints until its time is up, then brakes. Renewed in place."""

    def __init__(self, start_rad: FloatArray, how: Driving) -> None:
        super().__init__(how.chain(start_rad), how.allowed)
        self._joints, self._how = start_rad.copy(), how
        self._asked: tuple[FloatArray, float] = (np.zeros(6), -math.inf)
        self._rad_s = np.zeros(6)

    def renew(self, speeds_rad_s: FloatArray, until_s: float) -> None:
        """Take other joint speeds (6,), good until ``until_s`` on the bench clock."""
        self._asked = (speeds_rad_s.copy(), until_s)

    def next_mm(self, command_mm: FloatArray, cycle: Cycle) -> FloatArray:
        """Return where the next joints put ``G``."""
        asked, until_s = self._asked
        over, dt_s = cycle.start_s >= until_s, cycle.end_s - cycle.start_s
        wanted = np.zeros(6) if over else asked
        self._rad_s = eased(self._rad_s, wanted, ACCELERATION_RAD_S2 * dt_s)
        self.done = over and not self._rad_s.any()
        joints = self._joints + self._rad_s * dt_s
        after = self._go(command_mm, self._how.chain(joints))
        if self.failure is None:
            self._joints = joints
        return after

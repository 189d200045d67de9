"""Turns of the hand of a streamed arm."""

from __future__ import annotations

import math

import numpy as np

from touchdown.backend.core import FloatArray, rotation_from_vector, rotation_vector
from touchdown.backend.devices.protocols import CommandedMotion
from touchdown.backend.devices.streamed.moves import ACCELERATION_MM_S2, ARRIVED_S, Felt, braked

ACCELERATION_RAD_S2 = 2.0
ARRIVED_RAD = 2e-5


def eased(now: FloatArray, wanted: FloatArray, most: float) -> FloatArray:
    """Return the velocity of the next cycle: ``wanted``, changed by ``most`` at the most."""
    change = wanted - now
    size = float(np.linalg.norm(change))
    return wanted.copy() if size <= most else np.asarray(now + change * (most / size))


class TurningTravel:
    """Straight to a place while the hand turns evenly: neither goes faster than its speed."""

    fragile = False

    def __init__(
        self,
        motion: CommandedMotion,
        target: tuple[FloatArray, FloatArray],
        speeds: tuple[float, float],
    ) -> None:
        """``target``: (3,) mm and (3, 3) turn; ``speeds``: mm/s and rad/s."""
        self.motion, (self.speed_mm_s, self.speed_rad_s) = motion, speeds
        self._target_mm, self._target_turn = target
        self.turn: FloatArray | None = None
        self._pace = 0.0
        self._told_s: float | None = None

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next point of the way; ``turn`` is the turn there."""
        way_mm = self._target_mm - felt.command_mm
        way_rad = rotation_vector(self._target_turn @ felt.turn.T)
        left_mm, left_rad = float(np.linalg.norm(way_mm)), float(np.linalg.norm(way_rad))
        # All in seconds at full speed, so that both ways end together.
        left_s = max(left_mm / self.speed_mm_s, left_rad / self.speed_rad_s)
        per_s = min(ACCELERATION_MM_S2 / self.speed_mm_s, ACCELERATION_RAD_S2 / self.speed_rad_s)
        pace = min(self._pace + per_s * felt.cycle_s, 1.0, braked(per_s, left_s, felt.cycle_s))
        if left_s - pace * felt.cycle_s <= 1e-6:
            self._pace = 0.0
            self.turn = self._target_turn
            self._watch_arrival(felt)
            return self._target_mm.copy()
        self._pace = pace
        share = pace * felt.cycle_s / left_s
        self.turn = rotation_from_vector(share * way_rad) @ felt.turn
        return np.asarray(felt.command_mm + share * way_mm)

    def _watch_arrival(self, felt: Felt) -> None:
        self._told_s = felt.now_s if self._told_s is None else self._told_s
        behind = np.abs(felt.sent_rad - felt.measured_rad).max()
        if behind <= ARRIVED_RAD or felt.now_s - self._told_s >= ARRIVED_S:
            self.motion.end()

    def cut(self, command_mm: FloatArray) -> None:
        """Nothing: the next cycle sets out from where the command is."""

    def still(self) -> None:
        """Begin again from zero speed."""
        self._pace = 0.0


class TurningFollow:
    """Follows a velocity and a turn until its time is up, then brakes. Renewed in place."""

    fragile = False

    def __init__(
        self,
        motion: CommandedMotion,
        now: tuple[FloatArray, FloatArray] | None = None,
    ) -> None:
        """``now``: velocity (3,) and turn (3,) that it begins with; it brakes unless renewed."""
        self.motion = motion
        self._mm_s, self._rad_s = now or (np.zeros(3), np.zeros(3))
        self._asked = (np.zeros(3), np.zeros(3), -math.inf)
        self.speed_mm_s = float(np.linalg.norm(self._mm_s))
        self.speed_rad_s = float(np.linalg.norm(self._rad_s))
        self.turn: FloatArray | None = None

    def renew(self, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float) -> None:
        """Take another velocity (3,) and turn (3,), good until ``until_s``."""
        self._asked = (velocity_mm_s.copy(), turn_rad_s.copy(), until_s)
        self.speed_mm_s = max(self.speed_mm_s, float(np.linalg.norm(velocity_mm_s)))
        self.speed_rad_s = max(self.speed_rad_s, float(np.linalg.norm(turn_rad_s)))

    def next_mm(self, felt: Felt) -> FloatArray:
        """Return the next point; ``turn`` is the turn there."""
        velocity, turning, until_s = self._asked
        over, rest = felt.now_s >= until_s, np.zeros(3)
        cycle_s = felt.cycle_s
        self._mm_s = eased(self._mm_s, rest if over else velocity, ACCELERATION_MM_S2 * cycle_s)
        self._rad_s = eased(self._rad_s, rest if over else turning, ACCELERATION_RAD_S2 * cycle_s)
        if over and not self._mm_s.any() and not self._rad_s.any():
            self.motion.end()
        self.turn = rotation_from_vector(self._rad_s * cycle_s) @ felt.turn
        return np.asarray(felt.command_mm + self._mm_s * cycle_s)

    def cut(self, command_mm: FloatArray) -> None:
        """Nothing: the next cycle sets out from where the command is."""

    def still(self) -> None:
        """Begin again from zero speed."""
        self._mm_s, self._rad_s = np.zeros(3), np.zeros(3)


class JointTravel:
    """All joints to their ends at once; none goes faster than ``speed_rad_s``."""

    fragile = False

    def __init__(self, motion: CommandedMotion, target_rad: FloatArray, speed_rad_s: float) -> None:
        self.motion, self.speed_rad_s = motion, speed_rad_s
        self._target_rad, self._now_rad_s = target_rad.copy(), 0.0
        self._told_s: float | None = None

    def next_rad(self, felt: Felt) -> FloatArray:
        """Return the next joints (6,)."""
        way = self._target_rad - felt.sent_rad
        left = float(np.abs(way).max())
        speed = min(
            self._now_rad_s + ACCELERATION_RAD_S2 * felt.cycle_s,
            self.speed_rad_s,
            braked(ACCELERATION_RAD_S2, left, felt.cycle_s),
        )
        if left - speed * felt.cycle_s <= 1e-7:
            self._now_rad_s = 0.0
            self._told_s = felt.now_s if self._told_s is None else self._told_s
            behind = np.abs(self._target_rad - felt.measured_rad).max()
            if behind <= ARRIVED_RAD or felt.now_s - self._told_s >= ARRIVED_S:
                self.motion.end()
            return self._target_rad.copy()
        self._now_rad_s = speed
        return np.asarray(felt.sent_rad + way * (speed * felt.cycle_s / left))

    def still(self) -> None:
        """Begin again from zero speed."""
        self._now_rad_s = 0.0


class JointFollow:
    """Turns joints until the time is up, then brakes. Renewed in place."""

    fragile = False

    def __init__(self, motion: CommandedMotion, now_rad_s: FloatArray | None = None) -> None:
        """``now_rad_s``: joint speeds (6,) that it begins with; it brakes unless renewed."""
        self.motion = motion
        self._now_rad_s = np.zeros(6) if now_rad_s is None else now_rad_s.copy()
        self._asked_rad_s, self._until_s = np.zeros(6), -math.inf
        self.speed_rad_s = float(np.abs(self._now_rad_s).max())

    def renew(self, speeds_rad_s: FloatArray, until_s: float) -> None:
        """Take other joint speeds (6,), good until ``until_s``."""
        self._asked_rad_s, self._until_s = speeds_rad_s.copy(), until_s
        self.speed_rad_s = max(self.speed_rad_s, float(np.abs(speeds_rad_s).max()))

    def next_rad(self, felt: Felt) -> FloatArray:
        """Return the next joints (6,)."""
        over = felt.now_s >= self._until_s
        wanted = np.zeros(6) if over else self._asked_rad_s
        self._now_rad_s = eased(self._now_rad_s, wanted, ACCELERATION_RAD_S2 * felt.cycle_s)
        if over and not self._now_rad_s.any():
            self.motion.end()
        return np.asarray(felt.sent_rad + self._now_rad_s * felt.cycle_s)

    def still(self) -> None:
        """Begin again from zero speed."""
        self._now_rad_s = np.zeros(6)


JointProgram = JointTravel | JointFollow

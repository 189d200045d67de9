"""Servo stream of the arm."""

from __future__ import annotations

import math

import numpy as np

from touchdown.backend.config import UrSettings
from touchdown.backend.core import Fault, FaultError, FloatArray, Samples, rotation_from_vector
from touchdown.backend.devices.protocols import CommandedMotion
from touchdown.backend.devices.streamed import ARM, HELD, REPLACED, STOPPED, Felt, Follow, Program

M_PER_MM = 1e-3
LEAD_S, LEAD_MM = 0.25, 2.0
"""How far the arm may stay behind: this long at its speed, and a little more."""
STEP_MM = 1.5
"""No command of one cycle is farther from the last; at 125 Hz that is 187 mm/s."""


class Placing:
    """Between bench (mm) and base (m): origin and turn of the bench in the base of the arm."""

    def __init__(self, settings: UrSettings) -> None:
        self._origin_mm = np.array(settings.origin_mm)
        self._turn = rotation_from_vector(np.array([0.0, 0.0, math.radians(settings.yaw_deg)]))

    def pivot_mm(self, pose: FloatArray) -> FloatArray:
        """Return ``G`` (3,) in the bench of a pose (6,) in the base."""
        return np.asarray(self._turn.T @ (pose[:3] / M_PER_MM - self._origin_mm))

    def pose(self, pivot_mm: FloatArray, rotation: FloatArray) -> list[float]:
        """Return the pose (6,) in the base that has ``G`` there, hand turned by ``rotation``."""
        place = M_PER_MM * (self._origin_mm + self._turn @ pivot_mm)
        return [*place.tolist(), *rotation.tolist()]


def lean_rad(rotation: FloatArray) -> float:
    """Return by how much a hand with this rotation vector (3,) leans from straight down."""
    return math.acos(max(-1.0, min(1.0, -float(rotation_from_vector(rotation)[2, 2]))))


class ServoCore:
    """Program under way and command; the owner calls ``step`` once a cycle."""

    def __init__(self) -> None:
        self.program: Program | None = None
        self.command_mm, self.measured_mm = np.zeros(3), np.zeros(3)
        self._velocity_mm_s = np.zeros(3)

    def begin(self, measured_mm: FloatArray) -> None:
        """Stand where the arm is."""
        self.program = None
        self.command_mm, self.measured_mm = measured_mm.copy(), measured_mm.copy()
        self._velocity_mm_s = np.zeros(3)

    @property
    def moving(self) -> bool:
        """Whether a motion has begun and not ended."""
        return self.program is not None and not self.program.motion.done

    def run(self, program: Program) -> None:
        """Take the place of whatever goes on."""
        if self.program is not None:
            self.program.motion.end(REPLACED)
        self.program = program

    def halt(self) -> None:
        """Brake from the present speed, and stand."""
        if self.program is not None:
            self.program.motion.end(STOPPED)
            self.program = Follow(CommandedMotion({}), self._velocity_mm_s)

    def end(self, fault: Fault) -> None:
        """Stop at once; the command is where the arm is."""
        if self.program is not None:
            self.program.motion.end(fault)
        self.begin(self.measured_mm)

    def step(
        self, now_s: float, cycle_s: float, measured_mm: FloatArray, samples: Samples
    ) -> FloatArray:
        """Return the command (3,) of this cycle; raises ``FaultError`` for one that may not go out.

        ``samples``: wrench since the last cycle, untared.
        """
        self.measured_mm = measured_mm
        if self.program is None:
            return self.command_mm
        felt = Felt(
            now_s, cycle_s, self.command_mm, measured_mm, samples.t_s, samples.values[:, :3]
        )
        after_mm = self.program.next_mm(felt)
        step_mm = float(np.linalg.norm(after_mm - self.command_mm))
        if not step_mm <= STEP_MM:
            raise FaultError(_step_fault(step_mm))
        behind_mm = float(np.linalg.norm(after_mm - measured_mm))
        if not behind_mm <= self.program.speed_mm_s * LEAD_S + LEAD_MM:
            raise FaultError(_behind_fault(behind_mm))
        self._velocity_mm_s = (after_mm - self.command_mm) / cycle_s
        self.command_mm = after_mm
        return after_mm


def _step_fault(step_mm: float) -> Fault:
    return Fault(
        "STEP",
        f"A command would be {step_mm:.1f} mm from the last one.",
        HELD,
        "Move more slowly.",
        ARM,
    )


def _behind_fault(behind_mm: float) -> Fault:
    return Fault(
        "UR-BEHIND",
        f"The arm is {behind_mm:.1f} mm behind its command.",
        HELD,
        "Look for what holds it, and at the speed slider of the teach pendant; then press Reset.",
        ARM,
    )

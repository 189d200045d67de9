"""An arm whose idea of the bench is wrong: shifted, and tilted about the middle of the bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchdown.backend.core.rotations import rotation_from_vector
from touchdown.backend.core.streams import Samples, SampleStream
from touchdown.backend.core.values import FloatArray, Pose
from touchdown.backend.devices.protocols import Arm


class SkewedPoses(SampleStream):
    """What the arm believes of the places that it measured."""

    def __init__(self, true: SampleStream, skew: SkewedArm) -> None:
        super().__init__(true.name, true.channels, 1)
        self._true, self._skew = true, skew

    def window(self, start_s: float, end_s: float) -> Samples:
        """Return them as it believes."""
        samples = self._true.window(start_s, end_s)
        return replace(samples, values=self._skew.believed(samples.values))


class SkewedArm:
    """Believes to be at ``turn @ true + off_mm``: what it does is right for another bench."""

    def __init__(self, arm: Arm, off_mm: FloatArray, tilt_rad: FloatArray) -> None:
        self._arm, self._off_mm, self._turn = arm, off_mm, rotation_from_vector(tilt_rad)
        self.poses = SkewedPoses(arm.poses, self)

    def __getattr__(self, name: str) -> object:
        return getattr(self._arm, name)

    def believed(self, true_mm: FloatArray) -> FloatArray:
        """Return where the arm believes true places (..., 3) to be."""
        return np.asarray(true_mm @ self._turn.T + self._off_mm)

    def true(self, believed_mm: FloatArray) -> FloatArray:
        """Return what places (..., 3) of the arm really are."""
        return np.asarray((believed_mm - self._off_mm) @ self._turn)

    def pose(self, max_age_s: float) -> Pose:
        """Return where it believes to be."""
        at = self._arm.pose(max_age_s)
        return Pose(*self.believed(np.array([at.x_mm, at.y_mm, at.z_mm])).tolist())

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = 0.1) -> object:
        """Go where it believes ``target`` to be."""
        there = self.true(np.array([target.x_mm, target.y_mm, target.z_mm]))
        return self._arm.move_to(Pose(*there.tolist()), speed_mm_s, turn_rad_s)

"""Arm with a wrong frame: shifted, and tilted about the centre of the bench."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from touchdown.backend.core import FloatArray, Pose, Samples, SampleStream, rotation_from_vector
from touchdown.backend.devices.protocols import Arm


class SkewedPoses(SampleStream):
    """Recorded poses in the frame of the arm."""

    def __init__(self, true: SampleStream, skew: SkewedArm) -> None:
        super().__init__(true.name, true.channels, 1)
        self._true, self._skew = true, skew

    def window(self, start_s: float, end_s: float) -> Samples:
        """Return a window in the frame of the arm."""
        samples = self._true.window(start_s, end_s)
        return replace(samples, values=self._skew.believed(samples.values))


class SkewedArm:
    """Arm whose frame is ``turn @ true + off_mm``."""

    def __init__(self, arm: Arm, off_mm: FloatArray, tilt_rad: FloatArray) -> None:
        self._arm, self._off_mm, self._turn = arm, off_mm, rotation_from_vector(tilt_rad)
        self.poses = SkewedPoses(arm.poses, self)

    def __getattr__(self, name: str) -> object:
        return getattr(self._arm, name)

    def believed(self, true_mm: FloatArray) -> FloatArray:
        """Return true positions (..., 3) in the frame of the arm."""
        return np.asarray(true_mm @ self._turn.T + self._off_mm)

    def true(self, believed_mm: FloatArray) -> FloatArray:
        """Return positions (..., 3) of the arm's frame in the true frame."""
        return np.asarray((believed_mm - self._off_mm) @ self._turn)

    def pose(self, max_age_s: float) -> Pose:
        """Return the pose in the frame of the arm."""
        at = self._arm.pose(max_age_s)
        return Pose(*self.believed(np.array([at.x_mm, at.y_mm, at.z_mm])).tolist())

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = 0.1) -> object:
        """Move to ``target`` in the frame of the arm."""
        there = self.true(np.array([target.x_mm, target.y_mm, target.z_mm]))
        return self._arm.move_to(Pose(*there.tolist()), speed_mm_s, turn_rad_s)

"""The joints of the simulated arm: those of an RV-5AS that stands beside the simulated bench."""

from __future__ import annotations

import math

import numpy as np

from backend.config.hardware import MelfaSettings
from backend.core.faults import Fault, RefusedError
from backend.core.flow import FloatArray
from backend.core.turning import LEVEL_RAD, tilt_rad, vector_of
from backend.devices.melfa.guard import check_joints
from backend.devices.melfa.kinematics import Placing
from backend.simulation.turning import Place
from backend.simulation.world import World

CLEAR_MM = 10.0
"""The simulated contact knows an unturned face only: turned, it stays as high as this."""


class SimJoints:
    """From the place of the hand to the joints and back, and which places are allowed."""

    def __init__(self, world: World) -> None:
        arm = MelfaSettings()
        yaw_rad, hand_rad = math.radians(arm.yaw_deg), math.radians(arm.hand_deg)
        self._placing = Placing(arm.origin_mm, yaw_rad, hand_rad, arm.tool_mm)
        self._world = world
        self._last = np.zeros(6)

    def of(self, place: Place) -> FloatArray:
        """Return the (6,) joints, rad, of a place, near the last ones; raises ``RefusedError``."""
        self._last = self._placing.joints(place[0], self._last, place[1])
        return self._last.copy()

    def place(self, joints_rad: FloatArray) -> Place:
        """Return where (6,) joints put the hand."""
        return self._placing.pivot_mm(joints_rad), self._placing.turn(joints_rad)

    def allowed(self, place: Place) -> Fault | None:
        """Return why the arm may not be at ``place``, None if it may."""
        try:
            check_joints(self.of(place))
        except RefusedError as error:
            return _refused(error.reason, error.detail, "Choose another way or place.")
        turned = float(np.linalg.norm(vector_of(place[1]))) > LEVEL_RAD
        if turned and not self._world.clear_mm(place[0]) >= CLEAR_MM:
            what = (
                f"The hand is turned (tilted by {math.degrees(tilt_rad(place[1])):.1f}°): "
                f"it would come within {CLEAR_MM:.0f} mm of the surface."
            )
            return _refused("TURNED-LOW", what, "Go up, or level the hand first.")
        return None


def _refused(code: str, what: str, next_step: str) -> Fault:
    return Fault(code, what, "The arm stands still.", next_step, "arm")

"""The joints of a MELFA RV-5AS-D as its maker publishes them, and the cycle of its controller.

Source: arm model and joint limits of the vendor's ROS 2 driver.
"""

from __future__ import annotations

from dataclasses import dataclass

CYCLE_S = 0.0035
"""Control cycle of a CR800."""


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint: ``axis`` of rotation, ``rise_mm`` along z from the joint before it.

    ``limit_rad`` to both sides, highest speed and acceleration.
    """

    axis: str
    rise_mm: float
    limit_rad: float
    speed_rad_s: float
    acceleration_rad_s2: float

    @property
    def step_rad(self) -> float:
        """Largest step in one cycle at the highest speed."""
        return self.speed_rad_s * CYCLE_S


JOINTS = (
    Joint("z", 0.0, 4.18879, 2.16421, 6.0),
    Joint("y", 254.0, 2.58309, 2.16421, 6.0),
    Joint("y", 410.0, 2.61799, 2.16421, 6.0),
    Joint("z", 0.0, 3.49066, 3.4383, 9.0),
    Joint("y", 500.0, 2.0944, 6.21337, 18.0),
    Joint("z", 0.0, 3.49066, 6.28318, 18.0),
)
"""J1 to J6; at zero the arm stands straight up."""
FLANGE_MM = 125.0
"""From the crossing of the wrist axes to the flange."""

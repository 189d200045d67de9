"""Record of what emulated devices received."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from touchdown.backend.core import FloatArray
from touchdown.backend.devices.melfa import EmulatedMelfa

STILL_S = 0.2
"""How long before now the arm is looked at once more, to know whether it stands."""
REST_ROWS = 100
"""Wrist samples of a bench that was just set up: what hangs on the sensor, without any contact."""


@dataclass(frozen=True, slots=True)
class Witnessed:
    """Since the scene was set. ``step_share``: largest step of a joint, share of its top speed.

    ``late_command_s``: how long after an error of the controller (an emergency stop, an alarm, the
    servo off) a motion command still came. ``moving_mm``: how far the pivot went in the last 0.2 s.
    ``openings``: how often the jaws were told to open while they held. ``barred``: motions asked of
    a gripper whose fault nobody had acknowledged. ``force_n``: largest force on the wrist, beside
    what hangs on it.
    """

    step_share: float
    late_command_s: float
    moving_mm: float
    openings: int
    barred: int
    force_n: float

    def __str__(self) -> str:
        late = "no command after an error"
        if self.late_command_s > 0.0:
            late = f"last command {1e3 * self.late_command_s:.0f} ms after an error"
        return (
            f"largest step {100 * self.step_share:.1f} % of a joint's top speed; {late}; "
            f"jaws opened on a piece {self.openings} times, "
            f"{self.barred} motions asked of a gripper in a fault; "
            f"strongest force {self.force_n:.1f} N"
        )


class WatchedGripper(Protocol):
    """What is asked of the emulated gripper."""

    openings: int
    barred: int


class Witness:
    """Looks at the devices; ``gripper`` is set once there is one."""

    def __init__(self, melfa: EmulatedMelfa) -> None:
        self._melfa = melfa
        self.gripper: WatchedGripper | None = None
        self._rest: list[FloatArray] = []
        self._rest_n: FloatArray = np.zeros(3)
        self._force_n = 0.0

    def feel(self, wrench: FloatArray) -> None:
        """Take (N, 6) wrist samples of the world."""
        force_n = wrench[:, :3]
        if sum(map(len, self._rest)) < REST_ROWS:
            self._rest.append(force_n)
            self._rest_n = np.concatenate(self._rest).mean(axis=0)
        if len(force_n):
            strongest_n = np.linalg.norm(force_n - self._rest_n, axis=1).max()
            self._force_n = max(self._force_n, float(strongest_n))

    def told(self, moving_mm: float) -> Witnessed:
        """Return what was seen so far."""
        stream, gripper = self._melfa.stream, self.gripper
        return Witnessed(
            step_share=stream.largest_share,
            late_command_s=stream.late_command_s,
            moving_mm=moving_mm,
            openings=0 if gripper is None else gripper.openings,
            barred=0 if gripper is None else gripper.barred,
            force_n=self._force_n,
        )

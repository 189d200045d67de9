"""A motion that asks for steps too large, as an error of the program could."""

from __future__ import annotations

import numpy as np

from touchdown.backend.core.values import FloatArray
from touchdown.backend.devices.protocols import CommandedMotion
from touchdown.backend.devices.streamed.motion_programs import CycleInput


class Leaping:
    """Asks ``leaps`` times for ``step_mm`` (3,) at once, then stands."""

    fragile = False
    turn: FloatArray | None = None
    speed_mm_s = 20.0

    def __init__(self, step_mm: FloatArray, leaps: int) -> None:
        self.motion = CommandedMotion({})
        self._step_mm, self._left = step_mm, leaps

    def next_mm(self, felt: CycleInput) -> FloatArray:
        if self._left == 0:
            self.motion.end()
            return felt.command_mm
        self._left -= 1
        return np.asarray(felt.command_mm + self._step_mm)

    def cut(self, command_mm: FloatArray) -> None:
        pass

    def still(self) -> None:
        pass

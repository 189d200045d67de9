"""The emulated force program: descend to contact, press with a stiffness, hold, unload or lift.

Along each axis the place is the taught one less force by stiffness, reached with a lag.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import Enum

import numpy as np

from backend.core.flow import FloatArray
from backend.emulators.melfa_arm import Nearby, frame_of
from backend.wire.melfa_joints import CYCLE_S

LAG_S = 0.15
ASK_S, STAND_S = 3.0, 60.0
LIFT_MM, LIFT_MM_S, UNLOAD_MM = 2.0, 10.0, 10.0
IN_A_ROW = 3
WRITTEN = (
    "MDSPD", "MDTRV", "MDTHR", "MDDEP", "MDRMP", "MDHLD", "MDKX", "MDKY", "MDKZ", "MDUNL", "MDUSP",
    "MDDMP", "MDFRM",
)  # fmt: skip
"""What must have been written before it runs."""
UNLOAD, ABORT = 2, 3
"""Values of MDO; 0 waits, 1 lifts."""


class Step(Enum):
    """Where the program is."""

    DESCEND = "descend"
    PRESS = "press"
    ASKED = "asked"
    UNLOADING = "unloading"
    STANDING = "standing"
    LIFTING = "lifting"
    ENDED = "ended"


class EmulatedProbe:
    """One run of the program from joints (6,); ``force_n`` on the tool (3,) in axes of the base."""

    def __init__(
        self,
        joints_rad: FloatArray,
        variables: Mapping[str, float],
        force_n: Callable[[], FloatArray],
    ) -> None:
        self._variables, self._force_n = variables, force_n
        self._offset_n = force_n()
        self._arm = Nearby(joints_rad)
        self._frame = frame_of(joints_rad)
        self._taught_mm = self._frame[:3, 3].copy()
        self._start_mm = self._touch_mm = float(self._taught_mm[2])
        self._give_mm = np.zeros(3)
        self._lasted_s = 0.0
        self._over = 0
        self.step = Step.DESCEND

    def cycle(self) -> FloatArray | None:
        """Advance by one cycle; return the joints (6,), None where no place has any."""
        force_n = self._force_n() - self._offset_n
        self._lasted_s += CYCLE_S
        self._advance(float(force_n[2]))
        stiffness = np.array([self._variables[name] for name in ("MDKX", "MDKY", "MDKZ")])
        self._give_mm += (force_n / stiffness - self._give_mm) * (CYCLE_S / (LAG_S + CYCLE_S))
        frame = self._frame.copy()
        frame[:3, 3] = self._taught_mm + self._give_mm
        return self._arm.solve(frame)

    def _go(self, step: Step) -> None:
        self.step, self._lasted_s = step, 0.0

    def _advance(self, press_n: float) -> None:
        order = round(self._variables["MDO"])
        if order == ABORT and self.step not in (Step.DESCEND, Step.LIFTING, Step.ENDED):
            self._go(Step.LIFTING)
        steps: dict[Step, Callable[[float, int], None]] = {
            Step.DESCEND: self._descend,
            Step.PRESS: self._press,
            Step.ASKED: self._ask,
            Step.UNLOADING: self._unload,
            Step.STANDING: self._stand,
            Step.LIFTING: self._lift,
            Step.ENDED: lambda press_n, order: None,
        }
        steps[self.step](press_n, order)

    def _press(self, press_n: float, order: int) -> None:
        told = self._variables
        self._down(told["MDDEP"] / told["MDRMP"], self._touch_mm - told["MDDEP"])
        if self._lasted_s >= told["MDHLD"]:
            self._go(Step.ASKED)

    def _ask(self, press_n: float, order: int) -> None:
        if order == UNLOAD:
            self._start_mm = float(self._taught_mm[2])
            self._go(Step.UNLOADING)
        elif order or self._lasted_s >= ASK_S:
            self._go(Step.LIFTING)

    def _unload(self, press_n: float, order: int) -> None:
        self._taught_mm[2] += self._variables["MDUSP"] * CYCLE_S
        rose_mm = float(self._taught_mm[2]) - self._start_mm
        if press_n <= self._variables["MDUNL"] or rose_mm >= UNLOAD_MM:
            self._go(Step.STANDING)

    def _stand(self, press_n: float, order: int) -> None:
        if order != UNLOAD or self._lasted_s >= STAND_S:
            self._go(Step.LIFTING)

    def _lift(self, press_n: float, order: int) -> None:
        self._taught_mm[2] += LIFT_MM_S * CYCLE_S
        if self._taught_mm[2] >= self._touch_mm + LIFT_MM:
            self.step = Step.ENDED

    def _descend(self, press_n: float, order: int) -> None:
        told = self._variables
        self._over = self._over + 1 if press_n > told["MDTHR"] else 0
        if self._over >= IN_A_ROW:
            self._touch_mm = float(self._taught_mm[2])
            self._go(Step.PRESS)
            return
        least_mm = self._start_mm - told["MDTRV"]
        self._down(told["MDSPD"], least_mm)
        if self._taught_mm[2] <= least_mm:
            self.step = Step.ENDED

    def _down(self, speed_mm_s: float, least_mm: float) -> None:
        self._taught_mm[2] = max(float(self._taught_mm[2]) - speed_mm_s * CYCLE_S, least_mm)

"""Set points of a streamed arm."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from touchdown.backend.core import Fault, FaultError, FloatArray, RefusedError, SampleStream
from touchdown.backend.devices.interlock import RETREAT_MM, RETREAT_MM_S
from touchdown.backend.devices.protocols import CommandedMotion, PressCommand
from touchdown.backend.devices.streamed.compliance import (
    TRIP_N,
    Compliance,
    Loop,
    fastest_approach_mm_s,
    law_for,
)
from touchdown.backend.devices.streamed.moves import (
    ARM,
    NO_WRENCH,
    NOTHING_MOVED,
    ArmPress,
    Follow,
    Program,
    Travel,
    Unload,
)
from touchdown.backend.devices.streamed.press import Press

AIR_S = 1.0
VELOCITY_NAMES = ("x_mm_s", "y_mm_s", "z_mm_s", "rx_rad_s", "ry_rad_s", "rz_rad_s")


class Core(Protocol):
    """What carries programs out, one command per cycle."""

    @property
    def program(self) -> object | None:
        """What goes on, or went on last."""

    @property
    def command_mm(self) -> FloatArray:
        """(3,) commanded place of ``G``."""

    def run(self, program: Program) -> None:
        """Take ``program`` in place of any other."""


class StreamedOrders:
    """Makes programs; keeps the contact of the last press until it is left."""

    def __init__(self, loop: Loop) -> None:
        self.loop = loop
        self._press: Press | None = None

    def leave(self) -> None:
        """Forget the contact: the arm goes elsewhere."""
        self._press = None

    def press_n(self) -> float:
        """Return the felt press force by the zero of the contact law; NaN without contact."""
        contact = self._contact()
        return math.nan if contact is None else float(contact.felt_n[2])

    def follow(self, core: Core, velocity_mm_s: FloatArray, until_s: float) -> CommandedMotion:
        """Begin to follow a velocity (3,) until then, or go on with another."""
        self.leave()
        program = core.program
        if not isinstance(program, Follow) or program.motion.done:
            program = Follow(jogging(velocity_mm_s))
            core.run(program)
        program.renew(velocity_mm_s, until_s)
        return program.motion

    def press(
        self, core: Core, command: PressCommand, before: tuple[FloatArray, FloatArray]
    ) -> ArmPress:
        """Begin a press; ``before``: samples in air up to now.

        Raises ``RefusedError`` if the approach is too fast for the delay of this loop.
        """
        law = law_for(self.loop, command.stiffness_n_mm)
        fastest = fastest_approach_mm_s(law, self.loop, TRIP_N, command.depth_mm)
        if not 0.0 < command.approach_mm_s <= fastest:
            raise RefusedError(
                "APPROACH-SPEED",
                f"{command.approach_mm_s:.1f} mm/s: a contact could reach {TRIP_N:.0f} N over "
                f"{fastest:.1f} mm/s.",
            )
        motion = ArmPress({**told_of(command), "damping_n_s_mm": law.damping})
        self._press = Press(motion, command, law, self.loop, before)
        core.run(self._press)
        return motion

    def unload(self, core: Core, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Begin to rise; raises ``FaultError`` unless the last press has touched."""
        compliance = self._contact()
        if compliance is None:
            raise FaultError(NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        core.run(Unload(motion, compliance, force_n, speed_mm_s))
        return motion

    def retreat(self, core: Core) -> None:
        """Draw back: a press along its own law, everything else straight up from its command."""
        if self._press is not None and core.program is self._press and self._press.retreat():
            return
        self.leave()
        up_mm = core.command_mm + np.array([0.0, 0.0, RETREAT_MM])
        core.run(Travel(CommandedMotion({"z_mm": float(up_mm[2])}), up_mm, RETREAT_MM_S))

    def _contact(self) -> Compliance | None:
        return None if self._press is None else self._press.compliance


def jogging(velocity_mm_s: FloatArray, turn_rad_s: FloatArray | None = None) -> CommandedMotion:
    """Return the motion of a jog with velocity (3,) and turn (3,)."""
    turn = np.zeros(3) if turn_rad_s is None else turn_rad_s
    values = [*velocity_mm_s.tolist(), *turn.tolist()]
    return CommandedMotion(dict(zip(VELOCITY_NAMES, values, strict=True)))


def air_before(wrench: SampleStream, now_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the times (n,) and forces (n, 3) of the last second; ``FaultError`` if there are none.

    Only finite samples count.
    """
    air = wrench.window(now_s - AIR_S, now_s)
    finite = np.isfinite(air.values).all(axis=1)
    if not finite.any():
        raise FaultError(NO_WRENCH)
    return air.t_s[finite], air.values[finite, :3]


def told_of(command: PressCommand) -> dict[str, float]:
    """Return what is sent of a press, by name."""
    return {
        "depth_mm": command.depth_mm,
        "ramp_s": command.ramp_s,
        "hold_s": command.hold_s,
        "approach_mm_s": command.approach_mm_s,
        "threshold_n": command.threshold_n,
        "max_travel_mm": command.max_travel_mm,
        "stiffness_z_n_mm": command.stiffness_n_mm[2],
    }


NOT_PRESSING = Fault(
    "NOT-PRESSING",
    "There is no press to unload: the last one felt no contact, or the arm has moved since.",
    NOTHING_MOVED,
    "Press first.",
    ARM,
)

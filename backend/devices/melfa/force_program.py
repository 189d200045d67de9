"""The controller's own force program, in place of compliance over the stream.

It excludes the stream: that is ended before, and opened again by the next other order.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from backend.config.hardware import MelfaSettings
from backend.core.faults import Fault, FaultError, RefusedError
from backend.core.flow import FloatArray
from backend.devices.melfa.console import Console
from backend.devices.melfa.controller_press import ControllerPress
from backend.devices.melfa.stream import END
from backend.devices.melfa.wires import Wires
from backend.devices.motion import CommandedMotion
from backend.devices.protocols import PressCommand
from backend.devices.streamed.motion import ArmPress
from backend.devices.streamed.orders import NOT_PRESSING, told_of
from backend.wire.melfa_r3 import Request

Air = tuple[FloatArray, FloatArray]
"""Times (n,) and forces (n, 3)."""
HOT_S = 1.0
UNLOAD, ABORT = 2, 3
"""What the variable MDO asks of the program."""
PLACE_LATE_S = 0.6
"""So much later the place is told: ten times a second at most, and not while variables are written.
Still within the second of silence that is a fault of the command channel (reliability 6.1)."""
UNLOAD_SHARE = 0.8
"""It unloads a little further than asked: its own sensor has another zero."""


class ForceProgram:
    """``console`` returns the one of the present connection."""

    def __init__(
        self, console: Callable[[], Console], wires: Wires, settings: MelfaSettings
    ) -> None:
        self._console, self._wires, self._settings = console, wires, settings
        self._press: ControllerPress | None = None

    @property
    def under_way(self) -> bool:
        """Whether a press or an unloading goes on."""
        return self._press is not None and self._press.under_way

    @property
    def running(self) -> bool:
        """Whether the program may still hold the arm."""
        return self._press is not None

    @property
    def place_late_s(self) -> float:
        """By how much older a place may be while the program holds the arm."""
        return PLACE_LATE_S if self.running else 0.0

    @property
    def press_n(self) -> float:
        """Felt press force; NaN without contact."""
        return math.nan if self._press is None else self._press.press_n

    def refuse(self, command: PressCommand) -> None:
        """Raise ``RefusedError`` for a press that could reach more than the limit of a probe."""
        most_n = command.depth_mm * command.stiffness_n_mm[2]
        limit_n = self._settings.probe_force_limit_n
        if not most_n <= limit_n:
            raise RefusedError(
                "PROBE-FORCE", f"{most_n:.1f} N could be reached; the limit is {limit_n:.1f} N."
            )

    def begin(self, command: PressCommand, air: Callable[[], Air]) -> ArmPress:
        """Write the variables and run the program; the stream has been ended. ``FaultError``.

        ``air`` returns the samples in air up to now.
        """
        kx, ky, kz = command.stiffness_n_mm
        self._console().run_probe(
            {
                "MDSPD": command.approach_mm_s,
                "MDTRV": command.max_travel_mm,
                "MDTHR": command.threshold_n,
                "MDDEP": command.depth_mm,
                "MDRMP": command.ramp_s,
                "MDHLD": command.hold_s,
                "MDKX": kx,
                "MDKY": ky,
                "MDKZ": kz,
                "MDUNL": UNLOAD_SHARE * command.threshold_n,
                "MDUSP": command.approach_mm_s,
                "MDDMP": self._settings.fsc.damping,
                "MDFRM": self._settings.fsc.frame,
            }
        )
        before = air()
        motion = ArmPress({**told_of(command), "damping_n_s_mm": self._settings.fsc.damping})
        self._press = ControllerPress(motion, command, before, self._settings.probe_margin_s)
        return motion

    def unload(self, force_n: float, speed_mm_s: float, now_s: float) -> CommandedMotion:
        """Tell the program to rise; raises ``FaultError`` unless its press has touched."""
        press = self._press
        if press is None or not press.holds(now_s):
            raise FaultError(NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        for name, value in (
            ("MDUNL", UNLOAD_SHARE * force_n), ("MDUSP", speed_mm_s), ("MDO", UNLOAD),
        ):  # fmt: skip
            self._hot(name, value)
        press.unload(motion, force_n, now_s, speed_mm_s)
        return motion

    def cycle(self, now_s: float, samples: tuple[FloatArray, FloatArray], *, running: bool) -> None:
        """See how the press stands; abort the program for what went wrong.

        On the way down it listens to nothing but its own sensor: there it is stopped.
        """
        press = self._press
        if press is None or press.step(now_s, samples, running=running) is None:
            return
        if press.touched:
            self._hot("MDO", ABORT)
            return
        self._press = None
        self._wires.stop_now(END)
        self._wires.pace(running=False)

    def end(self, fault: Fault) -> None:
        """Take note that the program was, or is to be, stopped."""
        press, self._press = self._press, None
        if press is not None:
            press.end(fault)

    def _hot(self, name: str, value: float) -> None:
        program = self._settings.fsc.program
        self._wires.ask(Request("HOT", f"{program};{name}={value:g}"), HOT_S)

"""Presses with the controller's force program instead of compliance over the stream.

It excludes the stream, which is ended before and reopened by the next other command. Wrist samples
determine the contact and the end of the press. ``ControllerPress`` has no thread, wire or clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from touchdown.backend import core
from touchdown.backend.config import MelfaSettings
from touchdown.backend.devices import streamed
from touchdown.backend.devices.melfa.command_channel import Console, ControllerLinks
from touchdown.backend.devices.melfa.r3_protocol import R3Request
from touchdown.backend.devices.melfa.stream import END
from touchdown.backend.devices.protocols import ArmPress, CommandedMotion, PressCommand, arm_fault

# Time the program waits for the next command, and the delay of a command.
WAITS_S, SOON_S = 3.0, 0.3


class ControllerPress:
    """State of one press; ``before``: wrench samples (n,), (n, 3) in air; ``margin_s``:
    permitted delay.
    """

    def __init__(
        self,
        motion: ArmPress,
        command: PressCommand,
        before: tuple[core.FloatArray, core.FloatArray],
        margin_s: float,
    ) -> None:
        self.motion, self._command, self._margin_s = motion, command, margin_s
        self._unloading: CommandedMotion | None = None
        self._unloaded_n = 0.0
        t_s, force_n = before
        self._air_n = force_n[t_s >= t_s[-1] - streamed.AIR_WINDOW_S].mean(axis=0)
        self._detector = core.OnsetDetector(core.OnsetRule(threshold_n=command.threshold_n))
        self._detector.feed(t_s, force_n[:, 2])
        self._felt_s, self._press_n = float(t_s[-1]), math.nan
        descent_s = command.max_travel_mm / command.approach_mm_s
        self._ends_s = self._felt_s + descent_s + command.hold_s + margin_s
        self._trip = streamed.TripDetector()

    @property
    def under_way(self) -> bool:
        """True until the press or its unloading has ended."""
        return not self.motion.done or (self._unloading is not None and not self._unloading.done)

    @property
    def touched(self) -> bool:
        """True after contact."""
        return self.motion.onset_s is not None

    def holds(self, now_s: float) -> bool:
        """Return True while the program presses: it lifts by itself without a timely command."""
        onset_s = self.motion.onset_s
        if onset_s is None:
            return False
        waits_until_s = onset_s + self._command.hold_s + WAITS_S
        return self._unloading is not None or now_s < waits_until_s - SOON_S

    @property
    def press_n(self) -> float:
        """Newest press force relative to air, N; NaN before contact."""
        return self._press_n if self.touched else math.nan

    def unload(self, motion: CommandedMotion, force_n: float, now_s: float, speed: float) -> None:
        """Handle the command to unload to ``force_n`` at ``speed`` mm/s."""
        self._unloading, self._unloaded_n = motion, force_n
        self._ends_s = now_s + streamed.UNLOAD_MM / speed + self._margin_s

    def end(self, fault: core.Fault) -> None:
        """End the press: the program was stopped."""
        self.motion.end(fault)
        if self._unloading is not None:
            self._unloading.end(fault)

    def step(
        self, now_s: float, samples: tuple[core.FloatArray, core.FloatArray], *, running: bool
    ) -> core.Fault | None:
        """Process samples (n,), (n, 3) and the program state; a returned fault aborts the
        program.
        """
        tripped = self._add_samples(*samples)
        if not self.under_way:
            return None
        fault = self._wrong(now_s, tripped, running=running)
        if fault is not None:
            self.end(fault)
            return fault if running else None
        onset_s = self.motion.onset_s
        if self._unloading is not None:
            if self._press_n <= self._unloaded_n:
                self._unloading.end()
        elif onset_s is not None and now_s >= onset_s + self._command.hold_s:
            self.motion.end()
        return None

    def _wrong(self, now_s: float, tripped: bool, *, running: bool) -> core.Fault | None:
        if tripped:
            return streamed.TRIPPED
        if not now_s - self._felt_s <= streamed.OLD_S:
            return streamed.UNFELT
        if not running:
            return ENDED if self.touched else streamed.no_contact_fault(self._command.max_travel_mm)
        if now_s > self._ends_s:
            return LATE if self._unloading is None else streamed.not_unloaded_fault(self._press_n)
        return None

    def _add_samples(self, t_s: core.FloatArray, force_n: core.FloatArray) -> bool:
        """Add samples; return True above the trip limit."""
        finite = np.isfinite(force_n).all(axis=1)
        if not finite.any():
            return False
        values = force_n[finite] - self._air_n
        self._felt_s, self._press_n = float(t_s[finite][-1]), float(values[:, 2].mean())
        if not self.motion.done and not self.touched:
            self._detector.feed(t_s[finite], force_n[finite, 2])
            self.motion.detected_s = self._detector.detected_s
            self.motion.onset_s = self._detector.onset_s
        return self._trip.feed(values)


ENDED = arm_fault(
    "PROBE-ENDED",
    "The controller's force program has ended in the middle of a press.",
    "Look at the controller and its program TDPROBE, then press Reset.",
)
LATE = arm_fault(
    "PROBE-LATE",
    "The controller's force program has not come to its end in time.",
    "Look at its speeds and at the override of the controller, then press Reset.",
    "The program was ordered to lift by 2 mm; the gripper was not opened.",
)


AirBaseline = tuple[core.FloatArray, core.FloatArray]  # times (n,) and forces (n, 3)
HOT_S = 1.0
UNLOAD, ABORT = 2, 3  # values of the variable MDO
# Additional delay of positions: they come at most ten times per second, and not while variables are
# written. Less than the second of silence that is a fault of the command channel.
PLACE_LATE_S = 0.6
UNLOAD_SHARE = 0.8  # unload further than commanded: the controller's sensor has another zero


class ForceProgram:
    """Force program of a controller; ``console`` returns that of the present connection."""

    def __init__(
        self, console: Callable[[], Console], wires: ControllerLinks, settings: MelfaSettings
    ) -> None:
        self._console, self._wires, self._settings = console, wires, settings
        self._press: ControllerPress | None = None

    @property
    def under_way(self) -> bool:
        """True during a press or an unloading."""
        return self._press is not None and self._press.under_way

    @property
    def running(self) -> bool:
        """True while the program may hold the arm."""
        return self._press is not None

    @property
    def place_late_s(self) -> float:
        """Additional age of positions while the program holds the arm, s."""
        return PLACE_LATE_S if self.running else 0.0

    @property
    def press_n(self) -> float:
        """Measured press force, N; NaN without contact."""
        return math.nan if self._press is None else self._press.press_n

    def refuse(self, command: PressCommand) -> None:
        """Raise ``RefusedError`` for a press that drags or could exceed the limit of a probe."""
        if command.drag_mm:
            raise core.RefusedError("PRESS-DRAGS", "The force program presses straight down only.")
        most_n, limit_n = command.nominal_n, self._settings.probe_force_limit_n
        if not most_n <= limit_n:
            raise core.RefusedError(
                "PROBE-FORCE", f"{most_n:.1f} N could be reached; the limit is {limit_n:.1f} N."
            )

    def begin(self, command: PressCommand, air: Callable[[], AirBaseline]) -> ArmPress:
        """Write the variables and run the program, after the end of the stream. ``air`` returns the
        samples in air up to now. Raises ``FaultError``.
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
        motion = ArmPress(
            {**streamed.press_fields(command), "damping_n_s_mm": self._settings.fsc.damping}
        )
        self._press = ControllerPress(motion, command, before, self._settings.probe_margin_s)
        return motion

    def unload(self, force_n: float, speed_mm_s: float, now_s: float) -> CommandedMotion:
        """Command the program to lift; raises ``FaultError`` unless its press had contact."""
        press = self._press
        if press is None or not press.holds(now_s):
            raise core.FaultError(streamed.NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        for name, value in (
            ("MDUNL", UNLOAD_SHARE * force_n), ("MDUSP", speed_mm_s), ("MDO", UNLOAD),
        ):  # fmt: skip
            self._hot(name, value)
        press.unload(motion, force_n, now_s, speed_mm_s)
        return motion

    def cycle(
        self, now_s: float, samples: tuple[core.FloatArray, core.FloatArray], *, running: bool
    ) -> None:
        """Process one cycle; abort the program after a fault. During the descent the program only
        reads its own sensor, so it is stopped there.
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

    def end(self, fault: core.Fault) -> None:
        """Handle a stop of the program."""
        press, self._press = self._press, None
        if press is not None:
            press.end(fault)

    def _hot(self, name: str, value: float) -> None:
        program = self._settings.fsc.program
        self._wires.ask(R3Request("HOT", f"{program};{name}={value:g}"), HOT_S)

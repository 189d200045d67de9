"""What a Universal Robots arm is ordered, as programs of its cycles; callers hold its lock."""

from __future__ import annotations

from backend.config.hardware import UrSettings
from backend.core.faults import FaultError, RefusedError
from backend.core.flow import FloatArray
from backend.devices.melfa.admittance import Loop, fastest_approach_mm_s, law_for
from backend.devices.melfa.compliance import TRIP_N
from backend.devices.melfa.motion import ArmPress
from backend.devices.melfa.orders import NOT_PRESSING
from backend.devices.melfa.pressing import Press
from backend.devices.melfa.programs import Follow, Unload
from backend.devices.motion import CommandedMotion
from backend.devices.protocols import PressCommand
from backend.devices.ur.servo import ServoCore


class UrOrders:
    """Keeps the contact of the last press until it is left."""

    def __init__(self, settings: UrSettings, cycle_s: float) -> None:
        self.loop = Loop(
            cycle_s,
            arm_lag_s=1e-3 * settings.arm_lag_ms,
            sensor_lag_s=1e-3 * settings.sensor_lag_ms,
        )
        self._press: Press | None = None

    def leave(self) -> None:
        """Forget the contact: the arm goes elsewhere."""
        self._press = None

    def jog(self, core: ServoCore, velocity_mm_s: FloatArray, until_s: float) -> CommandedMotion:
        """Begin to follow a velocity, or go on with another."""
        self._press = None
        program = core.program
        if not isinstance(program, Follow) or program.motion.done:
            names = ("x_mm_s", "y_mm_s", "z_mm_s")
            sent = dict(zip(names, velocity_mm_s.tolist(), strict=True))
            program = Follow(CommandedMotion(sent))
            core.run(program)
        program.renew(velocity_mm_s, until_s)
        return program.motion

    def press(
        self, core: ServoCore, command: PressCommand, before: tuple[FloatArray, FloatArray]
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
        motion = ArmPress(
            {
                "depth_mm": command.depth_mm,
                "ramp_s": command.ramp_s,
                "hold_s": command.hold_s,
                "approach_mm_s": command.approach_mm_s,
                "threshold_n": command.threshold_n,
                "max_travel_mm": command.max_travel_mm,
                "stiffness_z_n_mm": command.stiffness_n_mm[2],
                "damping_n_s_mm": law.damping,
            }
        )
        self._press = Press(motion, command, law, self.loop, before)
        core.run(self._press)
        return motion

    def unload(self, core: ServoCore, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Begin to rise; raises ``FaultError`` unless the last press has touched."""
        compliance = None if self._press is None else self._press.compliance
        if compliance is None:
            raise FaultError(NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        core.run(Unload(motion, compliance, force_n, speed_mm_s))
        return motion

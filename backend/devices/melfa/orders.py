"""What the arm is ordered, as programs of the stream. Callers hold the lock of the stream."""

from __future__ import annotations

import math

from backend.config.hardware import MelfaSettings
from backend.core.faults import Fault, FaultError, RefusedError
from backend.core.flow import FloatArray
from backend.core.turning import UNTURNED
from backend.devices.melfa.admittance import Loop, fastest_approach_mm_s, law_for
from backend.devices.melfa.compliance import TRIP_N, Compliance
from backend.devices.melfa.kinematics import Placing
from backend.devices.melfa.link_faults import NOTHING_MOVED
from backend.devices.melfa.motion import ARM, ArmPress
from backend.devices.melfa.pressing import Press
from backend.devices.melfa.programs import Follow, Travel, Unload
from backend.devices.melfa.stream import StreamCore
from backend.devices.melfa.turning import JointFollow, JointTravel, TurningFollow, TurningTravel
from backend.devices.motion import CommandedMotion
from backend.devices.protocols import PressCommand
from backend.wire.melfa_joints import CYCLE_S


class Orders:
    """Makes programs for one arm; keeps the contact of the last press until it is left."""

    def __init__(self, settings: MelfaSettings) -> None:
        self.placing = Placing(
            settings.origin_mm,
            math.radians(settings.yaw_deg),
            math.radians(settings.hand_deg),
            settings.tool_mm,
        )
        self.loop = Loop(
            CYCLE_S,
            arm_lag_s=1e-3 * settings.arm_lag_ms,
            sensor_lag_s=1e-3 * settings.sensor_lag_ms,
        )
        self._press: Press | None = None

    def under_way(self, core: StreamCore) -> bool:
        """Whether a motion has begun and not ended."""
        program = core.program
        return program is not None and not program.motion.done

    def press_n(self) -> float:
        """Return the felt press force by the zero of the contact law; NaN without contact."""
        contact = self._contact()
        return math.nan if contact is None else float(contact.felt_n[2])

    def travel(
        self,
        core: StreamCore,
        target: tuple[FloatArray, FloatArray],
        speeds: tuple[float, float],
    ) -> CommandedMotion:
        """Begin a straight move to (3,) mm and (3, 3) turn, with mm/s and rad/s."""
        target_mm, turn = target
        x, y, z = target_mm.tolist()
        motion = CommandedMotion({"x_mm": x, "y_mm": y, "z_mm": z, "speed_mm_s": speeds[0]})
        self._press = None
        if turn is UNTURNED and core.turn is UNTURNED:
            core.run(Travel(motion, target_mm, speeds[0]))
        else:
            core.run(TurningTravel(motion, target, speeds))
        return motion

    def jog(
        self, core: StreamCore, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to follow a velocity and a turn, or go on with others."""
        program = core.program
        self._press = None
        turning = core.turn is not UNTURNED or bool(turn_rad_s.any())
        if turning:
            if not isinstance(program, TurningFollow) or program.motion.done:
                program = TurningFollow(_jogging(velocity_mm_s, turn_rad_s))
                core.run(program)
            program.renew(velocity_mm_s, turn_rad_s, until_s)
            return program.motion
        if not isinstance(program, Follow) or program.motion.done:
            program = Follow(_jogging(velocity_mm_s, turn_rad_s))
            core.run(program)
        program.renew(velocity_mm_s, until_s)
        return program.motion

    def jog_joints(
        self, core: StreamCore, speeds_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to turn joints, or go on with other speeds."""
        program = core.program
        self._press = None
        if not isinstance(program, JointFollow) or program.motion.done:
            speeds = {f"j{k}_rad_s": v for k, v in enumerate(speeds_rad_s.tolist(), 1)}
            program = JointFollow(CommandedMotion(speeds))
            core.run(program)
        program.renew(speeds_rad_s, until_s)
        return program.motion

    def travel_joints(
        self, core: StreamCore, target_rad: FloatArray, speed_rad_s: float
    ) -> CommandedMotion:
        """Begin to turn all joints to their ends."""
        ends = {f"j{k}_rad": v for k, v in enumerate(target_rad.tolist(), 1)}
        motion = CommandedMotion({**ends, "speed_rad_s": speed_rad_s})
        self._press = None
        core.run(JointTravel(motion, target_rad, speed_rad_s))
        return motion

    def press(
        self, core: StreamCore, command: PressCommand, before: tuple[FloatArray, FloatArray]
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

    def unload(self, core: StreamCore, force_n: float, speed_mm_s: float) -> CommandedMotion:
        """Begin to rise; raises ``FaultError`` unless the last press has touched."""
        compliance = self._contact()
        if compliance is None:
            raise FaultError(NOT_PRESSING)
        motion = CommandedMotion({"force_n": force_n, "speed_mm_s": speed_mm_s})
        core.run(Unload(motion, compliance, force_n, speed_mm_s))
        return motion

    def _contact(self) -> Compliance | None:
        return None if self._press is None else self._press.compliance


def _jogging(velocity_mm_s: FloatArray, turn_rad_s: FloatArray) -> CommandedMotion:
    names = ("x_mm_s", "y_mm_s", "z_mm_s", "rx_rad_s", "ry_rad_s", "rz_rad_s")
    values = [*velocity_mm_s.tolist(), *turn_rad_s.tolist()]
    return CommandedMotion(dict(zip(names, values, strict=True)))


NOT_PRESSING = Fault(
    "NOT-PRESSING",
    "There is no press to unload: the last one felt no contact, or the arm has moved since.",
    NOTHING_MOVED,
    "Press first.",
    ARM,
)

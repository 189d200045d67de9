"""What the arm is ordered, as programs of the stream. Callers hold the lock of the stream."""

from __future__ import annotations

import math

from backend.config.hardware import MelfaSettings
from backend.core.flow import FloatArray
from backend.core.turning import UNTURNED
from backend.devices.melfa.kinematics import Placing
from backend.devices.melfa.stream import StreamCore
from backend.devices.motion import CommandedMotion
from backend.devices.streamed.admittance import Loop
from backend.devices.streamed.orders import StreamedOrders, jogging
from backend.devices.streamed.programs import Travel
from backend.devices.streamed.turning import JointFollow, JointTravel, TurningFollow, TurningTravel
from backend.wire.melfa_joints import CYCLE_S


class Orders:
    """Makes programs for one arm; ``level``: those that any streamed arm has."""

    def __init__(self, settings: MelfaSettings) -> None:
        self.placing = Placing(
            settings.origin_mm,
            math.radians(settings.yaw_deg),
            math.radians(settings.hand_deg),
            settings.tool_mm,
        )
        self.level = StreamedOrders(
            Loop(
                CYCLE_S,
                arm_lag_s=1e-3 * settings.arm_lag_ms,
                sensor_lag_s=1e-3 * settings.sensor_lag_ms,
            )
        )

    def under_way(self, core: StreamCore) -> bool:
        """Whether a motion has begun and not ended."""
        program = core.program
        return program is not None and not program.motion.done

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
        self.level.leave()
        if turn is UNTURNED and core.turn is UNTURNED:
            core.run(Travel(motion, target_mm, speeds[0]))
        else:
            core.run(TurningTravel(motion, target, speeds))
        return motion

    def jog(
        self, core: StreamCore, velocity_mm_s: FloatArray, turn_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to follow a velocity and a turn, or go on with others."""
        if core.turn is UNTURNED and not turn_rad_s.any():
            return self.level.follow(core, velocity_mm_s, until_s)
        program = core.program
        self.level.leave()
        if not isinstance(program, TurningFollow) or program.motion.done:
            program = TurningFollow(jogging(velocity_mm_s, turn_rad_s))
            core.run(program)
        program.renew(velocity_mm_s, turn_rad_s, until_s)
        return program.motion

    def jog_joints(
        self, core: StreamCore, speeds_rad_s: FloatArray, until_s: float
    ) -> CommandedMotion:
        """Begin to turn joints, or go on with other speeds."""
        program = core.program
        self.level.leave()
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
        self.level.leave()
        core.run(JointTravel(motion, target_rad, speed_rad_s))
        return motion

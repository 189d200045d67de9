"""The orders that the rig takes, by name: arguments from JSON, limits checked, the driver called.

The guards of the backend have asked the same before: here nothing gets to a wire past the limits,
whoever gave the order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from backend.core.faults import RefusedError
from backend.core.flow import Pose
from backend.devices.held import ByHand, Right
from backend.devices.homing import Homing
from backend.devices.interlock import Limits, ReleaseEvidence
from backend.devices.jog_limits import refuse_outside
from backend.devices.protocols import Arm, Gripper, Motion, PressCommand
from backend.devices.putting_back import JigEvidence

Arguments = Mapping[str, Any]
RIGHTS: dict[str, type[ReleaseEvidence] | type[JigEvidence] | type[ByHand]] = {
    right.__name__: right for right in (ReleaseEvidence, JigEvidence, ByHand)
}
MOVES = frozenset(
    {"arm.move_to", "arm.jog", "arm.jog_joints", "arm.move_joints", "arm.press", "arm.unload"}
)
"""What moves the arm: only with a lease, without latch, beside a wrist sensor that is felt."""
JAWS = frozenset({"gripper.grip", "gripper.open_to", "gripper.open_held"})
"""What moves the jaws in a run: only with a lease and without latch."""


@dataclass(frozen=True, slots=True)
class Orders:
    """What arm and gripper can be told; ``open_held`` asks the release table first."""

    arm: Arm
    gripper: Gripper
    may_open: Callable[[Right], None]

    def give(self, name: str, arguments: Arguments, limits: Limits) -> Motion | list[float] | None:
        """Carry order ``name`` out; return its motion, a value, or None."""
        known = {
            "arm.servo": self._servo,
            "arm.move_to": self._move_to,
            "arm.jog": self._jog,
            "arm.jog_joints": self._jog_joints,
            "arm.move_joints": self._move_joints,
            "arm.press": self._press,
            "arm.unload": self._unload,
            "arm.halt": self._halt,
            "arm.place_of": self._place_of,
            "gripper.home": self._home,
            "gripper.acknowledge": self._acknowledge,
            "gripper.grip": self._grip,
            "gripper.open_to": self._open_to,
            "gripper.open_held": self._open_held,
        }
        if name not in known:
            raise ValueError(f"there is no order {name!r}")
        return known[name](arguments, limits)

    # -- arm --------------------------------------------------------------------------------------

    def _servo(self, given: Arguments, limits: Limits) -> None:
        self.arm.servo(bool(given["on"]))

    def _move_to(self, given: Arguments, limits: Limits) -> Motion:
        target = Pose(*given["target"])
        refuse_outside(target, limits)
        _refuse_fast("SPEED", given["speed_mm_s"], limits.speed_mm_s)
        _refuse_fast("TURN-SPEED", given["turn_rad_s"], limits.turn_rad_s)
        return self.arm.move_to(target, given["speed_mm_s"], given["turn_rad_s"])

    def _jog(self, given: Arguments, limits: Limits) -> Motion:
        velocity, turning = given["velocity_mm_s"], given["turn_rad_s"]
        _refuse_fast("SPEED", math.hypot(*velocity), limits.jog_mm_s)
        _refuse_fast("TURN-SPEED", math.hypot(*turning), limits.turn_rad_s)
        return self.arm.jog(tuple(velocity), given["for_s"], tuple(turning))

    def _jog_joints(self, given: Arguments, limits: Limits) -> Motion:
        speeds = tuple(given["speeds_rad_s"])
        _refuse_fast("TURN-SPEED", max(map(abs, speeds)), limits.turn_rad_s)
        return self.arm.jog_joints(speeds, given["for_s"])

    def _move_joints(self, given: Arguments, limits: Limits) -> Motion:
        _refuse_fast("TURN-SPEED", given["speed_rad_s"], limits.turn_rad_s)
        return self.arm.move_joints(tuple(given["target_rad"]), given["speed_rad_s"])

    def _press(self, given: Arguments, limits: Limits) -> Motion:
        stiffness = tuple(given["stiffness_n_mm"])
        command = PressCommand(**{**given, "stiffness_n_mm": stiffness})
        nominal_n = stiffness[2] * command.depth_mm
        if not nominal_n <= limits.probe_n:
            raise RefusedError("PRESS-FORCE", f"Nominal {nominal_n:.1f} N is over the limit.")
        _refuse_fast("APPROACH-SPEED", command.approach_mm_s, limits.contact_speed_mm_s)
        return self.arm.press(command)

    def _unload(self, given: Arguments, limits: Limits) -> Motion:
        _refuse_fast("SPEED", given["speed_mm_s"], limits.speed_mm_s)
        return self.arm.unload(given["force_n"], given["speed_mm_s"])

    def _halt(self, given: Arguments, limits: Limits) -> None:
        self.arm.halt()

    def _place_of(self, given: Arguments, limits: Limits) -> list[float]:
        place = self.arm.place_of(tuple(given["joints_rad"]))
        return [place.x_mm, place.y_mm, place.z_mm, place.rx_rad, place.ry_rad, place.rz_rad]

    # -- gripper ----------------------------------------------------------------------------------

    def _home(self, given: Arguments, limits: Limits) -> Motion:
        return self._homing().home()

    def _acknowledge(self, given: Arguments, limits: Limits) -> None:
        self._homing().acknowledge()

    def _homing(self) -> Homing:
        if not isinstance(self.gripper, Homing):
            raise RefusedError("NO-HOMING", "This gripper is not homed from here.")
        return self.gripper

    def _grip(self, given: Arguments, limits: Limits) -> Motion:
        return self.gripper.grip(given["force_n"])

    def _open_to(self, given: Arguments, limits: Limits) -> Motion:
        if self.gripper.status().holding:
            raise RefusedError("HOLDING", "A piece is held: it is let go by a right only.")
        return self.gripper.open_to(given["width_mm"], given["speed_mm_s"])

    def _open_held(self, given: Arguments, limits: Limits) -> Motion:
        right = RIGHTS[given["right"]](**given["evidence"])
        self.may_open(right)
        return self.gripper.open_to(given["width_mm"], given["speed_mm_s"])


def _refuse_fast(name: str, speed: float, most: float) -> None:
    """Raise ``RefusedError`` unless ``speed`` is within 0 to ``most``; NaN refuses."""
    if not 0.0 <= speed <= most * (1.0 + 1e-9):
        raise RefusedError(name, f"A speed of {speed:.3g} is not within 0 to {most:.3g}.")

"""Follows the drift of the wrist sensor on a bench, and names it to the operator.

Air is where the hand stands still, unturned, at least ``CLEAR_MM`` above what it may touch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from backend.core.facts import Fact, Noticed
from backend.core.faults import Fault, StaleSampleError
from backend.core.flow import Pose
from backend.core.turning import LEVEL_RAD
from backend.devices.protocols import Arm, Gripper
from backend.sensing.drift import Drift, DriftWatch
from backend.sensing.live import LiveSensing

CLEAR_MM = 1.0
"""So high above the support a hand touches nothing."""
STILL_MM, STILL_RAD = 0.05, 0.001
"""A hand that moves by less stands."""
SETTLE_S = 0.2
"""Vibration dies out before its air counts."""
SAME_MM = 0.3
"""Jaws that moved by less hold what they held."""
POSE_AGE_S = 0.2


@dataclass(frozen=True, slots=True)
class Place:
    """Where the devices of one scene stand. ``surface_mm``: height of ``G`` in contact."""

    now_s: Callable[[], float]
    arm: Arm
    gripper: Gripper
    surface_mm: Callable[[], float]


class DriftTeller:
    """One scene. ``update`` is called once per advance of the bench and tells ``sensing``."""

    def __init__(self, place: Place, sensing: LiveSensing, publish: Callable[[Fact], None]) -> None:
        self._place, self._sensing, self._publish = place, sensing, publish
        self._cursor = sensing.raw.samples.count
        self._watch = DriftWatch()
        self._stands: Pose | None = None
        self._since_s = math.inf
        self._load: tuple[bool, float] | None = None

    def update(self) -> None:
        """Take what arrived since the last call; publish ``Noticed`` where the drift is much."""
        samples = self._sensing.raw.samples.since(self._cursor)
        self._cursor = samples.cursor
        if not self._stands_in_air():
            self._watch.leave()
            return
        settled = samples.t_s >= self._since_s + SETTLE_S
        self._watch.feed(samples.t_s[settled], samples.values[settled, :3])
        was, found = self._sensing.drift, self._watch.drift()
        self._sensing.drift = found
        if found is not None and found.named and not (was is not None and was.named):
            self._publish(Noticed(self._place.now_s(), drift_notice(found)))

    def _stands_in_air(self) -> bool:
        place = self._place
        status = place.gripper.status()
        load = status.holding, status.width_mm
        if self._load is None or not _same_load(load, self._load):
            self._load = load
            self._watch.reload()
            self._stands = None
        try:
            pose = place.arm.pose(POSE_AGE_S)
        except StaleSampleError:
            pose = None
        if pose is None or math.hypot(pose.rx_rad, pose.ry_rad, pose.rz_rad) > LEVEL_RAD:
            self._stands = None
            if pose is not None:
                self._watch.reload()
            return False
        if self._stands is None or not _stands(pose, self._stands):
            self._stands, self._since_s = pose, place.now_s()
            return False
        return pose.z_mm >= place.surface_mm() + CLEAR_MM


def drift_notice(drift: Drift) -> Fault:
    """Return what to say of a sensor that drifts much; nothing is latched."""
    per_min = 60.0 * drift.rate_n_s
    return Fault(
        "FT-DRIFT",
        f"The wrist sensor has drifted by {drift.moved_n:.2f} N in {drift.over_s:.0f} s, "
        f"in still air ({per_min:.1f} N a minute).",
        "Each probe takes its own tare; what drifts after that is read as force.",
        "Zero it in air (Z) before you go by its figures; let a cold sensor warm up. "
        "If it goes on, check its mounting and cable.",
        "force_torque",
    )


def _same_load(one: tuple[bool, float], other: tuple[bool, float]) -> bool:
    moved = abs(one[1] - other[1])
    return one[0] == other[0] and not moved > SAME_MM


def _stands(one: Pose, other: Pose) -> bool:
    # Number by number: asked in every step, of so few numbers, arrays take ten times as long.
    moved = (one.x_mm - other.x_mm, one.y_mm - other.y_mm, one.z_mm - other.z_mm)
    turned = (one.rx_rad - other.rx_rad, one.ry_rad - other.ry_rad, one.rz_rad - other.rz_rad)
    return all(abs(d) <= STILL_MM for d in moved) and all(abs(d) <= STILL_RAD for d in turned)

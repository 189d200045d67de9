"""Arm and gripper behind the interlock: the only ones that plans and windows ever hold."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping

from backend.core.faults import RefusedError
from backend.core.flow import Pose
from backend.core.stream import SampleStream
from backend.devices.interlock import LEASE_S, Interlock, ReleaseEvidence, release_refusal
from backend.devices.jog_limits import refuse_forced, room_mm
from backend.devices.protocols import (
    Arm,
    ArmStatus,
    Device,
    DeviceState,
    Gripper,
    GripStatus,
    Health,
    Identity,
    Motion,
    PressCommand,
    PressMotion,
)
from backend.devices.putting_back import JigEvidence, jig_refusal

PressForce = Callable[[], float]
"""Present press force in N (tared Fz), NaN if unknown."""


class _Guarded:
    """Connection and identity pass through unguarded: they move nothing."""

    def __init__(self, device: Device) -> None:
        self._device = device

    @property
    def name(self) -> str:
        """Name of the device."""
        return self._device.name

    @property
    def state(self) -> DeviceState:
        """State of the connection."""
        return self._device.state

    @property
    def identity(self) -> Identity | None:
        """Identity of the device."""
        return self._device.identity

    @property
    def health(self) -> Health:
        """Health of the device."""
        return self._device.health

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Connect the device."""
        self._device.connect(timeout_s, cancel)

    def close(self) -> None:
        """Close the connection; nothing is let go."""
        self._device.close()

    def describe(self) -> Mapping[str, str | float]:
        """Raw fields of the device."""
        return self._device.describe()


class GuardedArm(_Guarded):
    """An ``Arm`` that refuses what the limits forbid; a limit never changes a command silently."""

    def __init__(
        self, arm: Arm, interlock: Interlock, now_s: Callable[[], float], press_n: PressForce
    ) -> None:
        super().__init__(arm)
        self._arm, self._interlock = arm, interlock
        self._now_s, self._press_n = now_s, press_n
        interlock.on_stop(arm.stop)

    @property
    def poses(self) -> SampleStream:
        """Measured positions of ``G``."""
        return self._arm.poses

    def status(self) -> ArmStatus:
        """Status words of the arm."""
        return self._arm.status()

    def pose(self, max_age_s: float) -> Pose:
        """Measured pose of ``G``."""
        return self._arm.pose(max_age_s)

    def move_to(self, target: Pose, speed_mm_s: float) -> Motion:
        """Move straight to ``target``; refused outside the limits, and sideways while pressing."""
        self._interlock.require_motion(self._now_s())
        limits = self._interlock.limits
        values = (target.x_mm, target.y_mm, target.z_mm, speed_mm_s)
        if not all(math.isfinite(value) for value in values):
            raise RefusedError("NOT-FINITE", "The target or the speed is not a finite number.")
        if not 0 < speed_mm_s <= limits.speed_mm_s:
            raise RefusedError(
                "SPEED", f"{speed_mm_s:.1f} mm/s is not within 0 to {limits.speed_mm_s:.0f} mm/s."
            )
        reach = math.hypot(target.x_mm, target.y_mm)
        if reach > limits.reach_mm:
            over = reach - limits.reach_mm
            raise RefusedError("REACH", f"The target is {over:.1f} mm outside the workspace.")
        if not limits.lowest_mm <= target.z_mm <= limits.highest_mm:
            raise RefusedError(
                "HEIGHT",
                f"z = {target.z_mm:.1f} mm is not within {limits.lowest_mm:.0f} to "
                f"{limits.highest_mm:.0f} mm.",
            )
        self._refuse_dragging(target)
        return self._arm.move_to(target, speed_mm_s * self._interlock.override)

    @property
    def rotates(self) -> bool:
        """Whether the hand can turn."""
        return self._arm.rotates

    def jog(self, velocity_mm_s: tuple[float, float, float], for_s: float) -> Motion:
        """Follow a velocity; refused when too fast, too long, outside, or against a force."""
        self._interlock.require_motion(self._now_s())
        limits = self._interlock.limits
        speed = math.hypot(*velocity_mm_s)
        if not 0 < speed <= limits.jog_mm_s:
            raise RefusedError(
                "SPEED", f"{speed:.1f} mm/s is not within 0 to {limits.jog_mm_s:.0f} mm/s."
            )
        if not 0 < for_s <= LEASE_S:
            raise RefusedError("JOG-TIME", f"{for_s:.2f} s is not within 0 to {LEASE_S:.2f} s.")
        x, y, z = (part / speed for part in velocity_mm_s)
        way = (x, y, z)
        refuse_forced(self._press_n(), way, limits, recovering=self._interlock.recovering)
        left_mm = room_mm(self._arm.pose(max_age_s=0.2), way, limits)
        if not left_mm > 0:
            raise RefusedError("LIMIT", "The arm is at the edge of its workspace.")
        return self._arm.jog(velocity_mm_s, for_s)

    def halt(self) -> None:
        """Stand still without a latch: a jog ended."""
        self._arm.halt()

    def press(self, command: PressCommand) -> PressMotion:
        """Press; refused if the nominal force exceeds the limit or the approach is too fast."""
        self._interlock.require_motion(self._now_s())
        limits = self._interlock.limits
        nominal_n = command.stiffness_n_mm[2] * command.depth_mm
        if not nominal_n <= limits.probe_n:
            raise RefusedError(
                "PRESS-FORCE", f"Nominal {nominal_n:.1f} N exceeds {limits.probe_n:.0f} N."
            )
        if not 0 < command.approach_mm_s <= limits.contact_speed_mm_s:
            raise RefusedError(
                "APPROACH-SPEED",
                f"{command.approach_mm_s:.1f} mm/s exceeds {limits.contact_speed_mm_s:.1f} mm/s.",
            )
        return self._arm.press(command)

    def unload(self, force_n: float, speed_mm_s: float) -> Motion:
        """Rise to the press force ``force_n``."""
        self._interlock.require_motion(self._now_s())
        return self._arm.unload(force_n, speed_mm_s)

    def stop(self) -> None:
        """Latch the interlock and stop."""
        self._interlock.stop()

    def _refuse_dragging(self, target: Pose) -> None:
        here = self._arm.pose(max_age_s=0.2)
        sideways = math.hypot(target.x_mm - here.x_mm, target.y_mm - here.y_mm)
        force = self._press_n()
        if sideways > 0.05 and not abs(force) <= self._interlock.limits.contact_n:
            raise RefusedError(
                "DRAGGING", f"Lift first: {force:.1f} N press on the support while moving sideways."
            )


class GuardedGripper(_Guarded):
    """A ``Gripper`` that opens on a held piece only with the evidence of a stable placement."""

    def __init__(self, gripper: Gripper, interlock: Interlock, now_s: Callable[[], float]) -> None:
        super().__init__(gripper)
        self._gripper, self._interlock, self._now_s = gripper, interlock, now_s
        interlock.on_stop(gripper.stop)

    def status(self) -> GripStatus:
        """Present width, force and whether a piece is held."""
        return self._gripper.status()

    def grip(self, force_n: float) -> Motion:
        """Grip with ``force_n`` per finger."""
        self._interlock.require_motion(self._now_s())
        return self._gripper.grip(force_n)

    def open_to(self, width_mm: float, speed_mm_s: float) -> Motion:
        """Open while nothing is held; refused while a piece is held (see ``release``)."""
        self._interlock.require_motion(self._now_s())
        if self._gripper.status().holding:
            raise RefusedError("HOLDING", "A piece is held: it is let go by a release only.")
        return self._gripper.open_to(width_mm, speed_mm_s)

    def open_by_hand(self, width_mm: float, speed_mm_s: float, *, confirmed: bool) -> Motion:
        """Open on the operator's own order; a held piece needs their confirmation."""
        self._interlock.require_motion(self._now_s())
        if self._gripper.status().holding and not confirmed:
            raise RefusedError("HOLDING", "A piece is held: opening drops it. Confirm first.")
        return self._gripper.open_to(width_mm, speed_mm_s)

    def release(self, evidence: ReleaseEvidence, width_mm: float, speed_mm_s: float) -> Motion:
        """Open on a held piece if every release condition holds; else ``RefusedError``."""
        self._interlock.require_motion(self._now_s())
        refusal = release_refusal(evidence, untested=self._interlock.untested_release)
        if refusal is not None:
            raise RefusedError(*refusal)
        return self._gripper.open_to(width_mm, speed_mm_s)

    def put_back(self, evidence: JigEvidence, width_mm: float, speed_mm_s: float) -> Motion:
        """Open on a held piece that is back in its jig; else ``RefusedError``."""
        self._interlock.require_motion(self._now_s())
        refusal = jig_refusal(evidence)
        if refusal is not None:
            raise RefusedError(*refusal)
        return self._gripper.open_to(width_mm, speed_mm_s)

    def stop(self) -> None:
        """Latch the interlock and stop; the grip is kept."""
        self._interlock.stop()

"""Arm and gripper behind the interlock, the only ones that plans and windows use."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import astuple, replace
from typing import TypeVar

from touchdown.backend.core import (
    LEVEL_TOLERANCE_RAD,
    Pose,
    RefusedError,
    SampleStream,
    pose_rotation,
    require_unrotated,
    rotation_angle_rad,
)
from touchdown.backend.devices.interlock import (
    LEASE_S,
    AuthorisedGripper,
    ByHand,
    Interlock,
    JigEvidence,
    ReleaseAuthorisation,
    ReleaseEvidence,
    StagedOpening,
    distance_to_limit_mm,
    jig_refusal,
    refuse_forced,
    refuse_outside,
    refuse_place,
    refuse_turning,
    refuse_unknown,
    release_refusal,
    stop_jaws,
    turn_to_limit_rad,
    turned_descent_mm,
)
from touchdown.backend.devices.protocols import (
    STILL,
    TURN_RAD_S,
    Arm,
    ArmStatus,
    Device,
    DeviceState,
    Gripper,
    GripStatus,
    Health,
    Identity,
    Joints,
    Motion,
    PressCommand,
    PressMotion,
    RetreatingArm,
    RobotMode,
    Vector,
)

M = TypeVar("M", bound=Motion)
PressForce = Callable[[], float]  # present press force in N (tared Fz), NaN if unknown


class _Guarded:
    """Connection and identity, which need no guard: they move nothing."""

    def __init__(self, device: Device) -> None:
        self._device = device

    @property
    def name(self) -> str:
        return self._device.name

    @property
    def state(self) -> DeviceState:
        return self._device.state

    @property
    def identity(self) -> Identity | None:
        return self._device.identity

    @property
    def health(self) -> Health:
        return self._device.health

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        self._device.connect(timeout_s, cancel)

    def close(self) -> None:
        """Close the connection; the gripper keeps its grip."""
        self._device.close()

    def describe(self) -> Mapping[str, str | float]:
        return self._device.describe()


class GuardedArm(_Guarded):
    """An ``Arm`` that refuses commands beyond the limits; it never changes a command."""

    def __init__(
        self,
        arm: Arm,
        interlock: Interlock,
        now_s: Callable[[], float],
        press_n: PressForce,
        surface_mm: Callable[[], float] = lambda: math.nan,
    ) -> None:
        """``surface_mm`` is the height of ``G`` at which a held piece touches; NaN forbids
        turning.
        """
        super().__init__(arm)
        self._arm, self._interlock = arm, interlock
        self._now_s, self._surface_mm = now_s, surface_mm
        self.press_n: PressForce = press_n
        # Last motion, and its speed in mm/s and rad/s; infinite where the other limits it.
        self.commanded: Motion | None = None
        self.press_command: PressCommand | None = None  # of the last press
        self.commanded_speed: tuple[float, float] = (math.inf, math.inf)
        interlock.on_stop(arm.stop, arm.retreat if isinstance(arm, RetreatingArm) else None)

    @property
    def poses(self) -> SampleStream:
        """Measured positions of ``G``."""
        return self._arm.poses

    def status(self) -> ArmStatus:
        """Status words of the arm."""
        return self._arm.status()

    def servo(self, on: bool) -> None:
        """Switch the servo motors; off is always permitted, on only without a latch."""
        if on:
            self._interlock.refuse_latched()
        self._arm.servo(on)

    def _require_motion(self) -> None:
        self._interlock.require_motion(self._now_s())
        if self._interlock.staged is not None:
            raise RefusedError(
                "JAWS-LOOSE", "The jaws opened in stages: grip or open before the arm moves."
            )
        if self._arm.status().robot_mode is RobotMode.SERVO_OFF:
            raise RefusedError("SERVO-OFF", "The servo of the arm is off: switch it on first.")

    def pose(self, max_age_s: float) -> Pose:
        """Measured pose of ``G``."""
        return self._arm.pose(max_age_s)

    def move_to(self, target: Pose, speed_mm_s: float, turn_rad_s: float = TURN_RAD_S) -> Motion:
        """Move on a straight line to ``target``; refused outside the limits, and sideways while
        pressing. A turned hand must stay high above the surface on the way.
        """
        self._require_motion()
        limits = self._interlock.limits
        values = (*astuple(target), speed_mm_s, turn_rad_s)
        if not all(math.isfinite(value) for value in values):
            raise RefusedError("NOT-FINITE", "The target or the speed is not a finite number.")
        if not 0 < speed_mm_s <= limits.speed_mm_s:
            raise _speed_refusal(speed_mm_s, limits.speed_mm_s, " mm/s")
        refuse_outside(target, limits)
        self._refuse_dragging(target)
        turning = self._refuse_turned_move(target, turn_rad_s)
        override = self._interlock.override
        speed_mm_s, turn_rad_s = speed_mm_s * override, turn_rad_s * override
        if turning:
            motion = self._arm.move_to(target, speed_mm_s, turn_rad_s)
            return self._command(motion, speed_mm_s, turn_rad_s)
        return self._command(self._arm.move_to(target, speed_mm_s), speed_mm_s)

    def jog(self, velocity_mm_s: Vector, for_s: float, turn_rad_s: Vector = STILL) -> Motion:
        """Move at a velocity; refused if too fast, too long, outside the limits, or against a
        force.
        """
        self._require_motion()
        self._refuse_too_long(for_s)
        limits, here = self._interlock.limits, self._arm.pose(max_age_s=0.2)
        speed, turning = math.hypot(*velocity_mm_s), math.hypot(*turn_rad_s)
        if not (0 < speed <= limits.jog_mm_s or (speed == 0 and turning > 0)):
            raise _speed_refusal(speed, limits.jog_mm_s, " mm/s")
        if speed:
            x, y, z = (part / speed for part in velocity_mm_s)
            way = (x, y, z)
            lock = self._interlock
            recovering, degraded = lock.recovering, lock.degraded
            refuse_forced(self.press_n(), way, limits, recovering=recovering, degraded=degraded)
            left_mm = distance_to_limit_mm(here, way, limits)
            if z < 0:
                left_mm = min(left_mm, turned_descent_mm(here, self._surface_mm(), limits) / -z)
            if not left_mm > 0:
                raise RefusedError("LIMIT", "The arm is at the edge of its workspace.")
        if not turning:
            return self._command(self._arm.jog(velocity_mm_s, for_s), speed)
        self._refuse_turning_jog(here, turning)
        rx, ry, rz = (part / turning for part in turn_rad_s)
        if not turn_to_limit_rad(here, (rx, ry, rz), limits) > 0:
            raise RefusedError("LIMIT", "The tilt of the hand is at its limit.")
        motion = self._arm.jog(velocity_mm_s, for_s, turn_rad_s)
        return self._command(motion, speed or math.inf, turning)

    # -- joints -----------------------------------------------------------------------------------

    @property
    def rotates(self) -> bool:
        """True if the hand can turn and single joints can be driven."""
        return self._arm.rotates

    def joints_rad(self, max_age_s: float) -> Joints:
        """Measured joints."""
        return self._arm.joints_rad(max_age_s)

    @property
    def joint_limits_rad(self) -> tuple[tuple[float, float], ...]:
        """Lowest and highest angle of each joint, rad."""
        return self._arm.joint_limits_rad

    def place_of(self, joints_rad: Joints) -> Pose:
        """Pose of the hand at these joints."""
        return self._arm.place_of(joints_rad)

    def jog_joints(self, speeds_rad_s: Joints, for_s: float) -> Motion:
        """Turn joints; refused unless the hand is free, high, and inside the limits."""
        self._require_motion()
        self._refuse_too_long(for_s)
        here = self._arm.pose(max_age_s=0.2)
        self._refuse_turning_jog(here, max(map(abs, speeds_rad_s)))
        now = self._arm.joints_rad(max_age_s=0.2)
        ahead = tuple(j + v * for_s for j, v in zip(now, speeds_rad_s, strict=True))
        there = self._arm.place_of(ahead)
        refuse_place(there, self._surface_mm(), self._interlock.limits)
        self._refuse_too_fast(here, there, for_s)
        motion = self._arm.jog_joints(speeds_rad_s, for_s)
        return self._command(motion, speed_rad_s=max(map(abs, speeds_rad_s)))

    def move_joints(self, target_rad: Joints, speed_rad_s: float) -> Motion:
        """Turn joints to ``target_rad``; refused unless the path stays inside the limits."""
        self._require_motion()
        here, now = self._arm.pose(max_age_s=0.2), self._arm.joints_rad(max_age_s=0.2)
        self._refuse_turning_jog(here, speed_rad_s)
        longest = max(abs(b - a) for a, b in zip(now, target_rad, strict=True))
        for part in (0.25, 0.5, 0.75, 1.0):
            between = tuple(a + part * (b - a) for a, b in zip(now, target_rad, strict=True))
            there = self._arm.place_of(between)
            refuse_place(there, self._surface_mm(), self._interlock.limits)
            self._refuse_too_fast(here, there, part * longest / speed_rad_s)
        speed_rad_s *= self._interlock.override
        motion = self._arm.move_joints(target_rad, speed_rad_s)
        return self._command(motion, speed_rad_s=speed_rad_s)

    def halt(self) -> None:
        """Stand still without a latch, at the end of a jog."""
        self._arm.halt()

    def press(self, command: PressCommand) -> PressMotion:
        """Press; refused if the nominal force exceeds the limit or the approach is too fast."""
        self._require_motion()
        limits = self._interlock.limits
        if not command.nominal_n <= limits.probe_n:
            what = f"Nominal {command.nominal_n:.1f} N exceeds {limits.probe_n:.0f} N."
            raise RefusedError("PRESS-FORCE", what)
        if not 0 < command.approach_mm_s <= limits.contact_speed_mm_s:
            raise RefusedError(
                "APPROACH-SPEED",
                f"{command.approach_mm_s:.1f} mm/s exceeds {limits.contact_speed_mm_s:.1f} mm/s.",
            )
        require_unrotated(pose_rotation(self._arm.pose(max_age_s=0.2)))
        self.press_command = command
        return self._command(self._arm.press(command), command.approach_mm_s)

    def unload(self, force_n: float, speed_mm_s: float) -> Motion:
        """Lift to the press force ``force_n``."""
        self._require_motion()
        return self._command(self._arm.unload(force_n, speed_mm_s), speed_mm_s)

    def stop(self) -> None:
        """Latch the interlock and stop."""
        self._interlock.stop()

    def _command(self, motion: M, speed_mm_s: float = math.inf, speed_rad_s: float = math.inf) -> M:
        self.commanded, self.commanded_speed = motion, (speed_mm_s, speed_rad_s)
        return motion

    def _refuse_too_long(self, for_s: float) -> None:
        if not 0 < for_s <= LEASE_S:
            raise RefusedError("JOG-TIME", f"{for_s:.2f} s is not within 0 to {LEASE_S:.2f} s.")

    def _refuse_turned_move(self, target: Pose, turn_rad_s: float) -> bool:
        """Return True if the hand turns on the way; raise ``RefusedError`` if it must not."""
        here = self._arm.pose(max_age_s=0.2)
        if max(rotation_angle_rad(here), rotation_angle_rad(target)) <= LEVEL_TOLERANCE_RAD:
            return False
        self._refuse_turning_jog(here, turn_rad_s)
        low = replace(target, z_mm=min(here.z_mm, target.z_mm))
        refuse_turning(low, self._surface_mm(), 0.0, self._interlock.limits)
        refuse_place(target, self._surface_mm(), self._interlock.limits)
        return True

    def _refuse_turning_jog(self, here: Pose, speed_rad_s: float) -> None:
        interlock = self._interlock
        most = interlock.limits.turn_rad_s
        if not 0 < speed_rad_s <= most * (1 + 1e-9):
            raise _speed_refusal(math.degrees(speed_rad_s), math.degrees(most), "\N{DEGREE SIGN}/s")
        if interlock.recovering:
            raise RefusedError("RECOVERY", "After a fault: jog away from contact first.")
        refuse_turning(here, self._surface_mm(), self.press_n(), interlock.limits)

    def _refuse_too_fast(self, here: Pose, there: Pose, time_s: float) -> None:
        gone_mm = math.dist(astuple(here)[:3], astuple(there)[:3])
        most = self._interlock.limits.jog_mm_s
        if not gone_mm <= most * time_s + 1e-6:
            raise RefusedError(
                "SPEED",
                f"The hand would move with {gone_mm / time_s:.0f} mm/s: slow the joint down.",
            )

    def _refuse_dragging(self, target: Pose) -> None:
        here = self._arm.pose(max_age_s=0.2)
        sideways = math.hypot(target.x_mm - here.x_mm, target.y_mm - here.y_mm)
        force = self.press_n()
        if sideways > 0.05 and not abs(force) <= self._interlock.limits.contact_n:
            refuse_unknown(force)
            raise RefusedError(
                "DRAGGING", f"Lift first: {force:.1f} N press on the support while moving sideways."
            )


def _speed_refusal(speed: float, most: float, unit: str) -> RefusedError:
    return RefusedError("SPEED", f"{speed:.1f}{unit} is not within 0 to {most:.0f}{unit}.")


class GuardedGripper(_Guarded):
    """A ``Gripper`` that opens on a held piece only with the evidence of a stable placement."""

    def __init__(self, gripper: Gripper, interlock: Interlock, now_s: Callable[[], float]) -> None:
        super().__init__(gripper)
        self._gripper, self._interlock, self._now_s = gripper, interlock, now_s
        self.grips: int = 0
        self.letting_go: bool = False
        self._closing: Motion | None = None  # of loosened jaws
        self._stopping = threading.RLock()
        interlock.on_stop(self._stop_jaws)

    def status(self) -> GripStatus:
        """Present width, force and whether a piece is held."""
        return self._gripper.status()

    def grip(self, force_n: float) -> Motion:
        """Grip with ``force_n`` per finger. A stop does not interrupt the grip of loosened jaws."""
        self._interlock.require_motion(self._now_s())
        self.grips, self.letting_go = self.grips + 1, False
        gripping = self._gripper.grip(force_n)
        if self._interlock.staged is not None:
            self._closing, self._interlock.staged = gripping, None
        return gripping

    def open_to(self, width_mm: float, speed_mm_s: float) -> Motion:
        """Open while nothing is held; refused while a piece is held (see ``release``)."""
        self._interlock.require_motion(self._now_s())
        if self._gripper.status().holding:
            raise RefusedError("HOLDING", "A piece is held: the gripper opens only for a release.")
        opening = self._gripper.open_to(width_mm, speed_mm_s)
        self._interlock.staged = None
        return opening

    def open_step(
        self,
        evidence: ReleaseEvidence | None,
        width_mm: float,
        speed_mm_s: float,
        *,
        force_n: float,
        moved_mm: float,
    ) -> Motion:
        """Open by one step of an opening in stages; the first one needs the release conditions.

        From then on STOP and faults close the jaws with ``force_n`` a finger, until they grip or
        open at once. ``moved_mm``: largest travel of the standing arm.
        """
        lock, now_s = self._interlock, self._now_s()
        lock.require_motion(now_s)
        staged = lock.staged
        if evidence is not None:
            refusal = release_refusal(evidence, untested=lock.untested_release)
            if refusal is not None:
                raise RefusedError(*refusal)
            staged = StagedOpening(self.status().width_mm, force_n)
        if staged is None:
            raise RefusedError("NOT-STAGED", "No opening in stages is in progress.")
        staged.take_step(width_mm, now_s, moved_mm)
        if isinstance(self._gripper, AuthorisedGripper):
            opening = self._gripper.open_step(evidence, width_mm, speed_mm_s, force_n)
        else:
            opening = self._gripper.open_to(width_mm, speed_mm_s)
        lock.staged, self.letting_go = staged, True
        if lock.latched:
            self._stop_jaws()  # a stop that came meanwhile did not close them
        return opening

    def open_by_hand(self, width_mm: float, speed_mm_s: float, *, confirmed: bool) -> Motion:
        """Open on the operator's command; a held piece needs a confirmation."""
        self._interlock.require_motion(self._now_s())
        if self._gripper.status().holding and not confirmed:
            raise RefusedError("HOLDING", "A piece is held: opening drops it. Confirm first.")
        return self._open(ByHand(confirmed=confirmed), width_mm, speed_mm_s)

    def release(self, evidence: ReleaseEvidence, width_mm: float, speed_mm_s: float) -> Motion:
        """Open on a held piece if every release condition holds; else ``RefusedError``."""
        self._interlock.require_motion(self._now_s())
        refusal = release_refusal(evidence, untested=self._interlock.untested_release)
        if refusal is not None:
            raise RefusedError(*refusal)
        return self._open(evidence, width_mm, speed_mm_s)

    def put_back(self, evidence: JigEvidence, width_mm: float, speed_mm_s: float) -> Motion:
        """Open on a held piece that is back in its jig; else ``RefusedError``."""
        self._interlock.require_motion(self._now_s())
        refusal = jig_refusal(evidence)
        if refusal is not None:
            raise RefusedError(*refusal)
        return self._open(evidence, width_mm, speed_mm_s)

    def _open(self, right: ReleaseAuthorisation, width_mm: float, speed_mm_s: float) -> Motion:
        """Open with the authorisation ``right``; the rig checks it once more."""
        if isinstance(self._gripper, AuthorisedGripper) and self._gripper.status().holding:
            opening = self._gripper.open_held(right, width_mm, speed_mm_s)
        else:
            opening = self._gripper.open_to(width_mm, speed_mm_s)
        self._interlock.staged, self.letting_go = None, True
        return opening

    def stop(self) -> None:
        """Latch the interlock and stop; the grip is kept, loosened jaws close."""
        self._interlock.stop()

    def _stop_jaws(self) -> None:
        with self._stopping:
            staged, self._interlock.staged = self._interlock.staged, None
            if staged is not None:
                self.grips, self.letting_go = self.grips + 1, False
            # A gripper with a rig of its own closes there.
            there = isinstance(self._gripper, AuthorisedGripper)
            self._closing = stop_jaws(self._gripper, None if there else staged, self._closing)

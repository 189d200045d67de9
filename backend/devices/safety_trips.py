"""Safety trips while the bench moves: too much force or moment, a stalled arm, a lost piece.

``Supervision`` also checks the sensors; it is called once per advance of the bench, with the bench
clock. Limits come from the interlock. At too much force the arm draws back from the contact, after
the other faults it stops.

Jaws that stop holding without a command have lost their piece; jaws that move while they hold, or
whose force falls, are losing it. A width that is not finite or impossible is ignored.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import astuple
from typing import Protocol, runtime_checkable

import numpy as np

from touchdown.backend import core
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import Device, DeviceState, Gripper
from touchdown.backend.devices.sensor_faults import (
    LATE_SHARE,
    MOTION_STOPPED,
    DegradedDevice,
    PictureMonitor,
    RateMonitor,
    ReportsSlowness,
    stale_fault,
)

MOVED_MM = 0.3  # permitted change of the width while a piece is held
# The grip is weak if the force is below this share of the grip's force for this time.
WEAK_SHARE, WEAK_S = 0.5, 0.1
STANDS_S = 0.3  # settling time of the jaws on the gels after a grip
LEAST_MM, MOST_MM = -1.0, 1000.0  # possible widths


@runtime_checkable
class ReportsGripCommands(Protocol):
    """A gripper that reports its commands: number of grips, and opening since the last one."""

    grips: int
    letting_go: bool


class GripMonitor:
    """Monitor of a gripper while it holds a piece."""

    def __init__(self, gripper: Gripper | None = None) -> None:
        self._gripper = gripper
        # Checked once: it takes as long as the rest of a step.
        asked: object = gripper
        self._ordered = asked if isinstance(asked, ReportsGripCommands) else None
        self._grips = 0
        self._since_s: float | None = None
        self._width_mm = self._force_n = 0.0
        self._weak_s: float | None = None
        self.seen_s = float("-inf")  # time of the last valid width

    @property
    def holds(self) -> bool:
        """True if a piece was held at the last reading."""
        return self._since_s is not None

    def check(self, now_s: float) -> core.Fault | None:
        """Return the fault of a lost piece, once; otherwise None."""
        gripper = self._gripper
        if gripper is None:
            return None
        status = gripper.status()
        told = LEAST_MM <= status.width_mm <= MOST_MM
        self.seen_s = now_s if told else self.seen_s
        if gripper.state is not DeviceState.READY:
            self._since_s = None
            return None
        if self._may_leave() or not told:
            return None
        if self._since_s is None:
            self._since_s = now_s if status.holding else None
            self._width_mm = status.width_mm
            return None
        if not status.holding:
            self._since_s = None
            return _lost_fault("The gripper no longer holds a piece, and no command opened it.")
        if now_s - self._since_s <= STANDS_S:
            self._width_mm, self._force_n, self._weak_s = status.width_mm, status.force_n, None
            return None
        if self._weak(status.force_n, now_s):
            self._since_s = None
            return _lost_fault(
                f"The grip force fell from {self._force_n:.1f} to {status.force_n:.1f} N."
            )
        moved_mm = status.width_mm - self._width_mm
        if not abs(moved_mm) <= MOVED_MM:
            self._since_s = None
            return _lost_fault(f"The jaws moved by {moved_mm:+.1f} mm while they held the piece.")
        return None

    def _weak(self, force_n: float, now_s: float) -> bool:
        """Return True if the grip has been weak for too long; NaN is ignored."""
        if force_n < WEAK_SHARE * self._force_n:
            self._weak_s = now_s if self._weak_s is None else self._weak_s
        elif force_n >= WEAK_SHARE * self._force_n:
            self._weak_s = None
        return self._weak_s is not None and now_s - self._weak_s >= WEAK_S - 1e-6

    def _may_leave(self) -> bool:
        """Return True if the piece may leave now. A newer grip restarts the monitoring."""
        ordered = self._ordered
        if ordered is None:
            return False
        if ordered.letting_go or ordered.grips != self._grips:
            # A newer grip may close further; a released piece may leave.
            self._since_s = None
        self._grips = ordered.grips
        return ordered.letting_go


def _lost_fault(what: str) -> core.Fault:
    return core.Fault(
        "PIECE-LOST",
        what,
        "Motion stopped; the probe in progress is void; the gripper was not opened.",
        "Take the piece out or grip it again by hand, then press Reset.",
        "gripper",
    )


# An arm is stalled if, for this time in which it has to move, neither its position nor the press
# force changes by this, and if this share of the commanded way is more than that.
STALLED_S, STALLED_MM, STALLED_RAD, STALLED_N = 1.0, 0.05, 1e-3, 0.3
STALLED_SHARE = 0.25
CHECKED_S = 0.1  # longest time between two checks that counts
LEAST_MOTION = (STALLED_MM, STALLED_RAD, STALLED_N)


class StallMonitor:
    """Monitor of an arm while a motion is under way; a press may stand while it holds."""

    def __init__(self, arm: GuardedArm | None) -> None:
        self._arm = arm
        self._checked_s = 0.0
        self._begin(np.zeros(7))

    def _begin(self, place: core.FloatArray) -> None:
        # Position and press force, how long they stand, and the commanded way in least motions.
        self._place, self._stood_s, self._way, self._told = place, 0.0, 0.0, False

    def check(self, now_s: float) -> core.Fault | None:
        """Return the fault of an arm that does not move, once; otherwise None."""
        arm, passed_s, self._checked_s = self._arm, now_s - self._checked_s, now_s
        # While this process did not run, it commanded no motion either.
        passed_s = min(passed_s, CHECKED_S)
        motion = None if arm is None else arm.commanded
        if arm is None or motion is None or motion.done:
            self._begin(self._place)
            return None
        onset_s = getattr(motion, "onset_s", None)
        try:
            place = np.array([*astuple(arm.pose(STALLED_S)), arm.press_n()])
        except (core.StaleSampleError, core.FaultError):
            return None  # a silent arm has a fault of its own
        away = place - self._place
        sizes = (np.linalg.norm(away[:3]), np.linalg.norm(away[3:6]), abs(away[6]))
        if any(size > least for size, least in zip(sizes, LEAST_MOTION, strict=True)):
            self._begin(place)
        per_s = _commanded(arm, now_s, onset_s, getattr(motion, "detected_s", None))
        self._stood_s += passed_s if per_s else 0.0
        self._way += passed_s * per_s
        if self._told or self._stood_s <= STALLED_S or self._way <= 1.0 / STALLED_SHARE:
            return None
        self._told = True
        return core.Fault(
            "ARM-STALLED",
            f"The arm has not moved for {self._stood_s:.1f} s although a motion is under way.",
            MOTION_STOPPED,
            "Look for an obstacle and at the controller of the arm; then press Reset.",
            "arm",
        )


def _commanded(
    arm: GuardedArm, now_s: float, onset_s: float | None, detected_s: float | None
) -> float:
    """Return the speed at which the arm has to move now, as least motions per second."""
    speed_mm_s, speed_rad_s = arm.commanded_speed
    if onset_s is None:
        return min(speed_mm_s / STALLED_MM, speed_rad_s / STALLED_RAD)
    press = arm.press_command
    if press is None or now_s >= onset_s + press.hold_s:
        return 1.0 / (STALLED_SHARE * STALLED_S)  # it should have ended
    if now_s >= onset_s + press.ramp_s:
        return 0.0
    ramp_mm_s = press.depth_mm / press.ramp_s
    passed_mm = speed_mm_s * ((detected_s or now_s) - onset_s)
    if ramp_mm_s * (now_s - onset_s) <= passed_mm:
        return 0.0  # it stands where the descent ended until the ramp reaches it
    return ramp_mm_s * min(1.0 / STALLED_MM, press.stiffness_n_mm[2] / STALLED_N)


# Time without a reading after which a gripper with a piece is late, and after which it is a fault.
GRIP_LATE_S, GRIP_LOST_S = 0.3, 1.0
ARM_LOST_S = 1.0  # the same for the positions of an arm that may be moved
ARM_LATE_S = 0.2  # time without a position after which other faults name the arm as well
GRACE_S = 1.0  # time for the first samples after the start of a scene


class Supervision:
    """Supervision of the tared wrench, both cameras, and the gripper while it holds a piece."""

    def __init__(
        self,
        interlock: Interlock,
        wrench: core.SampleStream,
        frames: Mapping[core.Finger, core.Stream[core.TactileFrame]],
    ) -> None:
        self._interlock, self._wrench, self._frames = interlock, wrench, frames
        self._rates = {device: RateMonitor() for device in LATE_SHARE}
        self._now_s = 0.0
        # Devices that are late or slow; readable from any thread.
        self.degraded: tuple[DegradedDevice, ...] = ()
        self.begin(0.0)

    def begin(
        self,
        now_s: float,
        gripper: Gripper | None = None,
        wrist: Device | None = None,
        arm: GuardedArm | None = None,
    ) -> None:
        """Restart for a new scene. ``gripper`` is monitored while it holds a piece; ``wrist``
        reports its usual rate as the field ``usual_hz``; ``arm`` is monitored while it moves or
        may be moved.
        """
        self._gripper, self._wrist, self._arm = gripper, wrist, arm
        # Tested once, since the test of a protocol is slow.
        device: object = wrist
        self._pace = device if isinstance(device, ReportsSlowness) else None
        self._stall = StallMonitor(arm)
        self._grip = GripMonitor(gripper)
        self._begun_s = self._finite_s = now_s
        self._cursor = self._wrench.count
        self._pictures = [PictureMonitor(finger, self._frames[finger]) for finger in core.FINGERS]
        self._counts = {finger: self._frames[finger].count for finger in core.FINGERS}
        for rate in self._rates.values():
            rate.begin()
        self._show((), now_s)

    def check(self, now_s: float) -> None:
        """Raise (latch) a fault if a sensor is silent, frozen, not finite, or over its limit."""
        self._now_s = now_s
        samples = self._wrench.since(self._cursor)
        self._cursor = samples.cursor
        if len(samples.t_s):
            finite = np.isfinite(samples.values).all(axis=1)
            if finite.any():
                self._finite_s = float(samples.t_s[finite][-1])
                count = int(np.count_nonzero(finite))
                self._rates["force_torque"].note(self._finite_s, count, self._usual_hz)
                self._check_trip(samples.values[finite])
        pictures = (monitor.check() for monitor in self._pictures)
        for fault in (*pictures, self._grip.check(now_s), self._stall.check(now_s)):
            if fault is not None:
                self._interlock.raise_fault(fault)
        if now_s - self._begun_s < GRACE_S:
            return
        self._check_ages(now_s)

    def _usual_hz(self) -> float:
        """Return the rate that the wrist sensor reports, 0 if none."""
        told = 0.0 if self._wrist is None else self._wrist.describe().get("usual_hz", 0.0)
        return told if isinstance(told, float) and math.isfinite(told) else 0.0

    def unwell(self) -> core.Fault | None:
        """Return the fault of a run that pauses for a degraded device, None without one."""
        for one in self.degraded:
            return core.Fault(
                "DEGRADED",
                one.what(self._now_s),
                "The run is paused, the arm stands lifted; every probe so far is safe.",
                "Check the device and its cable; resume (P) once the state is no longer DEGRADED.",
                one.device,
            )
        return None

    def _check_trip(self, wrench: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
        limits = self._interlock.limits
        force = np.linalg.norm(wrench[:, :3], axis=1)
        moment = np.linalg.norm(wrench[:, 3:], axis=1)
        over = (force > limits.trip_n) | (moment > limits.trip_nm)
        twice = bool((over[:-1] & over[1:]).any())
        if twice or bool((force > limits.trip_at_once_n).any()):
            self._interlock.raise_fault(
                core.Fault(
                    "FT-TRIP",
                    f"Force trip: {force.max():.1f} N, {moment.max():.2f} N·m "
                    f"(limits {limits.trip_n:.0f} N, {limits.trip_nm:.1f} N·m).",
                    "The arm draws back by 2 mm; the gripper was not opened.",
                    "Check the piece and the support, then press Reset.",
                    "force_torque",
                )
            )

    def _check_ages(self, now_s: float) -> None:
        limits, late, stale = self._interlock.limits, list[DegradedDevice](), list[core.Fault]()
        # A camera that reports why its pictures are rejected is silent for the same reason.
        explained = {fault.device for fault in self._interlock.faults} - {"force_torque"}
        ages = [("force_torque", self._finite_s, limits.wrench_age_s)]
        for finger in core.FINGERS:
            newest = self._frames[finger].newest()
            last_s = self._begun_s if newest is None else max(self._begun_s, newest.t_s)
            ages.append((f"tactile_{finger}", last_s, limits.frame_age_s))
            if newest is not None:
                seen, self._counts[finger] = self._counts[finger], self._frames[finger].count
                self._rates[f"tactile_{finger}"].note(newest.t_s, self._counts[finger] - seen)
        for device, last_s, limit_s in ages:
            slow_s = self._rates[device].slow_since_s
            if device == "force_torque" and self._pace is not None:
                slow_s = slow_s if self._pace.slow_since_s is None else self._pace.slow_since_s
            if slow_s is not None:
                late.append(DegradedDevice(device, "slow", slow_s))
            elif now_s - last_s > LATE_SHARE[device] * limit_s:
                late.append(DegradedDevice(device, "silent", last_s))
            if now_s - last_s > limit_s and device not in explained:
                stale.append(stale_fault(device, now_s - last_s))
        for fault, one in self._check_grip(now_s):
            stale.extend(filter(None, (fault,)))
            late.append(one)
        stale.extend(self._check_arm(now_s, explained))
        self._show(tuple(late), now_s)
        for fault in stale:
            self._interlock.raise_fault(fault)

    def _check_grip(self, now_s: float) -> Iterator[tuple[core.Fault | None, DegradedDevice]]:
        """Yield the gripper if it holds a piece and is late, with its fault if it stays silent. A
        gripper without a valid width counts as silent.
        """
        gripper = self._gripper
        if gripper is None or not (self._grip.holds or gripper.status().holding):
            return
        last_s = max(self._begun_s, min(now_s - gripper.health.age_s, self._grip.seen_s))
        if now_s - last_s > GRIP_LATE_S:
            lost = now_s - last_s > GRIP_LOST_S
            fault = stale_fault("gripper", now_s - last_s) if lost else None
            yield fault, DegradedDevice("gripper", "silent", last_s)

    def _check_arm(self, now_s: float, explained: Collection[str]) -> Iterator[core.Fault]:
        """Yield the fault of an arm that may be moved and has reported no position for a while."""
        if self._arm is None or "arm" in explained or not self._interlock.has_lease(now_s):
            return
        try:
            self._arm.pose(ARM_LOST_S)
        except core.StaleSampleError:
            yield stale_fault("arm", ARM_LOST_S)
        except core.FaultError:
            return  # the link to the arm has reported why

    def _show(self, late: tuple[DegradedDevice, ...], now_s: float) -> None:
        self.degraded = late
        self._interlock.degraded = late[0].what(now_s) if late else ""
        named = (*late, *self._silent_arm(now_s))
        self._interlock.late = {one.device: one.what(now_s) for one in named}

    def _silent_arm(self, now_s: float) -> Iterator[DegradedDevice]:
        """Yield the arm if it is silent: a fault of another device names it as well."""
        if self._arm is None:
            return
        poses = self._arm.poses
        for last_s in poses.since(poses.count - 1).t_s.tolist():
            if now_s - last_s > ARM_LATE_S:
                yield DegradedDevice("arm", "silent", last_s)

"""Watches the sensors while the bench moves: a silent or raving sensor ends motion with a fault.

Called once per advance of the bench, with the bench clock. Limits come from the interlock
(reliability sections 3.3, 4.7 and 6). On the way to a fault a device is ``degraded``, and by hand
the arm then only moves away from contact. A gripper is watched as long as it holds a piece.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from backend.core.faults import Fault
from backend.core.flow import FINGERS, Finger, ImageArray, TactileFrame
from backend.core.stream import SampleStream, Stream
from backend.devices.arrivals import TellsSlow
from backend.devices.degraded import (
    GRIP_LATE_S,
    GRIP_LOST_S,
    LATE_SHARE,
    NAMES,
    Degraded,
    Rate,
    pause_fault,
)
from backend.devices.grip_watch import GripWatch
from backend.devices.interlock import Interlock
from backend.devices.protocols import Device, Gripper

GRACE_S = 1.0
"""After a scene begins the sensors get this long to deliver their first samples."""
EQUAL = 3
"""So many equal pictures in a row are a camera that froze: a live one has noise (C3)."""
_KEPT = "Motion stopped; the gripper was not opened."
_LOOK = "Check the device and its cable, then press Reset."


class Supervision:
    """One watch over the tared wrench, both cameras, and the gripper that holds a piece."""

    def __init__(
        self,
        interlock: Interlock,
        wrench: SampleStream,
        frames: Mapping[Finger, Stream[TactileFrame]],
    ) -> None:
        self._interlock, self._wrench, self._frames = interlock, wrench, frames
        self._cursor = wrench.count
        self._begun_s = 0.0
        self._finite_s = 0.0
        self._repeats = {finger: _Repeats(frames[finger]) for finger in FINGERS}
        self._rates = {device: Rate() for device in LATE_SHARE}
        self._counts = {finger: frames[finger].count for finger in FINGERS}
        self._wrist: Device | None = None
        self._gripper: Gripper | None = None
        self._grip = GripWatch()
        self.degraded: tuple[Degraded, ...] = ()
        """Devices that are late or slow now; for any thread."""
        self._now_s = 0.0

    def begin(
        self, now_s: float, gripper: Gripper | None = None, wrist: Device | None = None
    ) -> None:
        """Count ages from here: a new scene began.

        ``gripper`` is watched while it holds a piece; ``wrist`` tells its usual rate as the field
        ``usual_hz``.
        """
        self._gripper, self._wrist = gripper, wrist
        self._grip = GripWatch(gripper)
        self._begun_s = self._finite_s = now_s
        self._cursor = self._wrench.count
        self._repeats = {finger: _Repeats(self._frames[finger]) for finger in FINGERS}
        self._counts = {finger: self._frames[finger].count for finger in FINGERS}
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
        self._check_frozen()
        if (lost := self._grip.check(now_s)) is not None:
            self._interlock.raise_fault(lost)
        if now_s - self._begun_s < GRACE_S:
            return
        self._check_ages(now_s)

    def _usual_hz(self) -> float:
        """Return the rate that the wrist sensor tells of itself; 0 where it tells none."""
        told = 0.0 if self._wrist is None else self._wrist.describe().get("usual_hz", 0.0)
        return told if isinstance(told, float) and math.isfinite(told) else 0.0

    def unwell(self) -> Fault | None:
        """Return what to say of a run that pauses for a degraded device; None if all are well."""
        return next((pause_fault(one, self._now_s) for one in self.degraded), None)

    def _check_trip(self, wrench: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> None:
        limits = self._interlock.limits
        force = np.linalg.norm(wrench[:, :3], axis=1)
        moment = np.linalg.norm(wrench[:, 3:], axis=1)
        over = (force > limits.trip_n) | (moment > limits.trip_nm)
        twice = bool((over[:-1] & over[1:]).any())
        if twice or bool((force > limits.trip_at_once_n).any()):
            self._interlock.raise_fault(
                Fault(
                    "FT-TRIP",
                    f"Force trip: {force.max():.1f} N, {moment.max():.2f} N·m "
                    f"(limits {limits.trip_n:.0f} N, {limits.trip_nm:.1f} N·m).",
                    "The arm draws back by 2 mm; the gripper was not opened.",
                    "Check the piece and the support, then press Reset.",
                    "force_torque",
                )
            )

    def _check_frozen(self) -> None:
        for finger, repeats in self._repeats.items():
            if repeats.longest() >= EQUAL:
                self._interlock.raise_fault(
                    Fault(
                        "CAMERA-FROZEN",
                        f"The {finger} tactile camera delivers the same picture again and again.",
                        _KEPT,
                        _LOOK,
                        f"tactile_{finger}",
                    )
                )

    def _is_explained(self, device: str) -> bool:
        """Whether a camera has told why no picture of it is used: silence is no second cause."""
        told = {fault.device for fault in self._interlock.faults}
        return device.startswith("tactile_") and device in told

    def _check_ages(self, now_s: float) -> None:
        limits, late = self._interlock.limits, list[Degraded]()
        ages = [("force_torque", self._finite_s, limits.wrench_age_s)]
        for finger in FINGERS:
            newest = self._frames[finger].newest()
            last_s = self._begun_s if newest is None else max(self._begun_s, newest.t_s)
            ages.append((f"tactile_{finger}", last_s, limits.frame_age_s))
            if newest is not None:
                seen, self._counts[finger] = self._counts[finger], self._frames[finger].count
                self._rates[f"tactile_{finger}"].note(newest.t_s, self._counts[finger] - seen)
        for device, last_s, limit_s in ages:
            slow_s = self._rates[device].slow_since_s
            if device == "force_torque" and isinstance(self._wrist, TellsSlow):
                slow_s = slow_s if self._wrist.slow_since_s is None else self._wrist.slow_since_s
            if slow_s is not None:
                late.append(Degraded(device, "slow", slow_s))
            elif now_s - last_s > LATE_SHARE[device] * limit_s:
                late.append(Degraded(device, "silent", last_s))
            if now_s - last_s > limit_s and not self._is_explained(device):
                self._interlock.raise_fault(_stale(device, now_s - last_s))
        late.extend(self._check_grip(now_s))
        self._show(tuple(late), now_s)

    def _check_grip(self, now_s: float) -> list[Degraded]:
        """Return the gripper if it holds a piece and is late; a fault if it stays silent.

        One that tells no width is as good as silent.
        """
        gripper = self._gripper
        if gripper is None or not (self._grip.holds or gripper.status().holding):
            return []
        last_s = max(self._begun_s, min(now_s - gripper.health.age_s, self._grip.seen_s))
        if now_s - last_s > GRIP_LOST_S:
            self._interlock.raise_fault(_stale("gripper", now_s - last_s))
        return [Degraded("gripper", "silent", last_s)] if now_s - last_s > GRIP_LATE_S else []

    def _show(self, late: tuple[Degraded, ...], now_s: float) -> None:
        self.degraded = late
        self._interlock.degraded = late[0].what(now_s) if late else ""


def _stale(device: str, age_s: float) -> Fault:
    """Return the fault of a sensor whose newest valid sample is ``age_s`` old."""
    if device == "force_torque":
        what = f"No valid force/torque sample for {age_s:.1f} s."
        return Fault("FT-STALE", what, _KEPT, _LOOK, device)
    what = f"The {NAMES[device]} has been silent for {age_s:.1f} s."
    if device == "gripper":
        return Fault("GRIP-STALE", f"{what} It held a piece.", _KEPT, _LOOK, device)
    return Fault("CAMERA-STALE", what, _KEPT, _LOOK, device)


class _Repeats:
    """Counts equal pictures in a row of one camera."""

    def __init__(self, frames: Stream[TactileFrame]) -> None:
        self._frames, self._cursor = frames, frames.count
        self._last: ImageArray | None = None
        self._equal = 1

    def longest(self) -> int:
        """Return the longest row of equal pictures that ends in what came since the last call."""
        frames, self._cursor, _ = self._frames.since(self._cursor)
        longest = 0
        for frame in frames:
            alike = self._last is not None and _equal(self._last, frame.image)
            self._equal = self._equal + 1 if alike else 1
            self._last = frame.image
            longest = max(longest, self._equal)
        return longest


def _equal(one: ImageArray, other: ImageArray) -> bool:
    # A few points first: pictures of a live camera differ nearly everywhere.
    return np.array_equal(one[::32, ::32], other[::32, ::32]) and np.array_equal(one, other)

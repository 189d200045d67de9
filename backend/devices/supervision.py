"""Watches the sensors while the bench moves: a silent or raving sensor ends motion with a fault.

Called once per advance of the bench, with the bench clock. Limits come from the interlock
(reliability sections 3.3, 4.7 and 6). On the way to a fault a sensor is ``degraded``.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from backend.core.faults import Fault
from backend.core.flow import FINGERS, Finger, ImageArray, TactileFrame
from backend.core.stream import SampleStream, Stream
from backend.devices.degraded import LATE_SHARE, NAMES, Degraded, Rate, pause_fault
from backend.devices.interlock import Interlock

GRACE_S = 1.0
"""After a scene begins the sensors get this long to deliver their first samples."""
EQUAL = 3
"""So many equal pictures in a row are a camera that froze: a live one has noise (C3)."""
_KEPT = "Motion stopped; the gripper was not opened."
_LOOK = "Check the device and its cable, then press Reset."


class Supervision:
    """One watch over the tared wrench and both cameras."""

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
        self._rate = Rate()
        self.degraded: tuple[Degraded, ...] = ()
        """Sensors that are late or slow now; for any thread."""
        self._now_s = 0.0

    def begin(self, now_s: float) -> None:
        """Count ages from here: a new scene began."""
        self._begun_s = self._finite_s = now_s
        self._cursor = self._wrench.count
        self._repeats = {finger: _Repeats(self._frames[finger]) for finger in FINGERS}
        self._rate.begin()
        self.degraded = ()

    def check(self, now_s: float) -> None:
        """Raise (latch) a fault if a sensor is silent, frozen, not finite, or over its limit."""
        self._now_s = now_s
        samples = self._wrench.since(self._cursor)
        self._cursor = samples.cursor
        if len(samples.t_s):
            finite = np.isfinite(samples.values).all(axis=1)
            if finite.any():
                self._finite_s = float(samples.t_s[finite][-1])
                self._rate.note(self._finite_s, int(np.count_nonzero(finite)))
                self._check_trip(samples.values[finite])
        self._check_frozen()
        if now_s - self._begun_s < GRACE_S:
            return
        self._check_ages(now_s)

    def unwell(self) -> Fault | None:
        """Return what to say of a run that pauses for a degraded sensor; None if all are well."""
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

    def _check_ages(self, now_s: float) -> None:
        limits, late = self._interlock.limits, list[Degraded]()
        ages = [("force_torque", self._finite_s, limits.wrench_age_s)]
        for finger in FINGERS:
            newest = self._frames[finger].newest()
            last_s = self._begun_s if newest is None else max(self._begun_s, newest.t_s)
            ages.append((f"tactile_{finger}", last_s, limits.frame_age_s))
        for device, last_s, limit_s in ages:
            if now_s - last_s > LATE_SHARE[device] * limit_s:
                late.append(Degraded(device, "silent", last_s))
            if now_s - last_s > limit_s:
                self._interlock.raise_fault(_stale(device, now_s - last_s))
        slow_s = self._rate.slow_since_s
        if slow_s is not None and not any(one.device == "force_torque" for one in late):
            late.append(Degraded("force_torque", "slow", slow_s))
        self.degraded = tuple(late)


def _stale(device: str, age_s: float) -> Fault:
    """Return the fault of a sensor whose newest valid sample is ``age_s`` old."""
    if device == "force_torque":
        what = f"No valid force/torque sample for {age_s:.1f} s."
        return Fault("FT-STALE", what, _KEPT, _LOOK, device)
    what = f"The {NAMES[device]} is silent for {age_s:.1f} s."
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

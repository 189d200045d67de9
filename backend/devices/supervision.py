"""Supervision of device data while the bench moves: silence, slow delivery, loss of the grip.

Called once per advance of the bench, with the bench clock; limits come from the interlock. A late
or slow device is degraded first: no new motion starts, and by hand the arm only moves away from
contact. Continued silence becomes a fault. The rate is measured between arrivals, never up to now,
so that a batch delayed by a busy computer does not count.

Jaws that stop holding without a command have lost their piece; jaws that move while they hold, or
whose force falls, are losing it. A width that is not finite or impossible is ignored.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass
from itertools import pairwise
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from touchdown.backend.core import (
    FINGERS,
    Fault,
    FaultError,
    Finger,
    ImageArray,
    RefusedError,
    SampleStream,
    StaleSampleError,
    Stream,
    TactileFrame,
)
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import Device, DeviceState, Gripper, Motion

# A device is late at this share of the age that is a fault: 100 of 300 ms, pictures 120 of 500 ms.
LATE_SHARE = {"force_torque": 1 / 3, "tactile_left": 0.24, "tactile_right": 0.24}
# Time without a reading after which a gripper with a piece is late, and after which it is a fault.
GRIP_LATE_S, GRIP_LOST_S = 0.3, 1.0
# A sensor is slow below this share of the usual rate, or of its best rate so far.
SLOW_RATE_SHARE = 0.5
RATE_WINDOW_S = 1.0
NAMES = {
    "force_torque": "wrist sensor",
    "tactile_left": "left tactile camera",
    "tactile_right": "right tactile camera",
    "gripper": "gripper",
}


@dataclass(frozen=True, slots=True)
class DegradedDevice:
    """A device that is silent or slow since ``since_s`` of the bench clock."""

    device: str
    how: Literal["silent", "slow"]
    since_s: float

    def what(self, now_s: float) -> str:
        """Return the description: device, symptom, and duration at ``now_s`` of the bench clock."""
        name, for_s = NAMES[self.device], f"{now_s - self.since_s:.1f} s"
        if self.how == "silent":
            return f"The {name} has been silent for {for_s}."
        return f"The {name} has delivered less than half of its samples for {for_s}."


class RateMonitor:
    """Sample rate of a sensor by its own time stamps, and the best rate so far."""

    def __init__(self) -> None:
        self._best_hz = 0.0
        self._begun_s: float | None = None
        self._count = 0
        self.slow_since_s: float | None = None  # start of the low rate; None at the usual rate

    def begin(self) -> None:
        """Restart the count for a new scene; keeps the best rate."""
        self._begun_s, self._count, self.slow_since_s = None, 0, None

    def note(
        self, newest_s: float, count: int, usual_hz: Callable[[], float] = lambda: 0.0
    ) -> None:
        """Add ``count`` samples, the newest stamped ``newest_s``; evaluated once per second.
        ``usual_hz`` is the rate that the sensor reports, 0 if none.
        """
        if self._begun_s is None:
            self._begun_s = newest_s
            return
        self._count += count
        span_s = newest_s - self._begun_s
        if span_s < RATE_WINDOW_S:
            return
        rate_hz = self._count / span_s
        self._best_hz = max(self._best_hz, rate_hz)
        if rate_hz >= SLOW_RATE_SHARE * max(self._best_hz, usual_hz()):
            self.slow_since_s = None
        elif self.slow_since_s is None:
            self.slow_since_s = self._begun_s
        self._begun_s, self._count = newest_s, 0


def refuse_degraded(degraded: tuple[DegradedDevice, ...], now_s: float) -> None:
    """Raise ``RefusedError`` while a device is degraded."""
    for one in degraded:
        raise RefusedError("DEGRADED", f"{one.what(now_s)} Start again once it delivers.")


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

    def check(self, now_s: float) -> Fault | None:
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


def _lost_fault(what: str) -> Fault:
    return Fault(
        "PIECE-LOST",
        what,
        "Motion stopped; the probe in progress is void and nothing was let go.",
        "Take the piece out or grip it again by hand, then press Reset.",
        "gripper",
    )


# Slow below the first share of the usual rate, until it is above the second.
SLOW_ARRIVAL_SHARE, WELL_SHARE = 0.5, 0.6
WINDOW_S = 0.05
# Minimum number of samples due in the window: single losses do not make a sensor slow.
LEAST_PERIODS = 6
APART = 1.5  # periods of silence after an arrival that end a batch
# A wait longer than adapters cause (16 ms) and than this many periods is not a rate.
WAIT_S, WAIT_PERIODS = 0.021, 5.0


@runtime_checkable
class ReportsSlowness(Protocol):
    """A sensor that reports the start of a low rate."""

    @property
    def slow_since_s(self) -> float | None:
        """Bench time, s; None at the usual rate."""


class ArrivalMonitor:
    """Monitor of the arrivals of one connection; ``period_s`` is the usual period."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._window_s = max(WINDOW_S, LEAST_PERIODS * period_s)
        self._came: deque[tuple[float, int]] = deque()
        self._total = 0
        self._judged = True
        self.slow_since_s: float | None = None  # start of the low rate; None at the usual rate

    def note(self, now_s: float, count: int) -> None:
        """Add ``count`` samples that arrived at ``now_s``."""
        self.look(now_s)
        self._total += count
        self._came.append((now_s, self._total))
        self._judged = False
        if self.slow_since_s is not None and self._share() >= WELL_SHARE:
            self.slow_since_s = None

    def look(self, now_s: float) -> None:
        """Evaluate up to the newest arrival, once its batch is complete at ``now_s``."""
        if self._judged or now_s - self._came[-1][0] <= APART * self._period_s:
            return
        self._judged = True
        if (
            self.slow_since_s is None
            and self._share() < SLOW_ARRIVAL_SHARE
            and not self._is_delayed()
        ):
            self.slow_since_s = self._came[0][0]

    def _is_delayed(self) -> bool:
        """Return True after a long wait: the batch that ends it may be incomplete."""
        longest_s = max(b[0] - a[0] for a, b in pairwise(self._came))
        return longest_s > max(WAIT_S, WAIT_PERIODS * self._period_s)

    def _share(self) -> float:
        """Return the rate over the window up to the newest arrival, as a share of the usual one;
        1.0 without a window.
        """
        came, (last_s, last) = self._came, self._came[-1]
        while len(came) > 1 and came[1][0] <= last_s - self._window_s:
            came.popleft()
        first_s, first = came[0]
        if last_s - first_s < self._window_s:
            return 1.0
        return (last - first) * self._period_s / (last_s - first_s)


GRACE_S = 1.0  # time for the first samples after the start of a scene
EQUAL = 3  # equal pictures in a row of a frozen camera: a live one has noise
# Pictures in a row below this mean grey level: the lamps of the gel have failed.
DARK, DARKEST_MEAN = 5, 16.0
# An arm is stalled if it moves less than this in this time although a motion is under way.
STALLED_S, STALLED_MM, STALLED_RAD = 1.5, 0.05, 1e-3
_KEPT = "Motion stopped; the gripper was not opened."
_LOOK = "Check the device and its cable, then press Reset."


class Supervision:
    """Supervision of the tared wrench, both cameras, and the gripper while it holds a piece."""

    def __init__(
        self,
        interlock: Interlock,
        wrench: SampleStream,
        frames: Mapping[Finger, Stream[TactileFrame]],
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
        reports its usual rate as the field ``usual_hz``; ``arm`` is monitored while it moves.
        """
        self._gripper, self._wrist = gripper, wrist
        self._stall = StallMonitor(arm)
        self._grip = GripMonitor(gripper)
        self._begun_s = self._finite_s = now_s
        self._cursor = self._wrench.count
        self._pictures = {finger: _PictureMonitor(self._frames[finger]) for finger in FINGERS}
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
        self._check_pictures()
        for fault in (self._grip.check(now_s), self._stall.check(now_s)):
            if fault is not None:
                self._interlock.raise_fault(fault)
        if now_s - self._begun_s < GRACE_S:
            return
        self._check_ages(now_s)

    def _usual_hz(self) -> float:
        """Return the rate that the wrist sensor reports, 0 if none."""
        told = 0.0 if self._wrist is None else self._wrist.describe().get("usual_hz", 0.0)
        return told if isinstance(told, float) and math.isfinite(told) else 0.0

    def unwell(self) -> Fault | None:
        """Return the fault of a run that pauses for a degraded device, None without one."""
        for one in self.degraded:
            return Fault(
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
                Fault(
                    "FT-TRIP",
                    f"Force trip: {force.max():.1f} N, {moment.max():.2f} N·m "
                    f"(limits {limits.trip_n:.0f} N, {limits.trip_nm:.1f} N·m).",
                    "The arm draws back by 2 mm; the gripper was not opened.",
                    "Check the piece and the support, then press Reset.",
                    "force_torque",
                )
            )

    def _check_pictures(self) -> None:
        for finger, pictures in self._pictures.items():
            equal, dark = pictures.longest()
            if equal >= EQUAL:
                what = f"The {finger} tactile camera delivers the same picture again and again."
                step, code = _LOOK, "CAMERA-FROZEN"
            elif dark >= DARK:
                what = f"The pictures of the {finger} tactile camera are dark."
                step = "Check the lamps of the sensor and its exposure, then press Reset."
                code = "CAMERA-DARK"
            else:
                continue
            self._interlock.raise_fault(Fault(code, what, _KEPT, step, f"tactile_{finger}"))

    def _check_ages(self, now_s: float) -> None:
        limits, late, stale = self._interlock.limits, list[DegradedDevice](), list[Fault]()
        # A camera that reports why its pictures are rejected is silent for the same reason.
        explained = {fault.device for fault in self._interlock.faults} - {"force_torque"}
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
            if device == "force_torque" and isinstance(self._wrist, ReportsSlowness):
                slow_s = slow_s if self._wrist.slow_since_s is None else self._wrist.slow_since_s
            if slow_s is not None:
                late.append(DegradedDevice(device, "slow", slow_s))
            elif now_s - last_s > LATE_SHARE[device] * limit_s:
                late.append(DegradedDevice(device, "silent", last_s))
            if now_s - last_s > limit_s and device not in explained:
                stale.append(_stale_fault(device, now_s - last_s))
        for fault, one in self._check_grip(now_s):
            stale.extend(filter(None, (fault,)))
            late.append(one)
        self._show(tuple(late), now_s)
        for fault in stale:
            self._interlock.raise_fault(fault)

    def _check_grip(self, now_s: float) -> Iterator[tuple[Fault | None, DegradedDevice]]:
        """Yield the gripper if it holds a piece and is late, with its fault if it stays silent. A
        gripper without a valid width counts as silent.
        """
        gripper = self._gripper
        if gripper is None or not (self._grip.holds or gripper.status().holding):
            return
        last_s = max(self._begun_s, min(now_s - gripper.health.age_s, self._grip.seen_s))
        if now_s - last_s > GRIP_LATE_S:
            lost = now_s - last_s > GRIP_LOST_S
            fault = _stale_fault("gripper", now_s - last_s) if lost else None
            yield fault, DegradedDevice("gripper", "silent", last_s)

    def _show(self, late: tuple[DegradedDevice, ...], now_s: float) -> None:
        self.degraded = late
        self._interlock.degraded = late[0].what(now_s) if late else ""
        self._interlock.late = {one.device: one.what(now_s) for one in late}


def _stale_fault(device: str, age_s: float) -> Fault:
    """Return the fault of a sensor whose newest valid sample is ``age_s`` old."""
    if device == "force_torque":
        what = f"The force/torque sensor has sent no valid sample for {age_s:.1f} s."
        return Fault("FT-STALE", what, _KEPT, _LOOK, device)
    what = f"The {NAMES[device]} has been silent for {age_s:.1f} s."
    if device == "gripper":
        return Fault("GRIP-STALE", f"{what} It held a piece.", _KEPT, _LOOK, device)
    return Fault("CAMERA-STALE", what, _KEPT, _LOOK, device)


class _PictureMonitor:
    """Counter of equal and of dark pictures in a row of one camera."""

    def __init__(self, frames: Stream[TactileFrame]) -> None:
        self._frames, self._cursor = frames, frames.count
        self._last: ImageArray | None = None
        self._equal, self._dark = 1, 0

    def longest(self) -> tuple[int, int]:
        """Return the longest runs of equal and of dark pictures that end since the last call."""
        frames, self._cursor, _ = self._frames.since(self._cursor)
        equal = dark = 0
        for frame in frames:
            alike = self._last is not None and _equal(self._last, frame.image)
            self._equal = self._equal + 1 if alike else 1
            self._dark = self._dark + 1 if frame.image[::8, ::8].mean() < DARKEST_MEAN else 0
            self._last = frame.image
            equal, dark = max(equal, self._equal), max(dark, self._dark)
        return equal, dark


class StallMonitor:
    """Monitor of an arm while a motion is under way; a press may stand in contact."""

    def __init__(self, arm: GuardedArm | None) -> None:
        self._arm = arm
        self._motion: Motion | None = None
        self._since_s = 0.0
        self._pose = np.zeros(6)

    def check(self, now_s: float) -> Fault | None:
        """Return the fault of an arm that does not move, once; otherwise None."""
        motion = None if self._arm is None else self._arm.commanded
        if self._arm is None or motion is None or motion.done:
            self._motion = None
            return None
        try:
            pose = np.array(astuple(self._arm.pose(STALLED_S)))
        except (StaleSampleError, FaultError):
            return None  # a silent arm has a fault of its own
        away = np.abs(pose - self._pose)
        moved = away[:3].max() > STALLED_MM or away[3:].max() > STALLED_RAD
        if motion is not self._motion or moved or getattr(motion, "onset_s", None) is not None:
            self._motion, self._since_s, self._pose = motion, now_s, pose
        if now_s - self._since_s <= STALLED_S:
            return None
        self._since_s = math.inf
        return Fault(
            "ARM-STALLED",
            f"The arm has not moved for {STALLED_S:g} s although a motion is under way.",
            _KEPT,
            "Look for an obstacle and at the controller of the arm; then press Reset.",
            "arm",
        )


def _equal(one: ImageArray, other: ImageArray) -> bool:
    # Compare a few points first: pictures of a live camera differ nearly everywhere.
    return np.array_equal(one[::32, ::32], other[::32, ::32]) and np.array_equal(one, other)

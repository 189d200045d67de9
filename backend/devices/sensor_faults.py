"""Faults of sensors while the bench moves: silent, slow, or with frozen or dark pictures.

A late or slow device is degraded first: no new motion starts, and by hand the arm only moves away
from contact. Continued silence becomes a fault. The rate is measured between arrivals, never up to
now, so that a batch delayed by a busy computer does not count.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from touchdown.backend.core import Fault, Finger, ImageArray, RefusedError, Stream, TactileFrame

# A device is late at this share of the age that is a fault: 100 of 300 ms, pictures 120 of 500 ms.
LATE_SHARE = {"force_torque": 1 / 3, "tactile_left": 0.24, "tactile_right": 0.24}
# A sensor is slow below this share of the usual rate, or of its best rate so far.
SLOW_RATE_SHARE = 0.5
RATE_WINDOW_S, RATE_STEP_S = 1.0, 0.25  # the rate of the last second, four times a second
NAMES = {
    "force_torque": "wrist sensor",
    "tactile_left": "left tactile camera",
    "tactile_right": "right tactile camera",
    "gripper": "gripper",
    "arm": "arm",
}


MOTION_STOPPED = "Motion stopped; the gripper was not opened."
CHECK_DEVICE = "Check the device and its cable, then press Reset."


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
        self._count = 0
        # Time and count at each step of the last second.
        self._steps: deque[tuple[float, int]] = deque()
        self.slow_since_s: float | None = None  # start of the low rate; None at the usual rate

    def begin(self) -> None:
        """Restart the count for a new scene; keeps the best rate."""
        self._count, self.slow_since_s = 0, None
        self._steps.clear()

    def note(
        self, newest_s: float, count: int, usual_hz: Callable[[], float] = lambda: 0.0
    ) -> None:
        """Add ``count`` samples, the newest stamped ``newest_s``.
        ``usual_hz`` is the rate that the sensor reports, 0 if none.
        """
        steps = self._steps
        if not steps:
            steps.append((newest_s, 0))
            return
        self._count += count
        if newest_s - steps[-1][0] < RATE_STEP_S:
            return
        steps.append((newest_s, self._count))
        while newest_s - steps[1][0] >= RATE_WINDOW_S:
            steps.popleft()
        begun_s, before = steps[0]
        if newest_s - begun_s < RATE_WINDOW_S:
            return
        rate_hz = (self._count - before) / (newest_s - begun_s)
        self._best_hz = max(self._best_hz, rate_hz)
        if rate_hz >= SLOW_RATE_SHARE * max(self._best_hz, usual_hz()):
            self.slow_since_s = None
        elif self.slow_since_s is None:
            self.slow_since_s = begun_s


def refuse_degraded(degraded: tuple[DegradedDevice, ...], now_s: float) -> None:
    """Raise ``RefusedError`` while a device is degraded."""
    for one in degraded:
        raise RefusedError("DEGRADED", f"{one.what(now_s)} Start again once it delivers.")


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


EQUAL = 3  # equal pictures in a row of a frozen camera: a live one has noise
# Pictures in a row below this mean grey level: the lamps of the gel have failed.
DARK, DARKEST_MEAN = 5, 16.0


class PictureMonitor:
    """Monitor of the pictures of one camera: frozen if they repeat, dark without its lamps."""

    def __init__(self, finger: Finger, frames: Stream[TactileFrame]) -> None:
        self._finger, self._frames, self._cursor = finger, frames, frames.count
        self._last: ImageArray | None = None
        self._equal, self._dark = 1, 0

    def check(self) -> Fault | None:
        """Return the fault of a camera that is frozen or dark since the last call, or None."""
        frames, self._cursor, _ = self._frames.since(self._cursor)
        equal = dark = 0
        # A picture that nobody has read misleads nobody.
        for frame in (frame for frame in frames if frame.made):
            alike = self._last is not None and _equal(self._last, frame.image)
            self._equal = self._equal + 1 if alike else 1
            self._dark = self._dark + 1 if frame.image[::8, ::8].mean() < DARKEST_MEAN else 0
            self._last = frame.image
            equal, dark = max(equal, self._equal), max(dark, self._dark)
        if equal >= EQUAL:
            what = f"The {self._finger} tactile camera delivers the same picture again and again."
            step, code = CHECK_DEVICE, "CAMERA-FROZEN"
        elif dark >= DARK:
            what = f"The pictures of the {self._finger} tactile camera are dark."
            step = "Check the lamps of the sensor and its exposure, then press Reset."
            code = "CAMERA-DARK"
        else:
            return None
        return Fault(code, what, MOTION_STOPPED, step, f"tactile_{self._finger}")


def _equal(one: ImageArray, other: ImageArray) -> bool:
    # Compare a few points first: pictures of a live camera differ nearly everywhere.
    return np.array_equal(one[::32, ::32], other[::32, ::32]) and np.array_equal(one, other)


def stale_fault(device: str, age_s: float) -> Fault:
    """Return the fault of a device whose newest valid sample is ``age_s`` old."""
    if device == "force_torque":
        what = f"The force/torque sensor has sent no valid sample for {age_s:.1f} s."
        return Fault("FT-STALE", what, MOTION_STOPPED, CHECK_DEVICE, device)
    if device == "arm":
        what = f"The arm has reported no position for {age_s:.1f} s."
        return Fault("ARM-STALE", what, MOTION_STOPPED, CHECK_DEVICE, device)
    what = f"The {NAMES[device]} has been silent for {age_s:.1f} s."
    if device == "gripper":
        return Fault("GRIP-STALE", f"{what} It held a piece.", MOTION_STOPPED, CHECK_DEVICE, device)
    return Fault("CAMERA-STALE", what, MOTION_STOPPED, CHECK_DEVICE, device)

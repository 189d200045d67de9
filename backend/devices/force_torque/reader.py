"""Reader of wrist-sensor samples on a thread of its own.

Samples become time-stamped wrenches in tool axes; an invalid one is NaN. Stamps follow the sensor's
own count, because a sensor samples evenly while adapters and networks deliver late and in bursts.
The line of least delay below all (number, arrival) pairs gives the sampling times, up to the delay
of the fastest arrival.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace

import numpy as np

from touchdown.backend.config import ForceTorqueSettings
from touchdown.backend.core import Fault, FaultError, FloatArray, SampleStream
from touchdown.backend.devices import protocols
from touchdown.backend.devices.force_torque.driver import (
    FIRST_BYTES,
    NotAnsweredError,
    RecordedLink,
    SensorDescription,
    SensorLink,
    UnansweredError,
    WrenchDriver,
    WrenchReading,
)
from touchdown.backend.devices.framing import NO_WRENCH, ProtocolError, Wrench
from touchdown.backend.devices.identification import identify_device
from touchdown.backend.devices.sensor_faults import ArrivalMonitor

CHUNK_S = 0.25  # the arrival with the least delay is kept per interval of this length
CHUNKS = 40
FIT_S = 2.0  # the nominal period is used until the fit covers this time
MOST_OFF = 0.1  # maximum relative deviation from the nominal period
# Arrivals that are evenly late for this time follow uncounted lost samples.
LATE_FOR_S = 0.5

# A sample this much before its time follows a jump of the count: the fit restarts.
EARLY_S = 0.1

LEAST_LATE = 20  # minimum number of late samples for a decision
# Time and number of increasingly late samples that show another sample rate.
SLOW_FOR_S, LEAST_SLOW = 0.1, 4
# Ratio of the periods from which on the sensor has another sample rate.
OTHER_RATE = 1.5


@dataclass(slots=True)
class _LatePeriod:
    """Period without a timely arrival: first arrival and number, and the least delay."""

    first_s: float
    first_number: int
    least_s: float


class SampleClock:
    """Sampling times of one connection; a delay up to ``late_s`` is caused by the wire, not a
    loss.
    """

    def __init__(self, period_s: float, late_s: float) -> None:
        self._nominal_s, self._late_s = period_s, max(late_s, 3.0 * period_s)
        self._usual_s = period_s
        self._period_s, self._offset_s = period_s, 0.0
        self._chunks: deque[tuple[int, float]] = deque(maxlen=CHUNKS)
        self._chunk = -1
        self._late: _LatePeriod | None = None

    def taken_s(self, numbers: FloatArray) -> FloatArray:
        """Return the sampling times (n,) of samples with these numbers, s."""
        return np.asarray(self._offset_s + self._period_s * numbers)

    def feed(self, arrival_s: float, number: int) -> int:
        """Add the newest sample of a read; return the number of uncounted lost samples."""
        if not self._chunks:
            self._offset_s = arrival_s - self._period_s * number
        self._keep(arrival_s, number)
        delay_s = arrival_s - self._taken_s(number)
        if delay_s < 0.0:
            self._offset_s += delay_s
        if delay_s < -EARLY_S:
            self._chunks.clear()
            self._chunks.append((number, arrival_s))
        if delay_s <= self._late_s:
            self._late = None
            return 0
        return self._step(arrival_s, number, delay_s)

    def _taken_s(self, number: int) -> float:
        return self._offset_s + self._period_s * number

    def _keep(self, arrival_s: float, number: int) -> None:
        """Keep the arrival with the least delay of each chunk; fit when a chunk is complete."""
        chunk = int(number * self._nominal_s / CHUNK_S)
        if chunk != self._chunk:
            if self._chunks:
                self._fit()
            self._chunk = chunk
            self._chunks.append((number, arrival_s))
            return
        kept, kept_s = self._chunks[-1]
        if arrival_s - kept_s < self._period_s * (number - kept):
            self._chunks[-1] = (number, arrival_s)

    def _fit(self) -> None:
        """Fit the closest line below all arrivals: one edge of their lower hull."""
        numbers, arrivals_s = map(np.array, zip(*self._chunks, strict=True))
        if (numbers[-1] - numbers[0]) * self._nominal_s >= FIT_S:
            fitted_s = _edge(numbers, arrivals_s)
            if OTHER_RATE * fitted_s < self._nominal_s:
                # The low rate has ended: restart the fit.
                self._nominal_s = self._period_s = self._usual_s
                self._offset_s = float(arrivals_s[-1] - self._usual_s * numbers[-1])
                self._chunks.clear()
                return
            most_s = MOST_OFF * self._nominal_s
            self._period_s = float(
                np.clip(fitted_s, self._nominal_s - most_s, self._nominal_s + most_s)
            )
        self._offset_s = float((arrivals_s - self._period_s * numbers).min())

    def _step(self, arrival_s: float, number: int, delay_s: float) -> int:
        """Shift the line after a long time without a timely arrival: lost samples are a gap in
        time.
        """
        late = self._late
        if late is None:
            self._late = _LatePeriod(arrival_s, number, delay_s)
            return 0
        late.least_s = min(late.least_s, delay_s)
        span_s = self._period_s * (number - late.first_number)
        waited_s = arrival_s - late.first_s
        if waited_s >= SLOW_FOR_S and number - late.first_number >= LEAST_SLOW:
            told_s = waited_s / (number - late.first_number)
            if told_s > OTHER_RATE * self._nominal_s:
                self._begin(arrival_s, number, told_s)
                return 0
        drained = span_s < 0.5 * LATE_FOR_S and number - late.first_number < LEAST_LATE
        if waited_s < LATE_FOR_S or drained:
            return 0
        self._late = None
        self._chunks.clear()
        self._offset_s += late.least_s
        self._chunks.append((number, self._taken_s(number)))
        return round(late.least_s / self._period_s)

    def _begin(self, arrival_s: float, number: int, period_s: float) -> None:
        self._late = None
        self._chunks.clear()
        self._nominal_s = self._period_s = period_s
        self._offset_s = arrival_s - period_s * number
        self._chunks.append((number, arrival_s))


def _edge(numbers: FloatArray, arrivals_s: FloatArray) -> float:
    """Return the slope of the lower hull below the mean of ``numbers``."""
    hull: list[int] = []
    for i in range(len(numbers)):
        while len(hull) > 1 and _above(numbers, arrivals_s, (hull[-2], hull[-1], i)):
            hull.pop()
        hull.append(i)
    right = next(k for k in range(1, len(hull)) if numbers[hull[k]] >= numbers.mean())
    a, b = hull[right - 1], hull[right]
    return float((arrivals_s[b] - arrivals_s[a]) / (numbers[b] - numbers[a]))


def _above(numbers: FloatArray, arrivals_s: FloatArray, three: tuple[int, int, int]) -> bool:
    """Return True if the middle point is on or above the line through the other two."""
    a, b, c = three
    left = (arrivals_s[b] - arrivals_s[a]) * (numbers[c] - numbers[a])
    right = (arrivals_s[c] - arrivals_s[a]) * (numbers[b] - numbers[a])
    return bool(left >= right)


LEAST_S = 1e-6  # minimum difference of two stamps
LATE_S = 0.01  # default limit of the delay of the wire


AXES = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")
MOST_MISSED_S = 1.0  # a longer gap in the sample numbers is no loss but another stream


def axis_text(axis: int, value: float) -> str:
    """Return the value of an axis with its unit, such as "Fz = -14.70 N"."""
    return f"{AXES[axis]} = {value:.2f} {'N' if axis < 3 else 'N·m'}"


def range_text(values: Sequence[float], rated: Sequence[float]) -> str:
    """Return the first axis at or beyond its rated range with both values, else ""."""
    for axis, (value, limit) in enumerate(zip(values, rated, strict=True)):
        if abs(value) >= limit:
            return f"{axis_text(axis, value)}, rated {limit:g}"
    return ""


class WrenchStamper:
    """Time stamps and validity of samples; the caller owns the clock. ``late_s``: limit of the
    delay of the wire. ``numbered``: True if the sensor's own count shows every loss; otherwise a
    loss is found by a persistent delay. ``rated``: range of each axis of the sensor, N and N·m. A
    sensor is stuck if the newest ``stuck_after`` samples are identical. ``overload`` (text) and
    ``trouble`` are latched.
    """

    def __init__(
        self,
        settings: ForceTorqueSettings,
        period_s: float,
        late_s: float = LATE_S,
        *,
        numbered: bool = False,
        rated: Sequence[float] = (np.inf,) * len(AXES),
    ) -> None:
        self._settings, self.period_s, self._rated = settings, period_s, rated
        self._clock, self._numbered = SampleClock(period_s, late_s), numbered
        self._number = 0
        self.turn = settings.sign * np.array(settings.rotation)  # sensor axes to tool axes
        self._newest_s = -np.inf
        self._last: Wrench | None = None
        self._equal = 0
        self.lost = 0
        self.overload = self.trouble = ""

    @property
    def stuck(self) -> bool:
        """True while the sensor repeats the same sample."""
        return self._equal + 1 >= self._settings.stuck_after

    def accept(
        self, arrival_s: float, readings: Sequence[WrenchReading]
    ) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and wrenches (n, 6), N and N·m in tool axes.

        Stamps follow the count of the sensor along the line of least delay, minus the latency: a
        late burst is spread over the time of its measurement.
        """
        readings = [self._possible(reading) for reading in readings]
        told = np.array([self._valid(reading) for reading in readings], dtype=np.float64)
        values = (told.reshape(-1, 2, 3) @ self.turn.T).reshape(-1, 6)
        return self._stamps(arrival_s - 1e-3 * self._settings.latency_ms, readings), values

    def _possible(self, reading: WrenchReading) -> WrenchReading:
        """Return the reading, with the reason if it cannot be a measurement."""
        if reading.missed * self.period_s > MOST_MISSED_S:
            leap = f"The sample numbers jump by {reading.missed}: this is not one stream"
            return replace(reading, missed=0, trouble=reading.trouble or leap)
        values = (*reading.wrench.force_n, *reading.wrench.torque_nm)
        if all(map(math.isfinite, values)):
            beyond = range_text(values, self._rated)
            self.overload = self.overload or beyond
            return replace(reading, overload=True) if beyond else reading
        if all(map(math.isnan, values)):
            return reading  # marked as invalid
        return replace(reading, trouble=reading.trouble or "A value is not a finite number")

    def _valid(self, reading: WrenchReading) -> Wrench:
        """Return the wrench of a reading in sensor axes, NaN if it is invalid."""
        self.lost += reading.missed
        if reading.overload:
            self.overload = self.overload or "its status says so"
        self.trouble = self.trouble or reading.trouble
        self._equal = self._equal + 1 if reading.wrench == self._last else 0
        self._last = reading.wrench
        valid = not (reading.overload or reading.trouble or self.stuck)
        return reading.wrench if valid else NO_WRENCH

    def _stamps(self, arrival_s: float, readings: Sequence[WrenchReading]) -> FloatArray:
        if not readings:
            return np.empty(0)
        numbers = self._number + np.cumsum([reading.missed + 1 for reading in readings])
        self._number = int(numbers[-1])
        missing = self._clock.feed(arrival_s, self._number)
        self.lost += 0 if self._numbered else missing
        stamps = self._clock.taken_s(numbers)
        if stamps[0] <= self._newest_s:
            # The line was too late so far: stamps must still increase.
            last_s = max(float(stamps[-1]), self._newest_s + LEAST_S * len(stamps))
            stamps = np.linspace(self._newest_s, last_s, len(readings) + 1)[1:]
        self._newest_s = float(stamps[-1])
        return np.asarray(stamps, dtype=np.float64)


NAME = "force_torque"
LOG = logging.getLogger("touchdown.devices")

OVERLOAD = Fault(
    "FT-OVERLOAD",
    "The force/torque sensor is at the end of its range.",
    "Forces beyond are not measured; the arm draws back by 2 mm. The gripper was not opened.",
    "Relieve the sensor, check its zero, then connect it again.",
    NAME,
)


def overload_fault(beyond: str) -> Fault:
    """Return ``OVERLOAD`` with the value that is beyond its range."""
    return replace(OVERLOAD, what=f"{OVERLOAD.what.removesuffix('.')}: {beyond}.")


def ft_fault(code: str, what: str, next_step: str) -> Fault:
    """Return a fault after which no wrench is measured."""
    return Fault(code, what, "No wrench is measured.", next_step, NAME)


def link_fault(what: str) -> Fault:
    """Return the fault of a missing or lost connection."""
    next_step = (
        "Check cable and power of the force/torque sensor, and that no other program reads it; "
        "then connect it again."
    )
    return ft_fault("FT-LINK", what, next_step)


def other_device_fault(what: str) -> Fault:
    """Return the fault of a sensor in whose place another device answers."""
    next_step = (
        "Correct ft.driver or ft.address in the lab file, or exchange the plugs; then connect it "
        "again."
    )
    return ft_fault("FT-LINK", what, next_step)


def unreadable_fault(driver: str, received: bytes, reason: str = "") -> Fault:
    """Return the fault of a sensor whose bytes have no meaning; the log gets the first of them."""
    LOG.info("wrist sensor, as %s: %s cannot be read. %s", driver, received.hex(" "), reason)
    what = f"The data of the force/torque sensor cannot be read as the make '{driver}'."
    next_step = (
        "Check ft.driver, the data rate and the wiring of the sensor; the log has the first bytes. "
        "Then connect it again."
    )
    return ft_fault("FT-LINK", what, next_step)


SILENT = "The force/torque sensor is silent: no byte arrived."
# Texts of a ``ProtocolError`` in an answer that can be read.
WRONG_ANSWERS = {
    "unit": "The sensor is set to other units than N and N·m.",
    "range": "The sensor reports a scale or range that is not possible.",
}


def driver_fault(error: Exception) -> Fault:
    """Return the fault of a driver that raised an unexpected exception."""
    what = f"The driver of the force/torque sensor failed: {type(error).__name__}: {error}."
    next_step = (
        "Send the text of the log to the author of the driver; then connect the sensor again."
    )
    return ft_fault("FT-DRIVER", what, next_step)


def sensor_fault(what: str) -> Fault:
    """Return the fault that the sensor itself reports."""
    next_step = "Switch the force/torque sensor off and on, then connect it again."
    return ft_fault("FT-SENSOR", f"{what}.", next_step)


def implausible_fault(why: str) -> Fault:
    """Return the fault of a sensor whose readings in still air cannot be right."""
    what = f"The readings of the force/torque sensor in still air are not plausible: {why}."
    next_step = (
        "Check make, scale, range and axes of the sensor in the lab file, and that the hand hangs "
        "still and free; then connect it again."
    )
    return ft_fault("FT-IMPLAUSIBLE", what, next_step)


GRAVITY_M_S2 = 9.80665
# Permitted zero offset: share of the weight below the sensor, but at least this force.
MOST_UNEXPLAINED, LEAST_UNEXPLAINED_N = 0.6, 3.0


def require_plausible(values: FloatArray, rated: FloatArray, payload_kg: float) -> None:
    """Raise ``FaultError`` unless untared readings (n, 6), tool axes, are those of a payload that
    hangs free below the sensor. Readings of other axes, sign or scale are not.
    """
    if why := implausible_text(values, rated):
        raise FaultError(implausible_fault(why))
    weight_n = GRAVITY_M_S2 * payload_kg
    force_n = np.nanmean(values[:, :3], axis=0)
    away_n = float(np.linalg.norm(force_n - np.array([0.0, 0.0, -weight_n])))
    if not away_n <= max(MOST_UNEXPLAINED * weight_n, LEAST_UNEXPLAINED_N):
        read = ", ".join(axis_text(axis, float(value)) for axis, value in enumerate(force_n))
        why = f"{read}, and mounting.payload_kg = {payload_kg:g} weighs {weight_n:.1f} N"
        raise FaultError(implausible_fault(why))


LEAST_STILL, STILL_S = 20, 0.1  # samples and time that a connection judges
MOST_NOISE, MOST_OFFSET = 0.03, 0.5  # shares of the rated range


def implausible_text(values: FloatArray, rated: FloatArray) -> str:
    """Return why readings (n, 6) in still air cannot be right, else "".

    They scatter by less than 3 % of the range and stay within half of it, and half of them or more
    are valid.
    """
    valid = values[np.isfinite(values).all(axis=1)]
    if 2 * len(valid) <= len(values):
        return f"{len(values) - len(valid)} of {len(values)} samples are not valid"
    if len(valid) > 1 and np.ptp(valid, axis=0).max() == 0:
        return "they repeat one value"
    noise, offset = valid.std(axis=0), valid.mean(axis=0)
    axis = int(np.argmax(noise / rated))
    if noise[axis] > MOST_NOISE * rated[axis]:
        return f"{axis_text(axis, float(offset[axis]))} scatters by {noise[axis]:.2f}"
    axis = int(np.argmax(np.abs(offset) / rated))
    if abs(offset[axis]) > MOST_OFFSET * rated[axis]:
        return f"{axis_text(axis, float(offset[axis]))}, more than half of its range"
    return ""


def _system_text(error: OSError) -> str:
    return os.strerror(error.errno) if error.errno else str(error)


READ_S = 0.005  # longest wait for bytes
BAD_LIMIT = 20
STALE_S = 0.1
CAPACITY = 32_768


class ForceTorqueReader:
    """Reader of a wrist sensor. The factory makes one driver per connection; ``now_s`` is the clock
    of the stamps. ``late_s``: limit of the delay of the wire.
    """

    name = NAME

    def __init__(
        self,
        make_driver: Callable[[], WrenchDriver],
        open_link: Callable[[WrenchDriver], SensorLink],
        settings: ForceTorqueSettings,
        now_s: Callable[[], float],
        samples: SampleStream | None = None,
        late_s: float = LATE_S,
    ) -> None:
        self._late_s = late_s
        self._make_driver, self._open_link = make_driver, open_link
        self._settings, self._now_s = settings, now_s
        self._samples = samples or SampleStream(self.name, 6, CAPACITY)
        self._thread: threading.Thread | None = None
        self._stop, self._first = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self.steps = protocols.ConnectionSteps()
        self._state = protocols.DeviceState.CLOSED
        self._description: SensorDescription | None = None
        self._readout = WrenchStamper(settings, 1.0)
        self._resynchronised = 0
        self._junk = b""  # first bytes since the last sample
        self._arrivals = protocols.ArrivalCounter()
        self._pace = ArrivalMonitor(1.0)
        self.fault: Fault | None = None

    @property
    def state(self) -> protocols.DeviceState:
        """State of the connection."""
        return self._state

    @property
    def identity(self) -> protocols.Identity | None:
        """Identity, None before the first connection."""
        return self._description.identity if self._description else None

    @property
    def samples(self) -> SampleStream:
        """Stream of Fx Fy Fz Tx Ty Tz in N and N·m, tool axes; NaN if invalid."""
        return self._samples

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range, N and N·m; NaN before the first connection."""
        return np.array(self._description.rated if self._description else [np.nan] * 6)

    @property
    def health(self) -> protocols.Health:
        """Rate over the last second, age of the newest sample, counts."""
        return self._arrivals.health(self._now_s(), self._readout.lost)

    @property
    def condition(self) -> str:
        """One word: good, slow, stuck, stale; fault or closed by the state."""
        if self._state is not protocols.DeviceState.READY:
            return str(self._state.value)
        if self.health.age_s > STALE_S:
            return "stale"
        if self._readout.stuck:
            return "stuck"
        return "good" if self.slow_since_s is None else "slow"

    @property
    def slow_since_s(self) -> float | None:
        """Start of a rate below half of the usual one, s; None at the usual rate."""
        return self._pace.slow_since_s

    def describe(self) -> Mapping[str, str | float]:
        """Return make, range, losses and condition."""
        rated, identity = self.rated, self.identity
        return {
            "kind": identity.model if identity else self._settings.driver,
            "number": identity.serial if identity else "",
            "condition": self.condition,
            "usual_hz": 1.0 / self._readout.period_s,
            "lost": self._readout.lost,
            "resynchronised": self._resynchronised,
            "rated_n": float(rated[2]),
            "rated_nm": float(rated[5]),
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Bring the sensor to streaming and wait for the first sample."""
        if self._state is protocols.DeviceState.READY:
            return
        self.close()
        self._state, self.fault = protocols.DeviceState.CONNECTING, None
        self.steps.begin()
        try:
            link, driver = self._begin(cancel)
            self._forget()
            self._thread = threading.Thread(
                target=self._read, args=(link, driver), name=self.name, daemon=True
            )
            self._thread.start()
            if not self._first.wait(timeout_s):
                if self._junk:
                    raise FaultError(unreadable_fault(self._settings.driver, self._junk))
                raise FaultError(link_fault(SILENT))
            self._check_still(timeout_s, cancel)
        except FaultError as error:
            self.close()
            found = "" if cancel.is_set() else self._other_device()
            if not found:
                raise
            raise FaultError(other_device_fault(found)) from error
        self._settle()

    def _settle(self) -> None:
        with self._lock:
            self._state = (
                protocols.DeviceState.READY if self.fault is None else protocols.DeviceState.FAULT
            )

    def close(self) -> None:
        """Stop the stream and close the link."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._state = protocols.DeviceState.CLOSED

    def _check_still(self, timeout_s: float, cancel: threading.Event) -> None:
        """Raise the fault of a lost link, or of readings that no sensor in still air delivers."""
        period_s, until_s = self._readout.period_s, time.monotonic() + timeout_s
        count = max(LEAST_STILL, round(STILL_S / period_s))
        while (
            self._arrivals.received < count
            and self.fault is None
            and time.monotonic() < until_s
            and not cancel.wait(READ_S)
        ):
            pass
        if self.fault is not None:
            if self._stop.is_set():
                raise FaultError(self.fault)
            return
        values = self._samples.since(self._samples.count - self._arrivals.received).values
        stuck, turn = self._readout.stuck, self._readout.turn
        refusal = implausible_text((values.reshape(-1, 2, 3) @ turn).reshape(-1, 6), self.rated)
        if stuck or refusal:
            raise FaultError(implausible_fault("they repeat one value" if stuck else refusal))

    def _other_device(self) -> str:
        """Return a sentence that names another device in place of the sensor, else ""."""
        with suppress(OSError), closing(self._open_link(self._make_driver())) as link:
            found = identify_device(link.write, link.read, self._settings.driver)
            expected = f"a force/torque sensor (ft.driver is {self._settings.driver})"
            return f"This is {found}, expected {expected}." if found else ""
        return ""

    def _begin(self, cancel: threading.Event) -> tuple[SensorLink, WrenchDriver]:
        """Open the link and start the sensor; the link is closed again if that fails."""
        driver = self._make_driver()
        try:
            link = self._open_link(driver)
        except OSError as error:
            # Some packages repeat number and port in the text.
            port = f"port {self._settings.address}".rstrip()
            what = f"The {port} cannot be opened: {_system_text(error)}."
            raise FaultError(link_fault(what)) from error
        self.steps.reached("reach")
        recorded = RecordedLink(link)
        try:
            self._description = driver.start(recorded, cancel)
            self.steps.reached("configure")
        except Exception as error:
            link.close()
            raise FaultError(self._start_fault(error, recorded.first)) from error
        return link, driver

    def _start_fault(self, error: Exception, received: bytes) -> Fault:
        """Return the fault of a failed start: silent, unreadable, wrong answer, or refused."""
        match error:
            case ProtocolError() if error.what in WRONG_ANSWERS:
                LOG.info("wrist sensor: %s after %s", error, received.hex(" "))
                return link_fault(WRONG_ANSWERS[error.what])
            case UnansweredError() if not received:
                return link_fault(SILENT)
            case ProtocolError() | UnansweredError():
                return unreadable_fault(self._settings.driver, received, str(error))
            case OSError():
                return link_fault(f"The port is lost: {_system_text(error)}.")
            case NotAnsweredError():
                return link_fault(f"{error}.")
        return driver_fault(error)

    def _forget(self) -> None:
        started = self._description
        period_s = started.period_s if started else 1.0
        numbered = started is not None and started.numbered
        rated = started.rated if started else (np.inf,) * len(AXES)
        self._readout = WrenchStamper(
            self._settings, period_s, self._late_s, numbered=numbered, rated=rated
        )
        self._stop.clear()
        self._first.clear()
        self._resynchronised = 0
        self._arrivals = protocols.ArrivalCounter()
        self._pace = ArrivalMonitor(period_s)

    def _read(self, link: SensorLink, driver: WrenchDriver) -> None:
        """Read the link until the stop or its loss; then stop the sensor."""
        good_s = heard_s = self._now_s()
        discarded, self._junk = driver.refusals.discarded, b""
        try:
            while not self._stop.is_set():
                data = link.read(READ_S)
                now_s = self._now_s()
                heard_s, self._junk = now_s if data else heard_s, (self._junk + data)[:FIRST_BYTES]
                if self._deliver(driver, now_s, data):
                    good_s, before, self._junk = now_s, discarded, b""
                    discarded = driver.refusals.discarded
                    self._resynchronised += discarded > before
                limit_s = self._settings.silence_s
                ended = self._first.is_set() and now_s - good_s > limit_s
                if ended and now_s - heard_s > 0.5 * limit_s:
                    self._fail(link_fault("The force/torque sensor is silent."))
                elif ended or driver.refusals.in_a_row >= BAD_LIMIT:
                    self._fail(unreadable_fault(self._settings.driver, self._junk))
            driver.stop(link)
        except OSError as error:
            self._fail(link_fault(f"The port is lost: {_system_text(error)}."))
        except Exception as error:
            self._fail(driver_fault(error))
            raise
        finally:
            link.close()

    def _deliver(self, driver: WrenchDriver, now_s: float, data: bytes) -> bool:
        readout = self._readout
        stamps, values = readout.accept(now_s, driver.take(data))
        if not len(stamps):
            self._pace.look(now_s)
            return False
        self._samples.put(stamps, values)
        self._arrivals.note(now_s, len(stamps))
        self._pace.note(now_s, len(stamps))
        if self.fault is None and (readout.overload or readout.trouble):
            beyond, trouble = readout.overload, readout.trouble
            self._latch(overload_fault(beyond) if beyond else sensor_fault(trouble))
        self.steps.reached("first sample")
        self._first.set()
        return True

    def _fail(self, fault: Fault) -> None:
        self._stop.set()
        self._latch(fault)
        self._first.set()

    def _latch(self, fault: Fault) -> None:
        with self._lock:
            self.fault, self._state = fault, protocols.DeviceState.FAULT

"""Reader thread of a wrist sensor."""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress

import numpy as np

from touchdown.backend.config import ForceTorqueSettings
from touchdown.backend.core import Fault, FaultError, FloatArray, SampleStream
from touchdown.backend.devices.force_torque.links import Link
from touchdown.backend.devices.force_torque.protocol import (
    Greeting,
    Language,
    NotAnsweredError,
    Reading,
)
from touchdown.backend.devices.force_torque.sample_clock import SampleClock
from touchdown.backend.devices.framing import NO_WRENCH, WireError, Wrench
from touchdown.backend.devices.protocols import DeviceState, Health, Identity, Steps
from touchdown.backend.devices.registry import who_answers
from touchdown.backend.devices.supervision import Arrivals

LEAST_S = 1e-6
"""Stamps rise by at least this much."""
LATE_S = 0.01
"""A delay of the wire up to this is no loss, if nobody says otherwise."""


class Readout:
    """Counts what is missing and notices a stuck sensor; the caller owns the clock.

    ``late_s``: how late the wire may be without a loss. ``numbered``: the sensor's own count shows
    every loss; else a loss that nobody counted is found by what comes late ever after.

    ``stuck``: the newest ``stuck_after`` samples or more are equal to the last digit, which no
    living sensor is. ``overload`` and ``trouble`` stay once they have been seen.
    """

    def __init__(
        self,
        settings: ForceTorqueSettings,
        period_s: float,
        late_s: float = LATE_S,
        *,
        numbered: bool = False,
    ) -> None:
        self._settings, self.period_s = settings, period_s
        self._clock, self._numbered = SampleClock(period_s, late_s), numbered
        self._number = 0
        self._turn = settings.sign * np.array(settings.rotation)
        self._newest_s = -np.inf
        self._last: Wrench | None = None
        self._equal = 0
        self.lost = 0
        self.overload = False
        self.trouble = ""

    @property
    def stuck(self) -> bool:
        """Whether the sensor repeats itself."""
        return self._equal + 1 >= self._settings.stuck_after

    def accept(
        self, arrival_s: float, readings: Sequence[Reading]
    ) -> tuple[FloatArray, FloatArray]:
        """Return stamps (n,) and wrenches (n, 6), N and N·m in tool axes.

        Stamps follow the count of the sensor along the line of least delay, less the latency: a
        burst that comes late is spread over the time in which it was measured.
        """
        told = np.array([self._valid(reading) for reading in readings], dtype=np.float64)
        values = (told.reshape(-1, 2, 3) @ self._turn.T).reshape(-1, 6)
        return self._stamps(arrival_s - 1e-3 * self._settings.latency_ms, readings), values

    def _valid(self, reading: Reading) -> Wrench:
        """Return what a reading says in axes of the sensor, NaN where that is no measurement."""
        self.lost += reading.missed
        self.overload |= reading.overload
        self.trouble = self.trouble or reading.trouble
        self._equal = self._equal + 1 if reading.wrench == self._last else 0
        self._last = reading.wrench
        valid = not (reading.overload or reading.trouble or self.stuck)
        return reading.wrench if valid else NO_WRENCH

    def _stamps(self, arrival_s: float, readings: Sequence[Reading]) -> FloatArray:
        if not readings:
            return np.empty(0)
        numbers = self._number + np.cumsum([reading.missed + 1 for reading in readings])
        self._number = int(numbers[-1])
        missing = self._clock.feed(arrival_s, self._number)
        self.lost += 0 if self._numbered else missing
        stamps = self._clock.taken_s(numbers)
        if stamps[0] <= self._newest_s:
            # The line was too late so far: time goes on, as slowly as it takes.
            last_s = max(float(stamps[-1]), self._newest_s + LEAST_S * len(stamps))
            stamps = np.linspace(self._newest_s, last_s, len(readings) + 1)[1:]
        self._newest_s = float(stamps[-1])
        return np.asarray(stamps, dtype=np.float64)


NAME = "force_torque"

OVERLOAD = Fault(
    "FT-OVERLOAD",
    "The force/torque sensor is at the end of its range.",
    "Forces beyond are not measured; the arm draws back by 2 mm. The gripper was not opened.",
    "Relieve the sensor, check its zero, then connect it again.",
    NAME,
)


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "FT-LINK",
        what,
        "No wrench is measured.",
        "Check cable and power of the force/torque sensor, and that no other program reads it; "
        "then connect it again.",
        NAME,
    )


def driver_fault(error: Exception) -> Fault:
    """Return the fault of a language that failed on something it did not expect."""
    return Fault(
        "FT-DRIVER",
        f"The driver of the force/torque sensor failed: {type(error).__name__}: {error}.",
        "No wrench is measured.",
        "Report the text of the log to who wrote the driver; then connect the sensor again.",
        NAME,
    )


def sensor_fault(what: str) -> Fault:
    """Return the fault that the sensor itself reports."""
    return Fault(
        "FT-SENSOR",
        f"{what}.",
        "No wrench is measured.",
        "Switch the force/torque sensor off and on, then connect it again.",
        NAME,
    )


READ_S = 0.005
"""Longest wait for bytes: short enough for stamps, long enough not to spin."""
BAD_LIMIT = 20
RATE_WINDOW_S = 1.0
STALE_S = 0.1
CAPACITY = 32_768
WIRE_TROUBLE = (OSError, WireError, NotAnsweredError)


class ForceTorqueReader:
    """``language`` makes one for each connection; samples are stamped in the time of ``now_s``.

    ``late_s``: how late the wire may hand over a sample that was not lost.
    """

    name = NAME

    def __init__(
        self,
        language: Callable[[], Language],
        open_link: Callable[[Language], Link],
        settings: ForceTorqueSettings,
        now_s: Callable[[], float],
        samples: SampleStream | None = None,
        late_s: float = LATE_S,
    ) -> None:
        self._late_s = late_s
        self._new_language, self._open_link = language, open_link
        self._settings, self._now_s = settings, now_s
        self._samples = samples or SampleStream(self.name, 6, CAPACITY)
        self._thread: threading.Thread | None = None
        self._stop, self._first = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self.steps = Steps()
        self._state = DeviceState.CLOSED
        self._greeting: Greeting | None = None
        self._readout = Readout(settings, 1.0)
        self._received = self._resynchronised = 0
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=8192)
        self._pace = Arrivals(1.0)
        self.fault: Fault | None = None

    @property
    def state(self) -> DeviceState:
        """Where the connection is in its life."""
        return self._state

    @property
    def identity(self) -> Identity | None:
        """Known once connected."""
        return self._greeting.identity if self._greeting else None

    @property
    def samples(self) -> SampleStream:
        """Fx Fy Fz Tx Ty Tz in N and N·m, tool axes; NaN where there is no measurement."""
        return self._samples

    @property
    def rated(self) -> FloatArray:
        """(6,) rated range, N and N·m; NaN before the first connection."""
        return np.array(self._greeting.rated if self._greeting else [np.nan] * 6)

    @property
    def health(self) -> Health:
        """Rate over the last second, age of the newest sample, counts."""
        now_s, arrivals = self._now_s(), list(self._arrivals)
        newest_s = arrivals[-1][0] if arrivals else float("-inf")
        rate_hz = sum(n for t, n in arrivals if t > now_s - RATE_WINDOW_S) / RATE_WINDOW_S
        return Health(rate_hz, now_s - newest_s, self._received, self._readout.lost)

    @property
    def resynchronised(self) -> int:
        """How often the reader found its place again after bytes that were no frame."""
        return self._resynchronised

    @property
    def condition(self) -> str:
        """One word: good, slow, stuck, stale; fault or closed by the state."""
        if self._state is not DeviceState.READY:
            return str(self._state.value)
        if self.health.age_s > STALE_S:
            return "stale"
        if self._readout.stuck:
            return "stuck"
        return "good" if self.slow_since_s is None else "slow"

    @property
    def slow_since_s(self) -> float | None:
        """When it began to deliver less than half of its samples; None while it does not."""
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
        if self._state is DeviceState.READY:
            return
        self.close()
        self._state, self.fault = DeviceState.CONNECTING, None
        self.steps.begin()
        try:
            link, language = self._begin(cancel)
            self._start(link, language)
            if not self._first.wait(timeout_s):
                raise FaultError(link_fault("The sensor sends nothing."))
            self._require_link()
        except FaultError as error:
            self.close()
            stranger = "" if cancel.is_set() else self._stranger()
            if not stranger:
                raise
            raise FaultError(link_fault(stranger)) from error
        self._settle()

    def close(self) -> None:
        """Stop the stream and let go of the link."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        self._state = DeviceState.CLOSED

    def _settle(self) -> None:
        with self._lock:
            self._state = DeviceState.READY if self.fault is None else DeviceState.FAULT

    def _require_link(self) -> None:
        if self._stop.is_set() and self.fault is not None:
            raise FaultError(self.fault)

    def _stranger(self) -> str:
        """Return a sentence if another device answers in the place of the sensor."""
        with suppress(OSError), closing(self._open_link(self._new_language())) as link:
            stranger = who_answers(link.write, link.read, self._settings.driver)
            wanted = f"a force/torque sensor (ft.driver is {self._settings.driver})"
            return f"This is {stranger}, expected {wanted}." if stranger else ""
        return ""

    def _begin(self, cancel: threading.Event) -> tuple[Link, Language]:
        """Open the link and start the sensor; the link is closed again if that fails."""
        language = self._new_language()
        try:
            link = self._open_link(language)
        except OSError as error:
            # The text of some packages tells number and port twice.
            why = os.strerror(error.errno) if error.errno else str(error)
            port = f"port {self._settings.address}".rstrip()
            raise FaultError(link_fault(f"The {port} cannot be opened: {why}.")) from error
        self.steps.reached("reach")
        try:
            self._greeting = language.start(link, cancel)
            self.steps.reached("configure")
        except WIRE_TROUBLE as error:
            link.close()
            raise FaultError(link_fault(f"{error}.")) from error
        except Exception as error:
            link.close()
            raise FaultError(driver_fault(error)) from error
        except BaseException:
            link.close()
            raise
        return link, language

    def _start(self, link: Link, language: Language) -> None:
        self._forget()
        self._thread = threading.Thread(
            target=self._read, args=(link, language), name=self.name, daemon=True
        )
        self._thread.start()

    def _forget(self) -> None:
        """Begin to count and to stamp anew."""
        period_s = self._greeting.period_s if self._greeting else 1.0
        numbered = self._greeting is not None and self._greeting.numbered
        self._readout = Readout(self._settings, period_s, self._late_s, numbered=numbered)
        self._stop.clear()
        self._first.clear()
        self._received = self._resynchronised = 0
        self._arrivals.clear()
        self._pace = Arrivals(period_s)

    def _read(self, link: Link, language: Language) -> None:
        """Own the link until told to stop or it is lost; leave a silent sensor behind."""
        good_s, discarded = self._now_s(), language.refusals.discarded
        try:
            while not self._stop.is_set():
                data = link.read(READ_S)
                now_s = self._now_s()
                if self._deliver(language, now_s, data):
                    good_s, before = now_s, discarded
                    discarded = language.refusals.discarded
                    self._resynchronised += discarded > before
                if self._first.is_set() and now_s - good_s > self._settings.silence_s:
                    self._fail(link_fault("The sensor has fallen silent."))
                elif language.refusals.in_a_row >= BAD_LIMIT:
                    self._fail(link_fault("The sensor sends nothing that can be read."))
            language.stop(link)
        except OSError as error:
            self._fail(link_fault(f"The port is lost: {error}."))
        except Exception as error:
            self._fail(driver_fault(error))
            raise
        finally:
            link.close()

    def _deliver(self, language: Language, now_s: float, data: bytes) -> bool:
        readout = self._readout
        stamps, values = readout.accept(now_s, language.take(data))
        if not len(stamps):
            self._pace.look(now_s)
            return False
        self._samples.put(stamps, values)
        self._received += len(stamps)
        self._arrivals.append((now_s, len(stamps)))
        self._pace.note(now_s, len(stamps))
        if self.fault is None and (readout.overload or readout.trouble):
            self._latch(OVERLOAD if readout.overload else sensor_fault(readout.trouble))
        self.steps.reached("first sample")
        self._first.set()
        return True

    def _fail(self, fault: Fault) -> None:
        self._stop.set()
        self._latch(fault)
        self._first.set()

    def _latch(self, fault: Fault) -> None:
        with self._lock:
            self.fault, self._state = fault, DeviceState.FAULT

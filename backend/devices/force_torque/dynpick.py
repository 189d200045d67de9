"""The driver of a Dynpick on a serial port: one thread owns the wire."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Mapping

import numpy as np
import serial

from backend.config.hardware import HardwareSettings
from backend.core.faults import Fault, FaultError
from backend.core.flow import FloatArray
from backend.core.stream import SampleStream
from backend.devices.force_torque.dynpick_samples import DynpickSamples
from backend.devices.protocols import DeviceState, Health, Identity
from backend.wire.dynpick import ZERO_COUNT, Command, decode_sensitivity
from backend.wire.framing import WireError

BAUD = 921_600
READ_BYTES, READ_S = 54, 0.005
"""Two records, or this long: short enough for stamps, long enough not to spin."""
SETTLE_S = 0.05
ANSWER_S = 0.3
SILENCE_S = 0.2
BAD_LIMIT = 20
RATE_WINDOW_S = 1.0
SENSITIVITY_BYTES = 46


class DynpickForceTorque:
    """``port`` is a serial device or a pyserial address; samples are stamped by ``now_s``."""

    name = "force_torque"

    def __init__(self, port: str, settings: HardwareSettings, now_s: Callable[[], float]) -> None:
        self._port_name, self._settings, self._now_s = port, settings, now_s
        self._samples = SampleStream(self.name, 6, 20_000)
        self._thread: threading.Thread | None = None
        self._stop, self._first = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._state = DeviceState.CLOSED
        self._identity: Identity | None = None
        self._sensitivity: tuple[float, ...] = settings.dynpick.sensitivity
        self._reading: DynpickSamples | None = None
        self._received = 0
        self._arrivals: deque[tuple[float, int]] = deque(maxlen=512)
        self.fault: Fault | None = None

    @property
    def state(self) -> DeviceState:
        """Where the connection is in its life."""
        return self._state

    @property
    def identity(self) -> Identity | None:
        """Known once connected; the sensor tells no number, so the port stands for it."""
        return self._identity

    @property
    def samples(self) -> SampleStream:
        """Fx Fy Fz Tx Ty Tz in N and N·m, tool axes."""
        return self._samples

    @property
    def rated(self) -> FloatArray:
        """(6,) half of the counting range, N and N·m."""
        return ZERO_COUNT / np.array(self._sensitivity)

    @property
    def health(self) -> Health:
        """Rate over the last second, age of the newest sample, counts."""
        now_s, arrivals = self._now_s(), list(self._arrivals)
        newest_s = arrivals[-1][0] if arrivals else float("-inf")
        rate_hz = sum(n for t, n in arrivals if t > now_s - RATE_WINDOW_S) / RATE_WINDOW_S
        lost = self._reading.lost if self._reading else 0
        return Health(rate_hz, now_s - newest_s, self._received, lost)

    def describe(self) -> Mapping[str, str | float]:
        """Return port, range and losses."""
        rated = self.rated
        return {
            "kind": "dynpick",
            "port": self._port_name,
            "lost": self.health.lost,
            "rated_n": float(rated[0]),
            "rated_nm": float(rated[3]),
        }

    def connect(self, timeout_s: float, cancel: threading.Event) -> None:
        """Stop an old stream, ask for the sensitivities, start anew; wait for the first sample."""
        if self._state is DeviceState.READY:
            return
        self.close()
        self._state, self.fault = DeviceState.CONNECTING, None
        try:
            port, self._sensitivity = open_port(self._port_name, self._settings, cancel)
            self._start(port)
            if not self._first.wait(timeout_s):
                raise FaultError(link_fault("The sensor sends nothing."))
            self._require_link()
        except FaultError:
            self.close()
            raise
        self._identity = Identity("WACOH-TECH", "Dynpick", self._port_name, "")
        self._settle()

    def close(self) -> None:
        """Stop the stream and let go of the port."""
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

    def _start(self, port: serial.SerialBase) -> None:
        settings = self._settings
        self._reading = DynpickSamples(settings.dynpick, settings.ft, self._sensitivity)
        self._stop.clear()
        self._first.clear()
        self._received = 0
        self._arrivals.clear()
        self._thread = threading.Thread(
            target=self._read, args=(port, self._reading), name="dynpick", daemon=True
        )
        self._thread.start()

    def _read(self, port: serial.SerialBase, reading: DynpickSamples) -> None:
        """Own the port until told to stop or the link is lost; leave a silent sensor behind."""
        good_s = self._now_s()
        try:
            port.timeout = READ_S
            port.write(Command.FILTER_1.value + Command.START.value)
            while not self._stop.is_set():
                data = port.read(READ_BYTES)
                now_s = self._now_s()
                if self._deliver(reading, now_s, data):
                    good_s = now_s
                if self._first.is_set() and now_s - good_s > SILENCE_S:
                    self._fail("The sensor has fallen silent.")
                elif reading.bad_in_a_row >= BAD_LIMIT:
                    self._fail("The sensor sends nothing that can be read.")
            port.write(Command.STOP.value)
        except (serial.SerialException, OSError) as error:
            self._fail(f"The port is lost: {error}.")
        finally:
            port.close()

    def _deliver(self, reading: DynpickSamples, now_s: float, data: bytes) -> bool:
        stamps, values = reading.accept(now_s, data)
        if not len(stamps):
            return False
        self._samples.put(stamps, values)
        self._received += len(stamps)
        self._arrivals.append((now_s, len(stamps)))
        self._first.set()
        if reading.overload and self.fault is None:
            self._latch(OVERLOAD)
        return True

    def _fail(self, what: str) -> None:
        self._stop.set()
        self._latch(link_fault(what))

    def _latch(self, fault: Fault) -> None:
        with self._lock:
            self.fault, self._state = fault, DeviceState.FAULT
        self._first.set()


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "FT-LINK",
        what,
        "No wrench is measured.",
        "Check cable and power of the force/torque sensor, then connect it again.",
        DynpickForceTorque.name,
    )


OVERLOAD = Fault(
    "FT-OVERLOAD",
    "The force/torque sensor is at the end of its range.",
    "Forces above are not measured.",
    "Relieve the sensor, check its zero, then connect it again.",
    DynpickForceTorque.name,
)


def open_port(
    name: str, settings: HardwareSettings, cancel: threading.Event
) -> tuple[serial.SerialBase, tuple[float, ...]]:
    """Open the port, stop an old stream; return it and the sensitivities, told or as set.

    Raises ``FaultError``; the port is closed then.
    """
    try:
        port = serial.serial_for_url(name, BAUD, timeout=ANSWER_S, write_timeout=1.0)
    except (serial.SerialException, OSError) as error:
        raise FaultError(link_fault(f"The port cannot be opened: {error}.")) from error
    try:
        port.write(Command.STOP.value)
        if cancel.wait(SETTLE_S):
            raise FaultError(link_fault("Connecting was cancelled."))
        port.reset_input_buffer()
        port.write(Command.SENSITIVITY.value)
        answer = port.read(SENSITIVITY_BYTES)
        return port, decode_sensitivity(answer) if answer else settings.dynpick.sensitivity
    except FaultError:
        port.close()
        raise
    except (serial.SerialException, OSError, WireError) as error:
        port.close()
        raise FaultError(
            link_fault(f"The sensor does not answer as it should: {error}.")
        ) from error

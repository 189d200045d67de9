"""Built-in force sensor of the arm."""

from __future__ import annotations

import importlib
import math
import struct
import threading
import time
from collections.abc import Sequence
from typing import Protocol

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import (
    Greeting,
    Link,
    NotAnsweredError,
    Reading,
    Refusals,
)
from touchdown.backend.devices.framing import wrench_of
from touchdown.backend.devices.protocols import Identity

SCHEME = "rtde://"
SAMPLE = struct.Struct("<7d")
"""Time of the robot, s; forces, N; torques, N·m."""
LOOKS = 4
"""The connection is looked at so often within one period of the robot."""
START_S = 1.0


class WrenchSource(Protocol):
    """What of ``rtde_receive.RTDEReceiveInterface`` this sensor needs."""

    def getFtRawWrench(self) -> Sequence[float]:  # noqa: N802
        """Return forces in N and torques in N·m, flange axes, with all that hangs on it."""

    def getTimestamp(self) -> float:  # noqa: N802
        """Return the time since the controller was started, s."""

    def isConnected(self) -> bool:  # noqa: N802
        """Whether data still comes."""

    def disconnect(self) -> None:
        """Close."""


class RtdeLink:
    """Hands out each new sample once, as ``SAMPLE``; ``OSError`` as any other link."""

    def __init__(self, source: WrenchSource, period_s: float) -> None:
        self._source, self._look_s = source, period_s / LOOKS
        self._told_s, self._never = -math.inf, threading.Event()

    def read(self, limit_s: float) -> bytes:
        """Return the sample that the robot told last, nothing if that is no new one."""
        end_s = time.monotonic() + limit_s
        while not (data := self._new()) and time.monotonic() < end_s:
            self._never.wait(self._look_s)
        return data

    def _new(self) -> bytes:
        try:
            told_s = self._source.getTimestamp()
            if told_s == self._told_s:
                if not self._source.isConnected():
                    raise ConnectionResetError("the robot has closed the connection")
                return b""
            self._told_s = told_s
            return SAMPLE.pack(told_s, *self._source.getFtRawWrench())
        except (RuntimeError, struct.error) as error:
            raise ConnectionAbortedError(f"the robot tells no wrench ({error})") from error

    def write(self, data: bytes) -> None:
        """Nothing: the robot is not asked."""

    def drain(self) -> None:
        """Nothing waits: only the newest is ever handed out."""

    def close(self) -> None:
        """Close."""
        self._source.disconnect()


def open_source(host: str, rate_hz: float) -> WrenchSource:
    """Connect through ``ur_rtde``; ``OSError`` without the package, ``RuntimeError`` as it does."""
    try:
        receive = importlib.import_module("rtde_receive").RTDEReceiveInterface
    except ImportError as error:
        raise OSError("the package 'ur_rtde' is not installed") from error
    source: WrenchSource = receive(host, rate_hz)
    return source


def open_rtde(settings: HardwareSettings, address: str) -> Link:
    """Open ``address`` (``rtde://host``); raises ``OSError``."""
    rate_hz = settings.ur.rate_hz
    try:
        return RtdeLink(open_source(address.removeprefix(SCHEME), rate_hz), 1.0 / rate_hz)
    except RuntimeError as error:
        raise ConnectionRefusedError(str(error)) from error


class UrLanguage:
    """A gap in the stamps of the robot counts as lost samples."""

    baud = 0
    chunk = SAMPLE.size

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._host = address.removeprefix(SCHEME)
        self._rated, self._period_s = settings.ur.rated, 1.0 / settings.ur.rate_hz
        self._told_s = math.nan
        self._bad = self._bad_in_a_row = 0

    def start(self, link: Link, cancel: threading.Event) -> Greeting:
        """See that samples come; nothing is to be switched on."""
        if cancel.is_set() or not self.take(link.read(START_S)):
            raise NotAnsweredError("The robot tells no wrench of its own sensor")
        identity = Identity("Universal Robots", "built-in F/T", self._host, "")
        return Greeting(identity, self._rated, self._period_s, numbered=True)

    def take(self, data: bytes) -> list[Reading]:
        """Return the sample; one with a number that is none is refused."""
        if not data:
            return []
        told_s, *values = SAMPLE.unpack(data)
        if not all(map(math.isfinite, (told_s, *values))):
            self._bad += 1
            self._bad_in_a_row += 1
            return []
        self._bad_in_a_row = 0
        periods = round((told_s - self._told_s) / self._period_s) if self._told_s < told_s else 1
        self._told_s = told_s
        pairs = zip(values, self._rated, strict=True)
        overload = any(abs(value) >= rated for value, rated in pairs)
        return [Reading(wrench_of(values), max(periods - 1, 0), overload)]

    @property
    def refusals(self) -> Refusals:
        """Samples that were none."""
        return Refusals(self._bad, self._bad_in_a_row, self._bad * SAMPLE.size)

    def stop(self, link: Link) -> None:
        """Nothing: the robot tells it in any case."""

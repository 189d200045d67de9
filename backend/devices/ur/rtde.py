"""Connections to a Universal Robots arm through ``ur_rtde``: control, stop, wrist wrench.

Units: metres, rotation vectors in rad, seconds. STOP has a separate connection and waits for no
other. The wrist sensor has one as well; its samples are numbered by the robot's time stamps.
Source: API reference of ur_rtde 1.6 (sdurobotics.gitlab.io/ur_rtde).
"""

from __future__ import annotations

import contextlib
import importlib
import math
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import FaultError
from touchdown.backend.devices import force_torque
from touchdown.backend.devices.framing import ProtocolError, wrench_of
from touchdown.backend.devices.protocols import Identity, arm_fault


class StopConnection:
    """Thread with a connection to the dashboard for STOP alone."""

    def __init__(self, stopper: DashboardInterface) -> None:
        self._stopper = stopper
        self._asked, self._settled = threading.Event(), threading.Event()
        self._settled.set()
        self._ends = False
        threading.Thread(target=self._run, name="ur-stop", daemon=True).start()

    def press(self) -> None:
        """Request a stop; returns at once."""
        self._settled.clear()
        self._asked.set()

    def settle(self, limit_s: float) -> bool:
        """Wait until every requested stop is answered; return False after the time limit."""
        return self._settled.wait(limit_s)

    def close(self) -> None:
        """End the thread and its connection; does not wait."""
        self._ends = True
        self._asked.set()

    def _run(self) -> None:
        while True:
            self._asked.wait()
            self._asked.clear()
            if self._ends and self._settled.is_set():
                break
            # Without a script there is nothing to stop: the arm stands.
            with contextlib.suppress(RuntimeError):
                self._stopper.stop()
            if not self._asked.is_set():
                self._settled.set()
            if self._ends:
                break
        with contextlib.suppress(RuntimeError):
            self._stopper.disconnect()


RUNNING, NORMAL, REDUCED = 7, 1, 2  # robot mode, and the two safety modes in which the arm may move

# Classes of ur_rtde, which has no types.
ControlInterface: TypeAlias = Any  # rtde_control.RTDEControlInterface: one caller at a time
ReceiveInterface: TypeAlias = Any  # rtde_receive.RTDEReceiveInterface
DashboardInterface: TypeAlias = Any  # dashboard_client.DashboardClient: power, brakes, stop


@dataclass(frozen=True, slots=True)
class UrConnections:
    """The connections of one robot; ``stopper`` carries STOP alone."""

    control: ControlInterface
    receive: ReceiveInterface
    dashboard: DashboardInterface
    stopper: DashboardInterface

    def close(self) -> None:
        """Close all connections but ``stopper``, which its own thread closes."""
        for interface in (self.control, self.receive, self.dashboard):
            interface.disconnect()


# (host, cycles per second) -> connections; raises ``RuntimeError`` like the package.
OpenRobot = Callable[[str, float], UrConnections]


def open_robot(host: str, rate_hz: float) -> UrConnections:
    """Connect through ``ur_rtde``; raises ``FaultError`` without the package, ``RuntimeError``."""
    try:
        dashboards = [
            importlib.import_module("dashboard_client").DashboardClient(host) for _ in range(2)
        ]
        control = importlib.import_module("rtde_control").RTDEControlInterface
        receive = importlib.import_module("rtde_receive").RTDEReceiveInterface
    except ImportError as error:
        raise FaultError(MISSING) from error
    for dashboard in dashboards:
        dashboard.connect()
    return UrConnections(control(host, rate_hz), receive(host, rate_hz), *dashboards)


def identity_of(dashboard: DashboardInterface, host: str) -> Identity:
    """Return the identity of the robot; ``host`` replaces a missing serial number."""
    number = dashboard.getSerialNumber() or host
    return Identity(
        "Universal Robots", dashboard.getRobotModel(), number, dashboard.polyscopeVersion()
    )


MISSING = arm_fault(
    "UR-PACKAGE",
    "The package 'ur_rtde' is not installed.",
    'Install it: pip install "touchdown[ur]".',
    "The arm cannot be reached.",
)


SCHEME = "rtde://"
SAMPLE = struct.Struct("<7d")  # time of the robot, s; forces, N; torques, N·m
POLLS_PER_PERIOD = 4  # polls of the connection per period of the robot
START_S = 1.0


class RtdeLink:
    """Link that returns each new sample once, as ``SAMPLE``; raises ``OSError`` like other
    links.
    """

    def __init__(self, source: ReceiveInterface, period_s: float) -> None:
        self._source, self._look_s = source, period_s / POLLS_PER_PERIOD
        self._told_s, self._never = -math.inf, threading.Event()

    def read(self, limit_s: float) -> bytes:
        """Return the newest sample, empty if it is not new."""
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
        """Do nothing: the robot needs no request."""

    def drain(self) -> None:
        """Do nothing: only the newest sample is returned."""

    def close(self) -> None:
        """Close."""
        self._source.disconnect()


def open_rtde(settings: HardwareSettings, address: str) -> force_torque.SensorLink:
    """Open ``address`` (``rtde://host``); raises ``OSError``."""
    rate_hz = settings.ur.rate_hz
    try:
        receive = importlib.import_module("rtde_receive").RTDEReceiveInterface
        return RtdeLink(receive(address.removeprefix(SCHEME), rate_hz), 1.0 / rate_hz)
    except ImportError as error:
        raise OSError("the package 'ur_rtde' is not installed") from error
    except RuntimeError as error:
        raise ConnectionRefusedError(str(error)) from error


def _decode_sample(data: bytes) -> tuple[float, ...]:
    sample = SAMPLE.unpack(data)
    if not all(map(math.isfinite, sample)):
        raise ProtocolError("number", "sample of the robot")
    return sample


class UrWrenchDriver(force_torque.DatagramDriver):
    """A gap in the robot's time stamps counts as lost samples."""

    baud = 0
    chunk = SAMPLE.size

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__()
        self._settings, self._address = settings, address
        self._rated, self._period_s = settings.ur.rated, 1.0 / settings.ur.rate_hz
        self._told_s = math.nan

    @staticmethod
    def default_address(settings: HardwareSettings) -> str:
        """Return the address of the arm's own sensor."""
        return SCHEME + settings.ur.host

    def open_link(self) -> force_torque.SensorLink:
        """Open the connection of the ``ur_rtde`` package; raises ``OSError``."""
        return open_rtde(self._settings, self._address)

    def start(
        self, link: force_torque.SensorLink, cancel: threading.Event
    ) -> force_torque.SensorDescription:
        """Wait for the first sample; the sensor is always on."""
        if cancel.is_set() or not self.take(link.read(START_S)):
            raise force_torque.NotAnsweredError("The robot tells no wrench of its own sensor")
        identity = Identity(
            "Universal Robots", "built-in F/T", self._address.removeprefix(SCHEME), ""
        )
        return force_torque.SensorDescription(identity, self._rated, self._period_s, numbered=True)

    def take(self, data: bytes) -> list[force_torque.WrenchReading]:
        """Return the sample; rejected if a number is not finite."""
        sample = self.decoded(data, _decode_sample)
        if sample is None:
            return []
        told_s, *values = sample
        periods = round((told_s - self._told_s) / self._period_s) if self._told_s < told_s else 1
        self._told_s = told_s
        return [force_torque.WrenchReading(wrench_of(values), max(periods - 1, 0))]

    def stop(self, link: force_torque.SensorLink) -> None:
        """Do nothing: the robot always sends."""

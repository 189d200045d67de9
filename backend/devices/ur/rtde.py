"""RTDE link, guarded by ur_rtde."""

from __future__ import annotations

import contextlib
import importlib
import math
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices.protocols import Identity
from touchdown.backend.devices.streamed import ARM, HELD, NOTHING_MOVED


class Stopper(Protocol):
    """``dashboard_client.DashboardClient``, of which this lane alone makes use."""

    def stop(self) -> None:
        """End the script on the controller, which brakes the arm; ``RuntimeError`` if none runs."""

    def disconnect(self) -> None:
        """Close."""


class StopLane:
    """One thread that owns one connection to the dashboard."""

    def __init__(self, stopper: Stopper) -> None:
        self._stopper = stopper
        self._asked, self._settled = threading.Event(), threading.Event()
        self._settled.set()
        self._ends = False
        threading.Thread(target=self._run, name="ur-stop", daemon=True).start()

    def press(self) -> None:
        """Ask for a stop; returns at once."""
        self._settled.clear()
        self._asked.set()

    def settle(self, limit_s: float) -> bool:
        """Wait until every stop that was asked for has been answered; return whether it has."""
        return self._settled.wait(limit_s)

    def close(self) -> None:
        """End the thread and its connection; waits for nothing."""
        self._ends = True
        self._asked.set()

    def _run(self) -> None:
        while True:
            self._asked.wait()
            self._asked.clear()
            if self._ends and self._settled.is_set():
                break
            # No script to end is no failure: the arm stands.
            with contextlib.suppress(RuntimeError):
                self._stopper.stop()
            if not self._asked.is_set():
                self._settled.set()
            if self._ends:
                break
        with contextlib.suppress(RuntimeError):
            self._stopper.disconnect()


RUNNING, NORMAL, REDUCED = 7, 1, 2
"""Robot mode, and the two safety modes in which the arm may move."""


class Control(Protocol):
    """``rtde_control.RTDEControlInterface``: one caller at a time."""

    def servoL(  # noqa: N802
        self,
        pose: Sequence[float],
        speed: float,
        acceleration: float,
        time: float,
        lookahead_time: float,
        gain: float,
        /,
    ) -> bool:
        """Go to a pose in base axes within ``time``, smoothly; for one cycle."""

    def servoStop(self, a: float = 10.0) -> bool:  # noqa: N802
        """Brake with ``a`` m/s² and leave servo mode."""

    def setTcp(self, offset: Sequence[float], /) -> bool:  # noqa: N802
        """Set the tool: from the flange to the point that poses are told of."""

    def isPoseWithinSafetyLimits(self, pose: Sequence[float], /) -> bool:  # noqa: N802
        """Whether a pose can be reached within the robot's own safety planes."""

    def isProgramRunning(self) -> bool:  # noqa: N802
        """Whether the script that obeys this interface runs on the controller."""

    def reuploadScript(self) -> bool:  # noqa: N802
        """Start that script again."""

    def setWatchdog(self, min_frequency: float = 10.0) -> bool:  # noqa: N802
        """Let the controller stop by itself if it hears less often than this, Hz."""

    def kickWatchdog(self) -> bool:  # noqa: N802
        """Let it hear."""

    def stopScript(self) -> None:  # noqa: N802
        """End the script on the controller."""

    def disconnect(self) -> None:
        """Close."""


class Receive(Protocol):
    """``rtde_receive.RTDEReceiveInterface``."""

    def getActualTCPPose(self) -> Sequence[float]:  # noqa: N802
        """x, y, z in m and a rotation vector in rad, in base axes."""

    def getTimestamp(self) -> float:  # noqa: N802
        """Time since the controller was started, s."""

    def getRobotMode(self) -> int:  # noqa: N802
        """7 while the motors are on."""

    def getSafetyMode(self) -> int:  # noqa: N802
        """1 normal, 2 reduced; others are stops."""

    def isEmergencyStopped(self) -> bool:  # noqa: N802
        """Whether an emergency stop is pressed."""

    def getSpeedScaling(self) -> float:  # noqa: N802
        """Share of every commanded speed, by the slider of the teach pendant."""

    def isConnected(self) -> bool:  # noqa: N802
        """Whether data still comes."""

    def disconnect(self) -> None:
        """Close."""


class Dashboard(Protocol):
    """``dashboard_client.DashboardClient``: power and brakes."""

    def connect(self, timeout_ms: int = 2000) -> None:
        """Connect."""

    def getSerialNumber(self) -> str:  # noqa: N802
        """Return the number of the robot."""

    def getRobotModel(self) -> str:  # noqa: N802
        """Such as UR5."""

    def polyscopeVersion(self) -> str:  # noqa: N802
        """Version of its software."""

    def powerOn(self) -> None:  # noqa: N802
        """Power up, brakes on."""

    def brakeRelease(self) -> None:  # noqa: N802
        """Release the brakes."""

    def powerOff(self) -> None:  # noqa: N802
        """Motors off, brakes on."""

    def disconnect(self) -> None:
        """Close."""


@dataclass(frozen=True, slots=True)
class Interfaces:
    """The connections of one robot; ``stopper`` carries STOP alone."""

    control: Control
    receive: Receive
    dashboard: Dashboard
    stopper: Stopper

    def close(self) -> None:
        """Close all but the stopper, which its lane closes."""
        for interface in (self.control, self.receive, self.dashboard):
            interface.disconnect()


OpenRobot = Callable[[str, float], Interfaces]
"""(host, cycles per second) -> its connections; raises ``RuntimeError`` as the package does."""


def open_robot(host: str, rate_hz: float) -> Interfaces:
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
    return Interfaces(control(host, rate_hz), receive(host, rate_hz), *dashboards)


def identity_of(dashboard: Dashboard, host: str) -> Identity:
    """Return who the robot says it is; ``host`` stands for a number that it does not tell."""
    number = dashboard.getSerialNumber() or host
    return Identity(
        "Universal Robots", dashboard.getRobotModel(), number, dashboard.polyscopeVersion()
    )


MISSING = Fault(
    "UR-PACKAGE",
    "The package 'ur_rtde' is not installed.",
    "The arm cannot be reached.",
    'Install it: pip install "touchdown[ur]".',
    ARM,
)


def link_fault(what: str) -> Fault:
    """Return the fault of a connection that is not, or no longer, there."""
    return Fault(
        "UR-LINK",
        what,
        "The controller stops the arm by itself; the gripper was not opened.",
        "Check cable, address and remote control of the robot, then connect it again.",
        ARM,
    )


def robot_fault(what: str, code: str = "UR-STOPPED") -> Fault:
    """Return the fault that the robot itself tells of."""
    return Fault(
        code,
        f"{what}.",
        HELD,
        "Clear it at the teach pendant, then connect the arm again.",
        ARM,
    )


def leaning_fault(degrees: float) -> Fault:
    """Return the fault of a hand that does not point straight down."""
    return Fault(
        "TILTED",
        f"The hand leans {degrees:.1f}° away from straight down.",
        NOTHING_MOVED,
        "Point it down with the teach pendant, then connect again.",
        ARM,
    )


SILENT_S = 0.1


class Watch:
    """Of one connection from ``now_s`` on; ``late``: cycles without news."""

    def __init__(self, now_s: float) -> None:
        self._told_s, self._told_at_s = -math.inf, now_s
        self.late = 0

    def has_news(self, receive: Receive, now_s: float) -> bool:
        """Return whether the robot's own clock has gone on since the last cycle."""
        told_s = receive.getTimestamp()
        if told_s == self._told_s:
            self.late += 1
            return False
        self._told_s, self._told_at_s = told_s, now_s
        return True

    def require_healthy(self, receive: Receive, now_s: float) -> None:
        """Raise ``FaultError`` for silence, and for what the robot tells of itself."""
        if now_s - self._told_at_s > SILENT_S or not receive.isConnected():
            raise FaultError(link_fault("The robot tells nothing any more."))
        if receive.isEmergencyStopped():
            raise FaultError(robot_fault("An emergency stop is pressed", "HW-STOP"))
        if receive.getSafetyMode() not in (NORMAL, REDUCED):
            raise FaultError(robot_fault("The robot has stopped by itself (protective stop)"))

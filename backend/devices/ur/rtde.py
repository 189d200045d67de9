"""What the driver needs of the package ``ur_rtde``: metres, rotation vectors in rad, seconds.

Source: API reference of ur_rtde 1.6 (sdurobotics.gitlab.io/ur_rtde).
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from backend.core.faults import Fault, FaultError
from backend.devices.protocols import Identity
from backend.devices.streamed.motion import ARM
from backend.devices.ur.stop_lane import Stopper

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

"""Whether a robot still tells something, and what it tells of itself; no thread, no clock."""

from __future__ import annotations

import math

from backend.core.faults import FaultError
from backend.devices.ur.faults import link_fault, robot_fault
from backend.devices.ur.rtde import NORMAL, REDUCED, Receive

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

"""What a Universal Robots arm tells of itself, in the status words of every arm."""

from __future__ import annotations

from backend.core.faults import Fault
from backend.devices.protocols import ArmStatus, RobotMode, SafetyMode
from backend.devices.ur.rtde import REDUCED, RUNNING, Interfaces


def words_of(robot: Interfaces | None, fault: Fault | None, *, moving: bool) -> ArmStatus:
    """Return the status words; ``robot`` is None while there is no connection."""
    if robot is None:
        return ArmStatus(RobotMode.DISCONNECTED, SafetyMode.UNKNOWN, 0.0, 0)
    mode = RobotMode.MOVING if moving else RobotMode.READY
    if robot.receive.getRobotMode() != RUNNING:
        mode = RobotMode.SERVO_OFF
    safety = SafetyMode.NORMAL
    if fault is not None:
        safety = SafetyMode.HW_STOP if fault.code == "HW-STOP" else SafetyMode.FAULT
    elif robot.receive.getSafetyMode() == REDUCED:
        safety = SafetyMode.REDUCED
    return ArmStatus(mode, safety, robot.receive.getSpeedScaling(), 0)

"""How arm, gripper and wrist sensor stand, as rows for JSON: what the backend shows and asks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple
from typing import Any

from backend.core.faults import Fault, StaleSampleError, TouchdownError
from backend.devices.arrivals import TellsSlow
from backend.devices.homing import Homing
from backend.devices.protocols import Arm, Device, DeviceState, ForceTorqueSensor, Gripper
from backend.devices.steps import Steps
from backend.rig.messages import fault_row, identity_row

Row = dict[str, Any]
POSE_AGE_S = 0.2


def device_row(device: Device) -> Row:
    """Return what changes quickly, of any device."""
    fault, steps = getattr(device, "fault", None), getattr(device, "steps", None)
    return {
        "state": device.state.value,
        "steps": steps.done if isinstance(steps, Steps) else 0,
        "fault": fault_row(fault if isinstance(fault, Fault) else None),
    }


def arm_row(arm: Arm) -> Row:
    """Return the status words, the turn of the hand and the joints; None where not known."""
    status = arm.status()
    row = {
        **device_row(arm),
        "status": [
            status.robot_mode.value,
            status.safety_mode.value,
            status.override,
            status.error,
        ],
        "turn": None,
        "joints": None,
    }
    if arm.state is DeviceState.READY:
        try:
            pose = arm.pose(POSE_AGE_S)
            row["turn"] = [pose.rx_rad, pose.ry_rad, pose.rz_rad]
            row["joints"] = list(arm.joints_rad(POSE_AGE_S)) if arm.rotates else None
        except (StaleSampleError, TouchdownError):
            # The place is not known at present: a reader's own age limit says so.
            return row
    return row


def gripper_row(gripper: Gripper, homing: Homing | None) -> Row:
    """Return width, force, whether a piece is held, and what the operator has to do.

    ``homing``: the gripper again if it is one that is homed.
    """
    return {
        **device_row(gripper),
        "grip": list(astuple(gripper.status())),
        "homed": homing is None or homing.homed,
        "lost_holding": homing is not None and homing.lost_holding,
    }


def sensor_row(sensor: ForceTorqueSensor) -> Row:
    """Return the rated range as well, and since when it has been slow."""
    slow_s = sensor.slow_since_s if isinstance(sensor, TellsSlow) else None
    return {**device_row(sensor), "rated": sensor.rated.tolist(), "slow_since_s": slow_s}


def slow_row(device: Device, now_s: float) -> Row:
    """Return what a person looks at: identity, health with its time, fields of the inspector."""
    health = device.health
    fields: Mapping[str, str | float] = device.describe()
    return {
        "identity": identity_row(device.identity),
        "health": [health.rate_hz, now_s - health.age_s, health.received, health.lost],
        "fields": dict(fields),
    }

"""Diagnostics of a bench at rest: identity of each device, rate of each sensor.

Nothing moves and the arm stays off; no rig process is needed.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import FINGERS, FaultError, Stream
from touchdown.backend.devices import Device, make_tactile
from touchdown.backend.devices.melfa import MelfaArm
from touchdown.backend.rig.process import make_devices

LIMIT_S = 5.0
LISTEN_S = 0.5


@dataclass(frozen=True, slots=True)
class DeviceFinding:
    """Answer of a device; ``fix`` is the remedy if there was none."""

    device: str
    ok: bool
    detail: str
    fix: str


def examine_devices(settings: HardwareSettings) -> Iterator[DeviceFinding]:
    """Yield a finding per device and close it again; raises ``InputError`` for bad settings."""
    made = make_devices(settings, time.monotonic)
    cameras = [
        make_tactile(finger, settings, time.monotonic, Stream(f"tactile_{finger}", 8))
        for finger in FINGERS
    ]
    for device in (made.force_torque, *cameras, made.gripper, made.arm):
        name = device.name
        try:
            detail = _device_detail(device)
        except FaultError as error:
            yield DeviceFinding(name, False, error.fault.what, error.fault.next_step)
        else:
            yield DeviceFinding(name, True, detail, "")


def _device_detail(device: Device) -> str:
    if isinstance(device, MelfaArm):
        who = device.examine()
        return f"{who.maker} {who.model}, {who.firmware}; not switched on"
    with closing(device):
        device.connect(LIMIT_S, threading.Event())
        threading.Event().wait(LISTEN_S)
        identity, health = device.identity, device.health
    named = "" if identity is None else f"{identity.maker} {identity.model}, {identity.serial}; "
    return f"{named}{health.received / LISTEN_S:.0f} Hz"

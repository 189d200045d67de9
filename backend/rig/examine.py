"""A look at each device of a bench, one after the other: nothing moves, the arm stays off.

No rig process is needed for that.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass

from backend.config.hardware import HardwareSettings
from backend.core.faults import FaultError
from backend.core.flow import FINGERS
from backend.core.stream import Stream
from backend.devices.cameras.making import make_tactile
from backend.devices.melfa.arm import MelfaArm
from backend.devices.protocols import Device
from backend.rig.process import make_devices

LIMIT_S = 5.0
LISTEN_S = 0.5


@dataclass(frozen=True, slots=True)
class Finding:
    """What a device answered; ``fix`` says what to do where it did not."""

    device: str
    ok: bool
    detail: str
    fix: str


def examine(settings: HardwareSettings) -> Iterator[Finding]:
    """Yield a finding per device; each is closed again. Raises ``InputError`` for bad settings."""
    made = make_devices(settings, time.monotonic)
    cameras = [
        make_tactile(finger, settings, time.monotonic, Stream(f"tactile_{finger}", 8))
        for finger in FINGERS
    ]
    for device in (made.force_torque, *cameras, made.gripper, made.arm):
        name = device.name
        try:
            detail = _asked(device)
        except FaultError as error:
            yield Finding(name, False, error.fault.what, error.fault.next_step)
        else:
            yield Finding(name, True, detail, "")


def _asked(device: Device) -> str:
    if isinstance(device, MelfaArm):
        who = device.examine()
        return f"{who.maker} {who.model}, {who.firmware}; not switched on"
    try:
        device.connect(LIMIT_S, threading.Event())
        threading.Event().wait(LISTEN_S)
        identity, health = device.identity, device.health
    finally:
        device.close()
    named = "" if identity is None else f"{identity.maker} {identity.model}, {identity.serial}; "
    return f"{named}{health.received / LISTEN_S:.0f} Hz"

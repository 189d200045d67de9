"""Connecting a device again: the same one, or none."""

from __future__ import annotations

import threading

from backend.core.faults import Fault, FaultError
from backend.devices.protocols import Device


def reconnect(device: Device, timeout_s: float, cancel: threading.Event) -> None:
    """Close and connect; raises ``FaultError`` if it fails or another serial number answers.

    After a replug two cameras may have changed places: what was measured before belongs to the
    serial number, so another one is closed again.
    """
    before = device.identity
    device.close()
    device.connect(timeout_s, cancel)
    require_serial(device, "" if before is None else before.serial)


def require_serial(device: Device, serial: str) -> None:
    """Close ``device`` and raise ``FaultError`` if another number than ``serial`` answers.

    "" is any; a device that tells none is taken as it is.
    """
    now = device.identity
    if not serial or now is None or now.serial == serial:
        return
    device.close()
    raise FaultError(
        Fault(
            "OTHER-DEVICE",
            f"Serial number {now.serial} answers instead of {serial}.",
            "The connection was closed again.",
            "Put the device back into its place, or start anew with the other one.",
            device.name,
        )
    )

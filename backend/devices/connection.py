"""Discovery of ports and repeated connection."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import Fault, FaultError
from touchdown.backend.devices.cameras import find_cameras
from touchdown.backend.devices.force_torque_registry import LANGUAGES
from touchdown.backend.devices.protocols import Device
from touchdown.backend.devices.registry import no_driver

SERIAL_PORTS = Path("/dev/serial/by-id")
"""Names that stay the same whichever way cables are plugged in."""


def choices(settings: HardwareSettings, ports: Path = SERIAL_PORTS) -> Mapping[str, list[str]]:
    """Return what may stand under each key of a lab file, by what is here now."""
    gelsight = settings.gelsight
    cameras = find_cameras(Path(gelsight.by_id), Path(gelsight.names), Path(gelsight.nodes))
    serials = [camera.serial for camera in cameras]
    return {
        **drivers(),
        "ft.address": [str(port) for port in sorted(ports.glob("*"))],
        "gelsight.left.serial": serials,
        "gelsight.right.serial": serials,
    }


def drivers() -> Mapping[str, list[str]]:
    """Return the drivers that ship or are installed, by the key of a lab file that names one."""
    return {
        "ft.driver": [*LANGUAGES, *_offered("touchdown.force_torque")],
        "gelsight.driver": ["gelsight", "lerobot", *_offered("touchdown.tactile")],
        "wsg.driver": ["wsg", *_offered("touchdown.gripper")],
        "melfa.driver": ["melfa", "ur", *_offered("touchdown.arm")],
    }


def refuse_unknown_drivers(settings: HardwareSettings, where: str) -> None:
    """Raise ``InputError`` for the first driver that nobody offers; none is loaded."""
    for key, known in drivers().items():
        device, field = key.split(".")
        name = getattr(getattr(settings, device), field)
        if name not in known:
            raise no_driver(name, f"{where}, {key}", known)


def _offered(group: str) -> list[str]:
    return sorted(point.name for point in entry_points(group=group))


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

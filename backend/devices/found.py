"""What can be chosen for the devices of a lab: drivers, serial ports, cameras in sight."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path

from backend.config.hardware import HardwareSettings
from backend.devices.cameras.finding import find_cameras
from backend.devices.force_torque.making import LANGUAGES
from backend.devices.offered import no_driver

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

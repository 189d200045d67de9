"""What can be chosen for the devices of a lab: drivers, serial ports, cameras in sight."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from pathlib import Path

from backend.config.hardware import HardwareSettings
from backend.devices.cameras.finding import find_cameras
from backend.devices.force_torque.making import LANGUAGES

SERIAL_PORTS = Path("/dev/serial/by-id")
"""Names that stay the same whichever way cables are plugged in."""


def choices(settings: HardwareSettings, ports: Path = SERIAL_PORTS) -> Mapping[str, list[str]]:
    """Return what may stand under each key of a lab file, by what is here now."""
    gelsight = settings.gelsight
    cameras = find_cameras(Path(gelsight.by_id), Path(gelsight.names), Path(gelsight.nodes))
    serials = [camera.serial for camera in cameras]
    return {
        "ft.driver": [*LANGUAGES, *_offered("touchdown.force_torque")],
        "ft.address": [str(port) for port in sorted(ports.glob("*"))],
        "gelsight.left.serial": serials,
        "gelsight.right.serial": serials,
        "wsg.driver": ["wsg", *_offered("touchdown.gripper")],
        "melfa.driver": ["melfa", "ur", *_offered("touchdown.arm")],
    }


def _offered(group: str) -> list[str]:
    return sorted(point.name for point in entry_points(group=group))

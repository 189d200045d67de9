"""Choices for the devices of a lab file: drivers, serial ports, attached cameras.

A module of its own because it loads OpenCV, which the real-time process must not.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.gelsight import find_cameras
from touchdown.backend.devices.registry import drivers

SERIAL_PORTS = Path("/dev/serial/by-id")  # links that do not depend on the order of plugging in


def choices(settings: HardwareSettings, ports: Path = SERIAL_PORTS) -> Mapping[str, list[str]]:
    """Return the values that keys of a lab file can take on this computer now."""
    gelsight = settings.gelsight
    cameras = find_cameras(Path(gelsight.by_id), Path(gelsight.names), Path(gelsight.nodes))
    serials = [camera.serial for camera in cameras]
    return {
        **drivers(),
        "ft.address": [str(port) for port in sorted(ports.glob("*"))],
        "gelsight.left.serial": serials,
        "gelsight.right.serial": serials,
    }

"""Choices for the devices of a lab file: drivers, serial ports, attached cameras.

Holds the registry of tactile cameras as well, because camera drivers load OpenCV and the real-time
process must not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib.metadata import entry_points
from pathlib import Path

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import Finger, Stream, TactileFrame
from touchdown.backend.devices.gelsight import TactileCamera, find_cameras
from touchdown.backend.devices.lerobot import make_lerobot
from touchdown.backend.devices.protocols import TactileSensor
from touchdown.backend.devices.registry import (
    WRIST_SENSOR_DRIVERS,
    find_driver,
    unknown_driver_error,
)

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
        "ft.driver": [*WRIST_SENSOR_DRIVERS, *_plugin_names("touchdown.force_torque")],
        "gelsight.driver": ["gelsight", "lerobot", *_plugin_names("touchdown.tactile")],
        "wsg.driver": ["wsg", *_plugin_names("touchdown.gripper")],
        "melfa.driver": ["melfa", "ur", *_plugin_names("touchdown.arm")],
    }


def refuse_unknown_drivers(settings: HardwareSettings, where: str) -> None:
    """Raise ``InputError`` for the first driver that nobody offers; none is loaded."""
    for key, known in drivers().items():
        device, field = key.split(".")
        name = getattr(getattr(settings, device), field)
        if name not in known:
            raise unknown_driver_error(name, f"{where}, {key}", known)


def _plugin_names(group: str) -> list[str]:
    return sorted(point.name for point in entry_points(group=group))


TACTILE_ENTRY_POINTS = "touchdown.tactile"
"""Entry points: name -> callable(finger, settings, now_s, frames) -> ``TactileSensor``."""

TactileMaker = Callable[
    [Finger, HardwareSettings, Callable[[], float], Stream[TactileFrame]], TactileSensor
]


def make_tactile(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileSensor:
    """Return the driver of ``gelsight.driver`` for one finger; raises ``InputError``."""
    shipped: dict[str, TactileMaker] = {"gelsight": _gelsight, "lerobot": make_lerobot}
    maker = find_driver(TACTILE_ENTRY_POINTS, settings.gelsight.driver, shipped, "gelsight.driver")
    return maker(finger, settings, now_s, frames)


def _gelsight(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileCamera:
    return TactileCamera(finger, settings.gelsight, now_s, frames)

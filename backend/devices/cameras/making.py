"""Which tactile cameras a bench file means: GelSight, LeRobot's, others by entry point."""

from __future__ import annotations

from collections.abc import Callable

from backend.config.hardware import HardwareSettings
from backend.core.flow import Finger, TactileFrame
from backend.core.stream import Stream
from backend.devices.cameras.driver import TactileCamera
from backend.devices.cameras.lerobot import make_lerobot
from backend.devices.offered import find_offered
from backend.devices.protocols import TactileSensor

GROUP = "touchdown.tactile"
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
    maker = find_offered(GROUP, settings.gelsight.driver, shipped, "gelsight.driver")
    return maker(finger, settings, now_s, frames)


def _gelsight(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileCamera:
    return TactileCamera(finger, settings.gelsight, now_s, frames)

"""Registry of camera makes."""

from __future__ import annotations

from collections.abc import Callable

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import Finger, Stream, TactileFrame
from touchdown.backend.devices.cameras.driver import TactileCamera
from touchdown.backend.devices.cameras.lerobot import make_lerobot
from touchdown.backend.devices.protocols import TactileSensor
from touchdown.backend.devices.registry import find_offered

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

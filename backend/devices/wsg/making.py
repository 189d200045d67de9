"""Which gripper a bench file means: the WSG, others by entry point."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from backend.config.hardware import HardwareSettings
from backend.devices.offered import find_offered
from backend.devices.protocols import Gripper
from backend.devices.wsg.driver import WsgGripper
from backend.devices.wsg.gcl import GclLanguage
from backend.devices.wsg.language import BinaryLanguage, GripperLanguage

GROUP = "touchdown.gripper"
"""Entry points: name -> callable(settings, now_s) that returns a ``Gripper``."""

GripperMaker = Callable[[HardwareSettings, Callable[[], float]], Gripper]


def make_gripper(settings: HardwareSettings, now_s: Callable[[], float]) -> Gripper:
    """Return the driver of ``wsg.driver``; raises ``InputError``."""
    shipped: dict[str, GripperMaker] = {"wsg": _wsg}
    return find_offered(GROUP, settings.wsg.driver, shipped, "wsg.driver")(settings, now_s)


def _wsg(settings: HardwareSettings, now_s: Callable[[], float]) -> WsgGripper:
    wsg = settings.wsg
    language: Callable[[], GripperLanguage] = BinaryLanguage
    if wsg.protocol == "gcl":
        language = partial(GclLanguage, wsg)
    return WsgGripper(wsg.host, wsg.port, wsg, now_s, language)

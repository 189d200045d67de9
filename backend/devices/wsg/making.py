"""Which gripper a bench file means: the WSG, others by entry point."""

from __future__ import annotations

from collections.abc import Callable

from backend.config.hardware import HardwareSettings
from backend.core.faults import InputError
from backend.devices.offered import find_offered
from backend.devices.protocols import Gripper
from backend.devices.wsg.driver import WsgGripper

GROUP = "touchdown.gripper"
"""Entry points: name -> callable(settings, now_s) that returns a ``Gripper``."""

GripperMaker = Callable[[HardwareSettings, Callable[[], float]], Gripper]


def make_gripper(settings: HardwareSettings, now_s: Callable[[], float]) -> Gripper:
    """Return the driver of ``wsg.driver``; raises ``InputError``."""
    shipped: dict[str, GripperMaker] = {"wsg": _wsg}
    return find_offered(GROUP, settings.wsg.driver, shipped, "wsg.driver")(settings, now_s)


def _wsg(settings: HardwareSettings, now_s: Callable[[], float]) -> WsgGripper:
    wsg = settings.wsg
    if wsg.protocol != "binary":
        raise InputError(
            "The text protocol of the gripper is not driven.",
            "wsg.protocol",
            "Switch the text interface off in the gripper's web page, and set 'binary'.",
        )
    return WsgGripper(wsg.host, wsg.port, wsg, now_s)

"""Which arm a bench file means: the MELFA, one of Universal Robots, others by entry point."""

from __future__ import annotations

from collections.abc import Callable

from backend.config.hardware import HardwareSettings
from backend.core.stream import SampleStream
from backend.devices.melfa.arm import MelfaArm
from backend.devices.melfa.sockets import SocketWires
from backend.devices.offered import find_offered
from backend.devices.protocols import Arm
from backend.devices.ur.arm import UrArm

GROUP = "touchdown.arm"
"""Entry points: name -> callable(settings, now_s, wrench, poses) that returns an ``Arm``."""

ArmMaker = Callable[[HardwareSettings, Callable[[], float], SampleStream, SampleStream], Arm]


def make_arm(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> Arm:
    """Return the driver of ``melfa.driver``; raises ``InputError``.

    ``wrench``: untared samples of the wrist in the axes of the bench; ``poses`` takes what the arm
    measures of ``G``.
    """
    shipped: dict[str, ArmMaker] = {"melfa": _melfa, "ur": _ur}
    maker = find_offered(GROUP, settings.melfa.driver, shipped, "melfa.driver")
    return maker(settings, now_s, wrench, poses)


def _melfa(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> MelfaArm:
    return MelfaArm(SocketWires(settings.melfa, now_s), wrench, settings.melfa, now_s, poses)


def _ur(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> UrArm:
    return UrArm(settings.ur, now_s, wrench, poses)

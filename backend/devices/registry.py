"""Registry of the drivers for arm, gripper, wrist sensor by the name in a bench file.

Shipped drivers first, then those that installed packages offer by entry point. A shipped driver
cannot be replaced. The real-time process loads this module: it must not import cameras, OpenCV or
emulators.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib.metadata import entry_points
from typing import TypeVar

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError, SampleStream
from touchdown.backend.devices.bota import BotaDriver
from touchdown.backend.devices.dynpick import DynpickDriver
from touchdown.backend.devices.force_torque import (
    LATE_S,
    ForceTorqueReader,
    SensorLink,
    WrenchDriver,
    open_link,
)
from touchdown.backend.devices.ft300 import Ft300Driver
from touchdown.backend.devices.leptrino import LeptrinoDriver
from touchdown.backend.devices.melfa import (
    MelfaArm,
    MelfaWrenchDriver,
    SocketLinks,
    monitor_address,
)
from touchdown.backend.devices.netft import NetFtDriver
from touchdown.backend.devices.optoforce import OptoforceDriver
from touchdown.backend.devices.protocols import Arm, Gripper
from touchdown.backend.devices.ur import SCHEME, UrArm, UrWrenchDriver, open_rtde
from touchdown.backend.devices.wsg import BinaryProtocol, GclProtocol, GripperProtocol, WsgGripper

Maker = TypeVar("Maker")


def find_driver(group: str, name: str, shipped: Mapping[str, Maker], where: str) -> Maker:
    """Return what makes the driver ``name``; raises ``InputError`` for one nobody offers.

    A package offers a driver as ``name = "module:callable"`` under the entry points ``group``; one
    that ships cannot be replaced.
    """
    if name in shipped:
        return shipped[name]
    offered = {point.name: point for point in entry_points(group=group)}
    if name not in offered:
        raise unknown_driver_error(name, where, [*shipped, *sorted(offered)])
    try:
        maker: Maker = offered[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"The driver '{name}' cannot be loaded: {error}.", where, "Install its package anew."
        ) from error
    return maker


def unknown_driver_error(name: str, where: str, known: Sequence[str]) -> InputError:
    """Return the error of a driver that none of the installed packages offers."""
    return InputError(
        f"There is no driver '{name}'.",
        where,
        f"Use one of {', '.join(known)}, or install the package that offers it.",
    )


ARM_ENTRY_POINTS = "touchdown.arm"
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
    maker = find_driver(ARM_ENTRY_POINTS, settings.melfa.driver, shipped, "melfa.driver")
    return maker(settings, now_s, wrench, poses)


def _melfa(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> MelfaArm:
    return MelfaArm(SocketLinks(settings.melfa, now_s), wrench, settings.melfa, now_s, poses)


def _ur(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> UrArm:
    return UrArm(settings.ur, now_s, wrench, poses)


WRIST_SENSOR_ENTRY_POINTS = "touchdown.force_torque"
"""Entry points: name -> callable(settings, address) that returns a ``Language``."""

WristSensorMaker = Callable[[HardwareSettings, str], WrenchDriver]
WRIST_SENSOR_DRIVERS: dict[str, WristSensorMaker] = {
    "dynpick": DynpickDriver,
    "leptrino": LeptrinoDriver,
    "ft300": Ft300Driver,
    "bota": BotaDriver,
    "optoforce": OptoforceDriver,
    "netft": NetFtDriver,
    "melfa": MelfaWrenchDriver,
    "ur": UrWrenchDriver,
}


def make_force_torque(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    samples: SampleStream | None = None,
) -> ForceTorqueReader:
    """Return the driver of ``ft.driver`` at ``ft.address``; raises ``InputError``."""
    address = settings.ft.address
    if not address and settings.ft.driver == "melfa":
        address = monitor_address(settings)
    if not address and settings.ft.driver == "ur":
        address = SCHEME + settings.ur.host
    if not address:
        raise InputError(
            "The sensor has no address.", "ft.address", "Name its serial port or host."
        )
    language = find_driver(
        WRIST_SENSOR_ENTRY_POINTS, settings.ft.driver, WRIST_SENSOR_DRIVERS, "ft.driver"
    )
    maker = partial(language, settings, address)
    maker()  # what the settings lack is told now, not at the first connection

    def link(language: WrenchDriver) -> SensorLink:
        if address.startswith(SCHEME):
            return open_rtde(settings, address)
        return open_link(address, baud=language.baud, chunk=language.chunk)

    late_s = LATE_S if "://" in address else max(LATE_S, 1e-3 * settings.serial.latency_ms)
    return ForceTorqueReader(maker, link, settings.ft, now_s, samples, late_s)


GRIPPER_ENTRY_POINTS = "touchdown.gripper"
"""Entry points: name -> callable(settings, now_s) that returns a ``Gripper``."""

GripperMaker = Callable[[HardwareSettings, Callable[[], float]], Gripper]


def make_gripper(settings: HardwareSettings, now_s: Callable[[], float]) -> Gripper:
    """Return the driver of ``wsg.driver``; raises ``InputError``."""
    shipped: dict[str, GripperMaker] = {"wsg": _wsg}
    return find_driver(GRIPPER_ENTRY_POINTS, settings.wsg.driver, shipped, "wsg.driver")(
        settings, now_s
    )


def _wsg(settings: HardwareSettings, now_s: Callable[[], float]) -> WsgGripper:
    wsg = settings.wsg
    language: Callable[[], GripperProtocol] = BinaryProtocol
    if wsg.protocol == "gcl":
        language = partial(GclProtocol, wsg)
    return WsgGripper(wsg.host, wsg.port, wsg, now_s, language)

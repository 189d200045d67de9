"""Factories of drivers: the devices that a lab file names.

The real-time process uses this module. It loads only the makes that the lab file names, and no
OpenCV unless a camera is made.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import Finger, InputError, SampleStream, Stream, TactileFrame
from touchdown.backend.devices.force_torque import (
    LATE_S,
    ForceTorqueReader,
    SensorLink,
    WrenchDriver,
    open_link,
)
from touchdown.backend.devices.identification import load_signatures
from touchdown.backend.devices.protocols import Arm, Gripper, TactileSensor
from touchdown.backend.devices.registry import load_driver


def make_arm(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> Arm:
    """Return the arm that ``melfa.driver`` names.

    Parameters
    ----------
    settings
        Tables of the lab file.
    now_s
        Monotonic clock, s.
    wrench
        Samples of the wrist sensor, N and N·m in bench axes, not tared.
    poses
        Stream that the driver fills with the measured tool centre point.

    Raises
    ------
    InputError
        If there is no such driver, or if a setting is missing.

    """
    arm: Arm = load_driver("arm", settings)(settings, now_s, wrench, poses)
    return arm


def make_gripper(settings: HardwareSettings, now_s: Callable[[], float]) -> Gripper:
    """Return the gripper that ``wsg.driver`` names; raises ``InputError``."""
    make = load_driver("gripper", settings)
    load_signatures()
    gripper: Gripper = make(settings, now_s)
    return gripper


def make_force_torque(
    settings: HardwareSettings, now_s: Callable[[], float], samples: SampleStream | None = None
) -> ForceTorqueReader:
    """Return the reader of the sensor that ``ft.driver`` names at ``ft.address``.

    Parameters
    ----------
    settings
        Tables of the lab file.
    now_s
        Monotonic clock, s.
    samples
        Stream to fill; by default the reader makes one.

    Raises
    ------
    InputError
        If there is no such driver, or if a setting is missing.

    """
    make_driver = load_driver("force_torque", settings)
    default_address = getattr(make_driver, "default_address", None)
    address = settings.ft.address or (default_address(settings) if default_address else "")
    if not address:
        raise InputError(
            "The sensor has no address.", "ft.address", "Name its serial port or host."
        )
    maker = partial(make_driver, settings, address)
    maker()  # reports missing settings now, not at the first connection
    load_signatures()

    def link(driver: WrenchDriver) -> SensorLink:
        own = getattr(driver, "open_link", None)
        return own() if own else open_link(address, baud=driver.baud, chunk=driver.chunk)

    late_s = LATE_S if "://" in address else max(LATE_S, 1e-3 * settings.serial.latency_ms)
    return ForceTorqueReader(maker, link, settings.ft, now_s, samples, late_s)


def make_tactile(
    finger: Finger,
    settings: HardwareSettings,
    now_s: Callable[[], float],
    frames: Stream[TactileFrame],
) -> TactileSensor:
    """Return the camera of one finger that ``gelsight.driver`` names; raises ``InputError``."""
    sensor: TactileSensor = load_driver("tactile", settings)(finger, settings, now_s, frames)
    return sensor

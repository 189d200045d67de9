"""Which driver a bench file means: those that ship by name, others by entry point."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from backend.config.hardware import HardwareSettings
from backend.core.faults import InputError
from backend.core.stream import SampleStream
from backend.devices.force_torque.bota import BotaLanguage
from backend.devices.force_torque.dynpick import DynpickLanguage
from backend.devices.force_torque.ft300 import Ft300Language
from backend.devices.force_torque.language import Language
from backend.devices.force_torque.leptrino import LeptrinoLanguage
from backend.devices.force_torque.links import Link, open_link
from backend.devices.force_torque.melfa_monitor import MelfaLanguage, monitor_address
from backend.devices.force_torque.netft import NetFtLanguage
from backend.devices.force_torque.optoforce import OptoforceLanguage
from backend.devices.force_torque.reader import ForceTorqueReader
from backend.devices.force_torque.readout import LATE_S
from backend.devices.force_torque.ur_builtin import SCHEME, UrLanguage, open_rtde
from backend.devices.offered import find_offered

GROUP = "touchdown.force_torque"
"""Entry points: name -> callable(settings, address) that returns a ``Language``."""

LanguageMaker = Callable[[HardwareSettings, str], Language]
LANGUAGES: dict[str, LanguageMaker] = {
    "dynpick": DynpickLanguage,
    "leptrino": LeptrinoLanguage,
    "ft300": Ft300Language,
    "bota": BotaLanguage,
    "optoforce": OptoforceLanguage,
    "netft": NetFtLanguage,
    "melfa": MelfaLanguage,
    "ur": UrLanguage,
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
    language = find_offered(GROUP, settings.ft.driver, LANGUAGES, "ft.driver")
    maker = partial(language, settings, address)
    maker()  # what the settings lack is told now, not at the first connection

    def link(language: Language) -> Link:
        if address.startswith(SCHEME):
            return open_rtde(settings, address)
        return open_link(address, baud=language.baud, chunk=language.chunk)

    late_s = LATE_S if "://" in address else max(LATE_S, 1e-3 * settings.serial.latency_ms)
    return ForceTorqueReader(maker, link, settings.ft, now_s, samples, late_s)

"""Registry of the makes of wrist sensors."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError, SampleStream
from touchdown.backend.devices.bota import BotaLanguage
from touchdown.backend.devices.dynpick import DynpickLanguage
from touchdown.backend.devices.force_torque import (
    LATE_S,
    ForceTorqueReader,
    Language,
    Link,
    open_link,
)
from touchdown.backend.devices.ft300 import Ft300Language
from touchdown.backend.devices.leptrino import LeptrinoLanguage
from touchdown.backend.devices.melfa import MelfaLanguage, monitor_address
from touchdown.backend.devices.netft import NetFtLanguage
from touchdown.backend.devices.optoforce import OptoforceLanguage
from touchdown.backend.devices.registry import find_offered
from touchdown.backend.devices.ur import SCHEME, UrLanguage, open_rtde

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

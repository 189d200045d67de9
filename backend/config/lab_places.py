"""Where the devices of a lab file answer: an emulated one on this computer, an arm never there.

The window's banner says what the file calls itself, so the file must not be able to lie by mistake.
"""

from __future__ import annotations

import ipaddress
import re
from collections.abc import Iterator
from pathlib import Path

from backend.config.hardware import HardwareSettings
from backend.core.faults import InputError

URL = re.compile(r"(?:socket|udp|tcp)://(?:[^@/]*@)?(?P<host>\[[^\]]+\]|[^:/]+)")
TERMINALS = Path("/dev/pts")
DEVICES, MEMORY = Path("/dev"), Path("/dev/shm")  # noqa: S108 - only compared
"""The other is a place for temporary files, where no device of the system is."""
ARM_HOSTS = {"melfa": "melfa.host", "ur": "ur.host"}
"""Where the arm of each driver answers."""


def refuse_wrong_places(settings: HardwareSettings, kind: str, where: str) -> None:
    """Raise ``InputError`` where ``kind`` ("hardware" or "emulated") and an address disagree."""
    for key, here in _places(settings):
        if kind == "emulated" and not here:
            raise InputError(
                f"Bad value for 'kind': this bench is called emulated, but '{key}' is no place of "
                "an emulated device.",
                where,
                f"Write kind = \"hardware\", or correct '{key}': a whole path, or 127.0.0.1.",
            )
        if kind == "hardware" and here and key == ARM_HOSTS.get(settings.melfa.driver):
            raise InputError(
                "Bad value for 'kind': this bench is called hardware, but its arm answers on this "
                "computer, as emulated ones do.",
                where,
                f"Write kind = \"emulated\", or correct '{key}'.",
            )


def _places(settings: HardwareSettings) -> Iterator[tuple[str, bool]]:
    """Yield (key, whether it is a place on this computer that an emulated device can have)."""
    if settings.melfa.driver == "ur":
        yield "ur.host", is_loopback(settings.ur.host)
    else:
        yield "melfa.host", is_loopback(settings.melfa.host)
    yield "wsg.host", is_loopback(settings.wsg.host)
    # Without an address these two are at the controller of their arm.
    if settings.ft.driver not in ("melfa", "ur") or settings.ft.address:
        yield "ft.address", _is_here(settings.ft.address)
    gelsight = settings.gelsight
    if gelsight.driver != "gelsight":
        # Where cameras of other makes are, their drivers know.
        return
    filmed = bool(gelsight.left.file and gelsight.right.file)
    yield "gelsight.by_id", filmed or not _is_device(Path(gelsight.by_id))


def is_loopback(host: str) -> bool:
    """Whether ``host`` is this computer by the address that only it can reach."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


def _is_here(address: str) -> bool:
    found = URL.match(address)
    if found:
        return is_loopback(found["host"])
    path = Path(address)
    if not path.is_absolute():
        return False
    target = path.resolve()
    # A link whose terminal is gone leads nowhere: then its own place decides.
    return _is_below(target, TERMINALS) or not _is_device(target)


def _is_device(path: Path) -> bool:
    return _is_below(path, DEVICES) and not _is_below(path, MEMORY)


def _is_below(path: Path, folder: Path) -> bool:
    return path == folder or folder in path.parents

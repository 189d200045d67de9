"""The card name of a GelSight Mini, as the system reports it: the way to its serial number."""

from __future__ import annotations

import re
from dataclasses import dataclass

LONGEST = 256


@dataclass(frozen=True, slots=True)
class CardName:
    """Name of a video device; ``serial`` is None if it is no GelSight Mini or cut off."""

    name: str
    serial: str | None
    is_gelsight: bool


def decode(content: bytes) -> CardName:
    """Return what the content of a ``/sys/class/video4linux/*/name`` file says."""
    name = content[:LONGEST].decode("utf-8", "replace").strip("\n\x00 ")
    if "GelSight Mini" not in name:
        return CardName(name, None, is_gelsight=False)
    serial = re.search(r"\b[A-Z0-9]{4}-[A-Z0-9]{4}\b", name)
    return CardName(name, serial[0] if serial else None, is_gelsight=True)

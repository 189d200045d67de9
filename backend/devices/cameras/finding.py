"""Which video device is which camera: by serial number, never by order."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from backend.wire import gelsight_name

BY_ID = "*-index0"
"""The second node of a camera carries no pictures."""


@dataclass(frozen=True, slots=True)
class FoundCamera:
    """A GelSight Mini: its serial number and the path to open."""

    serial: str
    path: Path


def find_cameras(by_id: Path, names: Path, nodes: Path) -> list[FoundCamera]:
    """Return all GelSight Minis, by serial number.

    ``by_id``: the system's folder of stable links; where it has none, ``names``: the folder of
    card names, and ``nodes``: where its devices are. What changes while it is read is left out.
    """
    found = {camera.serial: camera for camera in _by_name(names, nodes)}
    found.update((camera.serial, camera) for camera in _by_id(by_id))
    return [found[serial] for serial in sorted(found)]


def _by_id(folder: Path) -> Iterator[FoundCamera]:
    for link in sorted(folder.glob(BY_ID)):
        card = gelsight_name.decode(link.name.replace("_", " ").encode())
        if card.serial is not None and link.exists():
            yield FoundCamera(card.serial, link)


def _by_name(folder: Path, nodes: Path) -> Iterator[FoundCamera]:
    for entry in sorted(folder.glob("video*"), key=_number):
        try:
            index = (entry / "index").read_text("ascii").strip()
            card = gelsight_name.decode((entry / "name").read_bytes())
        except (OSError, UnicodeDecodeError):
            continue
        if index == "0" and card.serial is not None:
            yield FoundCamera(card.serial, nodes / entry.name)


def _number(entry: Path) -> int:
    digits = re.search(r"\d+$", entry.name)
    return int(digits[0]) if digits else -1

"""Cameras of this computer: discovery and controls."""

from __future__ import annotations

import errno
import os
import re
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from touchdown.backend.config import GelsightSettings
from touchdown.backend.devices.gelsight import decode

QUERY, GET, SET = 0xC0445624, 0xC008561B, 0xC008561C
"""VIDIOC_QUERYCTRL, VIDIOC_G_CTRL, VIDIOC_S_CTRL."""
NEXT = 0x8000_0000
DISABLED, CLASS_TYPE = 0x1, 6
MOST = 256
"""Controls of one camera; no driver has as many."""
MANUAL_EXPOSURE = 1
_INFO = struct.Struct("<II32s4iI8x")
_VALUE = struct.Struct("<Ii")

Ask = Callable[[int, int, bytes], bytes]
"""``ioctl`` of one file: (file, request, content) -> content."""


def lock_controls(
    path: Path, settings: GelsightSettings, ask: Ask | None = None
) -> Mapping[str, float]:
    """Switch the automatics off, set exposure and white balance; return what was read back.

    A control that the camera lacks is left out of the answer; nothing is raised, and nothing
    answered where the system is another one.
    """
    ask = ask or _ioctl()
    if ask is None:
        return {}
    try:
        file = os.open(path, os.O_RDWR | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        return {}
    try:
        known = find_controls(file, ask)
        told = {
            key: _set(file, ask, known, settings.control_names[key], value)
            for key, value in _wanted(settings).items()
            if key in settings.control_names
        }
    except OSError:
        return {}
    finally:
        os.close(file)
    return {key: value for key, value in told.items() if value is not None}


def find_controls(file: int, ask: Ask) -> Mapping[str, int]:
    """Return the id of each control that can be used, by name."""
    found: dict[str, int] = {}
    last = 0
    for _ in range(MOST):
        try:
            content = ask(file, QUERY, _INFO.pack(last | NEXT, 0, b"", 0, 0, 0, 0, 0))
        except OSError as error:
            if error.errno == errno.EINVAL:  # there is no further one
                break
            raise
        last, kind, name, _, _, _, _, flags = _INFO.unpack(content)
        if kind != CLASS_TYPE and not flags & DISABLED:
            found[plain_name(name.partition(b"\0")[0].decode("utf-8", "replace"))] = last
    return found


def plain_name(title: str) -> str:
    """Return "Exposure Time, Absolute" as "exposure_time_absolute"."""
    return "_".join(re.findall(r"[a-z0-9]+", title.lower()))


def _wanted(settings: GelsightSettings) -> Mapping[str, int]:
    """Return the values by key; automatics first, they would bar the others."""
    return {
        "white_balance_auto": 0,
        "exposure_auto": MANUAL_EXPOSURE,
        "exposure_priority": 0,
        "exposure": round(settings.exposure),
        "white_balance": round(settings.white_balance),
    }


def _set(
    file: int, ask: Ask, known: Mapping[str, int], names: tuple[str, ...], value: int
) -> float | None:
    """Set the first of ``names`` that exists and return what it is then."""
    control = next((known[name] for name in names if name in known), None)
    if control is None:
        return None
    try:
        ask(file, SET, _VALUE.pack(control, value))
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ERANGE, errno.EACCES, errno.EBUSY):
            raise
    return float(_VALUE.unpack(ask(file, GET, _VALUE.pack(control, 0)))[1])


def _ioctl() -> Ask | None:
    try:
        import fcntl
    except ImportError:
        return None
    return fcntl.ioctl


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
        card = decode(link.name.replace("_", " ").encode())
        if card.serial is not None and link.exists():
            yield FoundCamera(card.serial, link)


def _by_name(folder: Path, nodes: Path) -> Iterator[FoundCamera]:
    for entry in sorted(folder.glob("video*"), key=_number):
        try:
            index = (entry / "index").read_text("ascii").strip()
            card = decode((entry / "name").read_bytes())
        except (OSError, UnicodeDecodeError):
            continue
        if index == "0" and card.serial is not None:
            yield FoundCamera(card.serial, nodes / entry.name)


def _number(entry: Path) -> int:
    digits = re.search(r"\d+$", entry.name)
    return int(digits[0]) if digits else -1

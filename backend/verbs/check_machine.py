"""Doctor's look at the machine: display, cameras, ports, disk, processors, shipped models."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path

from backend.core.faults import InputError
from backend.verbs.check import Check

LEAST_FREE_GB = 2.0
CAMERAS = Path("/dev/v4l/by-id")
PIECES = ("pot", "mushroom", "barrel")


def check_display() -> Check:
    """Look for a display server that a window can use."""
    if not sys.platform.startswith("linux"):
        return Check("display", True, "native")
    wayland, x11 = os.environ.get("WAYLAND_DISPLAY"), os.environ.get("DISPLAY")
    if wayland or x11:
        return Check("display", True, f"Wayland {wayland}" if wayland else f"X11 {x11}")
    return Check(
        "display",
        True,
        "none: no window can open here",
        "Work without one ('make demo', 'touchdown stack'), or log in to a desktop.",
    )


def check_cameras(folder: Path = CAMERAS) -> Check:
    """Look for tactile cameras by their stable names (index 0; index 1 is metadata)."""
    found = sorted(path.name for path in folder.glob("*-index0")) if folder.is_dir() else []
    if found:
        return Check("cameras", True, ", ".join(found))
    return Check(
        "cameras",
        True,
        "none connected (the simulated bench needs none)",
        "Connect both tactile sensors by USB; add your account to the group 'video'.",
    )


def check_serial_ports() -> Check:
    """Look for serial ports, for a force/torque sensor."""
    from serial.tools import list_ports

    found = [f"{port.device} ({port.description})" for port in list_ports.comports()]
    if found:
        return Check("serial ports", True, ", ".join(sorted(found)))
    return Check(
        "serial ports",
        True,
        "none (the simulated bench needs none)",
        "Connect the sensor; add your account to the group 'dialout'.",
    )


def check_processors() -> Check:
    """Count the processors that this process may use."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    if usable is not None and usable >= 2:
        return Check("processors", True, f"{usable} usable")
    return Check("processors", True, f"{usable} usable", "Use at least 2 for live runs.")


def check_data_folder(folder: Path | None = None) -> Check:
    """Write to the operator's data folder."""
    if folder is None:
        folder = _data_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"touchdown")
    except OSError as error:
        reason = error.strerror or "not writable"
        fix = "Name another folder in TOUCHDOWN_DATA, or give yourself the right to write."
        return Check("data folder", False, f"{folder}: {reason}", fix)
    return Check("data folder", True, str(folder))


def check_disk(folder: Path | None = None) -> Check:
    """Look for room for data where the data folder is (or will be)."""
    place = folder or _data_folder()
    while not place.exists():
        place = place.parent
    free_gb = shutil.disk_usage(place).free / 1e9
    ok = free_gb >= LEAST_FREE_GB
    fix = "" if ok else f"Make room: at least {LEAST_FREE_GB:.0f} GB, or set TOUCHDOWN_DATA."
    return Check("disk", ok, f"{free_gb:.1f} GB free at {place}", fix)


def check_models(folder: Traversable | None = None) -> Check:
    """Look for the shipped models, one per piece."""
    models = files("resources").joinpath("models") if folder is None else folder
    entries = models.iterdir() if models.is_dir() else ()
    shipped = sorted(entry.name for entry in entries if entry.name.endswith(".safetensors"))
    absent = [piece for piece in PIECES if not any(name.startswith(piece) for name in shipped)]
    if absent:
        return Check("models", False, f"missing for {', '.join(absent)}", "make models")
    return Check("models", True, ", ".join(shipped))


def check_catalogue(folder: Path | None = None) -> Check:
    """Read the shipped pieces (and those of ``folder``) and name the first broken file."""
    from backend.objects.catalogue import load_catalogue

    try:
        catalogue = load_catalogue(folder)
    except InputError as error:
        fix = f"{error.fix} A shipped file: install Touchdown again."
        return Check("catalogue", False, f"{error.where}: {error.what}", fix)
    absent = [piece for piece in PIECES if piece not in catalogue.pieces]
    if absent:
        detail = f"no piece file for {', '.join(absent)}"
        return Check("catalogue", False, detail, "Install Touchdown again.")
    return Check("catalogue", True, ", ".join(sorted(catalogue.pieces)))


def _data_folder() -> Path:
    from backend.runs.store import data_folder

    return data_folder()

"""The formats of export by name; each module is imported when its format is used."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from backend.core.faults import InputError
from backend.exchange.exporting import Format, Video, Write

TABLES = ("csv",)
"""Formats that can hold the recorded signals as tables."""
_MODULES: dict[str, tuple[str, bool, Video]] = {
    "lerobot": ("lerobot_v3", True, "sample"),
    "robomimic": ("robomimic", True, "none"),
    "zarr": ("zarr_v3", True, "none"),
    "coco": ("coco", False, "none"),
    "csv": ("tables", False, "none"),
    "jsonl": ("journal_lines", False, "none"),
}
EXPORTS = tuple(_MODULES)


def export_format(name: str, *, tables: bool = False) -> Format:
    """Return the format ``name``; raises ``InputError`` for an unknown one.

    ``tables``: with the recorded signals of every episode, which only csv can hold.
    """
    if name not in _MODULES:
        raise InputError(
            f"There is no format '{name}'.", "format", f"Use one of: {', '.join(EXPORTS)}."
        )
    if tables and name not in TABLES:
        raise InputError(
            f"The format '{name}' holds no tables of signals.", "--tables",
            f"Use {' or '.join(TABLES)}.",
        )  # fmt: skip
    module, signals, video = _MODULES[name]
    write = cast("Write", import_module(f"backend.exchange.{module}").write)
    return Format(name, write, signals, video, tables)

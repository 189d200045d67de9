"""The formats of export by name; each module is imported when its format is used."""

from __future__ import annotations

from importlib import import_module
from typing import cast

from backend.core.faults import InputError
from backend.exchange.exporting import Format, Video, Write

_MODULES: dict[str, tuple[str, bool, Video]] = {
    "lerobot": ("lerobot_v3", True, "sample"),
    "robomimic": ("robomimic", True, "none"),
    "zarr": ("zarr_v3", True, "none"),
    "coco": ("coco", False, "none"),
    "csv": ("tables", False, "none"),
    "jsonl": ("journal_lines", False, "none"),
}
EXPORTS = tuple(_MODULES)


def export_format(name: str) -> Format:
    """Return the format ``name``; raises ``InputError`` for an unknown one."""
    if name not in _MODULES:
        raise InputError(
            f"There is no format '{name}'.", "format", f"Use one of: {', '.join(EXPORTS)}."
        )
    module, signals, video = _MODULES[name]
    write = cast("Write", import_module(f"backend.exchange.{module}").write)
    return Format(name, write, signals, video)

"""What the window remembers: versioned JSON. A bad file never prevents the start."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import cast

from backend.core.files import write_atomically
from widgets.run_panel import RunForm
from widgets.theme import THEMES, ThemeName

VERSION = 1


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """``geometry``: x, y, width, height of the normal window; None: not known."""

    theme: ThemeName = "dark"
    scale: float = 1.0
    geometry: tuple[int, int, int, int] | None = None
    form: RunForm = field(default_factory=RunForm)


def settings_path() -> Path:
    """Return the file: $TOUCHDOWN_CONFIG, else the XDG configuration folder."""
    chosen = os.environ.get("TOUCHDOWN_CONFIG")
    if chosen:
        return Path(chosen) / "window.json"
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "touchdown" / "window.json"


def load_settings(path: Path) -> tuple[WindowSettings, str]:
    """Return (settings, warning); what cannot be read is replaced by its default and named."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return WindowSettings(), ""
    except (OSError, ValueError) as error:
        return WindowSettings(), f"The window settings could not be read ({error}): defaults."
    if not isinstance(raw, dict) or raw.get("version") != VERSION:
        return WindowSettings(), "The window settings are of another version: defaults are used."
    default = WindowSettings()
    dropped: list[str] = []
    theme = raw.get("theme", default.theme)
    if theme not in THEMES:
        theme = default.theme
        dropped.append("theme")
    scale = raw.get("scale", default.scale)
    if not _number(scale) or not 0.8 <= scale <= 2.0:
        scale = default.scale
        dropped.append("scale")
    geometry, good = _geometry(raw.get("geometry"))
    if not good:
        dropped.append("geometry")
    form, bad = _form(raw.get("form", {}))
    dropped += bad
    warning = f"Ignored in the window settings: {', '.join(dropped)}." if dropped else ""
    return WindowSettings(cast("ThemeName", theme), float(scale), geometry, form), warning


def save_settings(path: Path, settings: WindowSettings) -> None:
    """Write the settings; raises OSError."""
    body = {"version": VERSION, **asdict(settings)}
    write_atomically(path, json.dumps(body, indent=1).encode())


def _number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _geometry(raw: object) -> tuple[tuple[int, int, int, int] | None, bool]:
    if raw is None:
        return None, True
    if isinstance(raw, list) and len(raw) == 4 and all(type(v) is int for v in raw):
        x, y, width, height = raw
        if abs(x) < 30_000 and abs(y) < 30_000 and 0 < width < 30_000 and 0 < height < 30_000:
            return (x, y, width, height), True
    return None, False


def _form(raw: object) -> tuple[RunForm, list[str]]:
    if not isinstance(raw, dict):
        return RunForm(), ["form"]
    default, known, dropped = RunForm(), {}, []
    for entry in fields(RunForm):
        value = raw.get(entry.name, getattr(default, entry.name))
        if type(value) is type(getattr(default, entry.name)):
            known[entry.name] = value
        else:
            dropped.append(entry.name)
    return RunForm(**known), dropped

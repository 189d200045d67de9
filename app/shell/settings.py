"""Settings of the window, stored by Qt."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import TypeVar, cast

from touchdown.app.shell.window import CHOICES, ThemeChoice
from touchdown.backend.core import write_atomically

VERSION = 2
Json = dict[str, object]


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """``geometry``: x, y, width, height of the normal window, None if unknown.

    ``front``: the workspace in front. ``keys``: changed keys by command. ``toured``: the tour was
    shown. ``pages``: stored settings of each workspace, validated by the workspace.
    """

    theme: ThemeChoice = "dark"
    scale: float = 1.0
    geometry: tuple[int, int, int, int] | None = None
    front: str = ""
    keys: dict[str, str] = field(default_factory=dict)
    toured: bool = False
    pages: dict[str, Json] = field(default_factory=dict)


Form = TypeVar("Form")


def restore_form(default: Form, memory: Mapping[str, object]) -> tuple[Form, list[str]]:
    """Return (form, names of invalid fields); invalid and missing fields keep their defaults."""
    values = {e.name: getattr(default, e.name) for e in fields(default)}  # type: ignore[arg-type]
    known = {name: memory[name] for name in values if name in memory}
    dropped = [name for name, value in known.items() if type(value) is not type(values[name])]
    valid = {name: value for name, value in known.items() if name not in dropped}
    return type(default)(**(values | valid)), dropped


def settings_path() -> Path:
    """Return the settings file: $TOUCHDOWN_CONFIG, else in the XDG configuration folder."""
    chosen = os.environ.get("TOUCHDOWN_CONFIG")
    if chosen:
        return Path(chosen) / "window.json"
    base = os.environ.get("XDG_CONFIG_HOME") or str(Path.home() / ".config")
    return Path(base) / "touchdown" / "window.json"


def load_settings(path: Path) -> tuple[WindowSettings, str]:
    """Return (settings, warning). Unreadable values are replaced by defaults and named."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return WindowSettings(), ""
    except (OSError, ValueError) as error:
        return WindowSettings(), f"The window settings could not be read ({error}): defaults."
    if not isinstance(raw, dict) or raw.get("version") != VERSION:
        return WindowSettings(), "The window settings are of another version: defaults are used."
    dropped: list[str] = []
    settings = WindowSettings(
        theme=cast("ThemeChoice", _kept(raw, "theme", "dark", lambda v: v in CHOICES, dropped)),
        scale=float(cast("float", _kept(raw, "scale", 1.0, _is_scale, dropped))),
        geometry=_geometry(raw.get("geometry"), dropped),
        front=cast("str", _kept(raw, "front", "", _is_text, dropped)),
        keys=_keys(raw.get("keys", {}), dropped),
        toured=bool(_kept(raw, "toured", True, lambda v: isinstance(v, bool), dropped)),
        pages=_pages(raw, dropped),
    )
    return settings, ignored_words(dropped)


def ignored_words(names: Sequence[str]) -> str:
    """Return the warning for invalid fields, "" for none."""
    return f"Ignored in the window settings: {', '.join(names)}." if names else ""


def save_settings(path: Path, settings: WindowSettings) -> None:
    """Write the settings. Raises ``OSError``."""
    body = {"version": VERSION, **asdict(settings)}
    write_atomically(path, json.dumps(body, indent=1).encode())


def _kept(
    raw: Json, name: str, default: object, good: Callable[[object], bool], dropped: list[str]
) -> object:
    value = raw.get(name, default)
    if good(value):
        return value
    dropped.append(name)
    return default


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_scale(value: object) -> bool:
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return number and 0.8 <= cast("float", value) <= 2.0


def _geometry(raw: object, dropped: list[str]) -> tuple[int, int, int, int] | None:
    if raw is None:
        return None
    if isinstance(raw, list) and len(raw) == 4 and all(type(v) is int for v in raw):
        x, y, width, height = raw
        if abs(x) < 30_000 and abs(y) < 30_000 and 0 < width < 30_000 and 0 < height < 30_000:
            return x, y, width, height
    dropped.append("geometry")
    return None


def _keys(raw: object, dropped: list[str]) -> dict[str, str]:
    if isinstance(raw, dict) and all(isinstance(v, str) for v in raw.values()):
        return dict(raw)
    dropped.append("keys")
    return {}


def _pages(raw: Json, dropped: list[str]) -> dict[str, Json]:
    pages = raw.get("pages", {})
    if not isinstance(pages, dict):
        dropped.append("pages")
        return {}
    dropped += [name for name, page in pages.items() if not isinstance(page, dict)]
    return {name: page for name, page in pages.items() if isinstance(page, dict)}

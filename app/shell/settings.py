"""Settings of the window, stored by Qt."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

from pydantic import Field, TypeAdapter, ValidationError

from touchdown.app.shell.window import ThemeChoice
from touchdown.backend.core import parse_json, write_atomically
from touchdown.widgets.base import tr

VERSION = 2
Json = dict[str, object]


Coordinate = Annotated[int, Field(gt=-30_000, lt=30_000)]
Length = Annotated[int, Field(gt=0, lt=30_000)]


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """``geometry``: x, y, width, height of the normal window, None if unknown.

    ``front``: the workspace in front. ``keys``: changed keys by command. ``toured``: the tour was
    shown. ``calls``: sound and desktop notification call a person. ``pages``: stored settings of
    each workspace, validated by the workspace.
    """

    theme: ThemeChoice = "dark"
    scale: Annotated[float, Field(ge=0.8, le=2.0)] = 1.0
    geometry: tuple[Coordinate, Coordinate, Length, Length] | None = None
    front: str = ""
    keys: dict[str, str] = field(default_factory=dict)
    toured: bool = False
    pages: dict[str, Json] = field(default_factory=dict)
    calls: bool = True


Form = TypeVar("Form")


def restore_form(default: Form, memory: Mapping[str, object]) -> tuple[Form, list[str]]:
    """Return (form, names of invalid fields); invalid and missing fields keep their defaults."""
    values, dropped = dict[str, object](), []
    for name, kind in get_type_hints(type(default), include_extras=True).items():
        if name in memory:
            try:
                values[name] = parse_stored(kind, memory[name])
            except ValidationError:
                dropped.append(name)
    return replace(default, **values), dropped  # type: ignore[type-var]


def parse_stored(kind: Any, stored: object) -> Any:
    """Return a stored JSON value as ``kind``. Raises ``ValidationError`` if it does not fit."""
    return _adapter(kind).validate_json(json.dumps(stored), strict=True)


_adapter = lru_cache(TypeAdapter)


def read_stored(path: Path, version: int, what: str) -> tuple[Json, str]:
    """Return the content of a settings file, {} if it cannot be used, and the reason, if any."""
    try:
        raw = parse_json(path.read_bytes())
    except FileNotFoundError:
        return {}, ""
    except (OSError, ValueError) as error:
        return {}, tr("The {} could not be read ({}).", tr(what), error)
    if not isinstance(raw, dict) or raw.get("version") != version:
        return {}, tr("The {} are of another version.", tr(what))
    return raw, ""


def kept_aside(path: Path, what: str) -> str:
    """Copy a file aside, because the next change overwrites it; return ``what`` with its name."""
    stem, count = f"{path.stem}-aside-{datetime.now():%Y%m%d-%H%M%S}", 1
    kept = path.with_name(f"{stem}.json")
    while kept.exists():
        count += 1
        kept = path.with_name(f"{stem}-{count}.json")
    try:
        write_atomically(kept, path.read_bytes())
    except OSError as error:
        return tr("{} The file could not be kept aside ({}).", what, error)
    return tr("{} The file is kept as {}.", what, kept.name)


def write_stored(path: Path, version: int, values: Any) -> None:
    """Write a dataclass as a settings file. Raises ``OSError``."""
    body = json.dumps({"version": version, **asdict(values)}, indent=1, default=sorted)
    write_atomically(path, body.encode())


def load_settings(path: Path) -> tuple[WindowSettings, str]:
    """Return (settings, warning). Unreadable values are replaced by defaults and named."""
    raw, wrong = read_stored(path, VERSION, "window settings")
    if not raw:
        return WindowSettings(), kept_aside(
            path, tr("{} Defaults are used.", wrong)
        ) if wrong else ""
    pages, dropped = raw.get("pages"), list[str]()
    if isinstance(pages, dict):
        dropped = [name for name, page in pages.items() if not isinstance(page, dict)]
        raw["pages"] = {name: page for name, page in pages.items() if name not in dropped}
    settings, invalid = restore_form(WindowSettings(toured=True), raw)
    ignored = ignored_words([*invalid, *dropped])
    return settings, kept_aside(path, ignored) if ignored else ""


def ignored_words(names: Sequence[str]) -> str:
    """Return the warning for invalid fields, "" for none."""
    return tr("Ignored in the window settings: {}.", ", ".join(names)) if names else ""


def save_settings(path: Path, settings: WindowSettings) -> None:
    """Write the settings. Raises ``OSError``."""
    write_stored(path, VERSION, settings)

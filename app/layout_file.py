"""The layouts of the workspaces on disk: versioned JSON, judged before it is used.

What cannot be used is named in one sentence and kept aside beside the file; it is never lost, and
it never prevents a start.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import cast

from backend.core.files import write_atomically
from widgets.columns import Arrangement

VERSION = 1
LONGEST_NAME = 40
Named = dict[str, Arrangement]


@dataclass(slots=True)
class LayoutBook:
    """``present`` by workspace; ``saved``: by workspace and name. ``locked``: edges stand still."""

    locked: bool = True
    present: Named = field(default_factory=dict)
    saved: dict[str, Named] = field(default_factory=dict)


def load_book(path: Path, now: datetime) -> tuple[LayoutBook, str]:
    """Return (book, notice); a file that makes no sense is moved aside whole."""
    try:
        raw = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return LayoutBook(), ""
    except (OSError, ValueError) as error:
        return LayoutBook(), _aside(path, now, f"The layouts could not be read ({error}).")
    if not isinstance(raw, dict) or raw.get("version") != VERSION:
        return LayoutBook(), _aside(path, now, "The layouts are of another version.")
    try:
        book = LayoutBook(
            locked=bool(raw["locked"]),
            present=_named(raw["present"]),
            saved={name: _named(saved) for name, saved in raw["saved"].items()},
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        return LayoutBook(), _aside(path, now, f"The layouts make no sense ({error}).")
    return book, ""


def save_book(path: Path, book: LayoutBook) -> None:
    """Write all layouts; raises OSError."""
    body = {
        "version": VERSION,
        "locked": book.locked,
        "present": _plain(book.present),
        "saved": {name: _plain(saved) for name, saved in book.saved.items()},
    }
    write_atomically(path, json.dumps(body, indent=1).encode())


def keep_aside(path: Path, now: datetime) -> Path:
    """Copy the file to a name of its own beside it and return that; raises OSError."""
    stem = f"{path.stem}-aside-{now:%Y%m%d-%H%M%S}"
    kept, count = path.with_name(f"{stem}.json"), 1
    while kept.exists():
        count += 1
        kept = path.with_name(f"{stem}-{count}.json")
    write_atomically(kept, path.read_bytes())
    return kept


def _aside(path: Path, now: datetime, what: str) -> str:
    try:
        kept = keep_aside(path, now)
        path.unlink()
    except OSError as error:
        return f"{what} The usual ones are used; the file could not be kept aside ({error})."
    return f"{what} The usual ones are used; the file is kept as {kept.name}."


def _named(raw: dict[str, dict[str, object]]) -> Named:
    return {name: _arrangement(entry) for name, entry in raw.items()}


def _arrangement(raw: dict[str, object]) -> Arrangement:
    shares, hidden = cast("list[object]", raw["shares"]), cast("list[object]", raw["hidden"])
    if not all(isinstance(title, str) for title in hidden):
        raise TypeError("a panel without a title")
    return Arrangement(
        tuple(float(cast("float", share)) for share in shares),
        frozenset(cast("list[str]", hidden)),
    )


def _plain(named: Named) -> dict[str, object]:
    return {
        name: {"shares": [round(s, 5) for s in entry.shares], "hidden": sorted(entry.hidden)}
        for name, entry in named.items()
    }

"""Every change of the limits of a bench, one JSON line each, durable before it takes effect."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

from backend.core.faults import InputError
from backend.core.files import make_folder, sync_folder
from backend.devices.interlock import Limits

NAME = "limits.jsonl"


def changed(before: Limits, after: Limits) -> dict[str, tuple[float, float]]:
    """Return (before, after) of each limit that differs, by name."""
    old, new = asdict(before), asdict(after)
    return {name: (old[name], new[name]) for name in old if old[name] != new[name]}


def write_change(folder: Path, bench: str, person: str, before: Limits, after: Limits) -> None:
    """Append what changes to ``folder/limits.jsonl``; raises ``InputError`` where that fails."""
    line = {
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
        "bench": bench,
        "person": person,
        "changed": {name: list(pair) for name, pair in changed(before, after).items()},
    }
    path = folder / NAME
    try:
        make_folder(folder)
        with path.open("ab") as file:
            file.write(json.dumps(line, allow_nan=False).encode() + b"\n")
            file.flush()
            os.fsync(file.fileno())
        sync_folder(folder)
    except OSError as error:
        raise InputError(
            f"The change of limits cannot be written: {error.strerror or error}.",
            str(path),
            "Make room or name another folder (TOUCHDOWN_DATA); the former limits hold.",
        ) from error

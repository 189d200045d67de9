"""Write a file that must not be there yet: a template is never written over somebody's work."""

from __future__ import annotations

from pathlib import Path

from backend.core.faults import InputError


def write_new(path: Path, text: str) -> None:
    """Write ``text``; ``InputError`` if ``path`` exists or cannot be written."""
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(
            f"The file cannot be written: {error.strerror or error}.",
            str(path),
            "Name a new file in a folder that can be written.",
        ) from error

"""Read typed settings from TOML; a bad file gives one error with file, key and reason."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from backend.core.faults import InputError

Model = TypeVar("Model", bound=BaseModel)
MAX_BYTES = 1_000_000


def read_toml(path: Path) -> dict[str, Any]:
    """Parse ``path``; raises ``InputError`` if it is missing, too large or not TOML."""
    try:
        if path.stat().st_size > MAX_BYTES:
            raise InputError(
                "The file is too large for a settings file.", str(path), "Use a file below 1 MB."
            )
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        reason = error.strerror or "unreadable"
        raise InputError(
            f"Cannot read the file: {reason}.", str(path), "Check the path."
        ) from error
    except UnicodeDecodeError as error:
        raise InputError(
            "The file is not text, so it is no TOML.", str(path), "Name a text file in UTF-8."
        ) from error
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"The file is not valid TOML: {error}.", str(path), "Correct the named line."
        ) from error


def parse(model: type[Model], content: dict[str, Any], where: str) -> Model:
    """Validate ``content``; raises ``InputError`` naming the first bad key and the reason."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"]) or "(file)"
        raise InputError(
            f"Bad value for '{key}': {first['msg']}.", where, f"Correct '{key}'."
        ) from error


def load(model: type[Model], path: Path) -> Model:
    """Read and validate ``path``."""
    return parse(model, read_toml(path), str(path))

"""Reading of TOML and JSON files into settings models.

A bad file raises one error that names the file, the key and the reason.
"""

from __future__ import annotations

import difflib
import tomllib
from pathlib import Path
from typing import Any, TypeGuard, TypeVar

from pydantic import BaseModel, ValidationError

from touchdown.backend.core import InputError, parse_toml, read_limited

Model = TypeVar("Model", bound=BaseModel)
MAX_BYTES = 1_000_000


def read_toml(path: Path) -> dict[str, Any]:
    """Parse ``path``; raises ``InputError`` if it is missing, too large or not TOML."""
    content = read_limited(path, MAX_BYTES, "Check the path; a settings file is below 1 MB.")
    try:
        return parse_toml(content)
    except ValueError as error:
        is_syntax = isinstance(error, tomllib.TOMLDecodeError)
        fix = "Correct the named line." if is_syntax else "Give a TOML file in UTF-8."
        raise InputError(f"The file is not valid TOML: {error}.", str(path), fix) from error


def parse_settings(model: type[Model], content: dict[str, Any], where: str) -> Model:
    """Validate ``content``; raises ``InputError`` naming the first bad key and the reason."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first, key = error.errors()[0], _key(error)
        if first["type"] == "extra_forbidden":
            near = _nearest(model, first["loc"])
            fix = f"Write '{near}' instead." if near else f"Remove '{key}'."
            raise InputError(f"There is no setting '{key}'.", where, fix) from error
        what, fix = f"Bad value for '{key}': {first_error_message(error)}.", f"Correct '{key}'."
        raise InputError(what, where, fix) from error


def read_json_model(model: type[Model], path: Path, limit: int, fix: str) -> Model:
    """Read and validate JSON of at most ``limit`` bytes; raises ``InputError`` with ``fix``."""
    try:
        return model.model_validate_json(read_limited(path, limit, fix))
    except ValidationError as error:
        what = f"The file {path.name} cannot be used: {first_error(error)}."
        raise InputError(what, str(path), fix) from error


def first_error(error: ValidationError) -> str:
    """Return key and message of the first error."""
    return f"'{_key(error)}': {first_error_message(error)}"


def _key(error: ValidationError) -> str:
    return ".".join(str(part) for part in error.errors()[0]["loc"]) or "(file)"


def first_error_message(error: ValidationError) -> str:
    """Return the message of the first error."""
    return error.errors()[0]["msg"].removeprefix("Value error, ")


def _nearest(model: type[BaseModel], place: tuple[int | str, ...]) -> str:
    """Return the known setting most similar to the unknown one at ``place``, or ""."""
    within: object = model
    for part in place[:-1]:
        known = within.model_fields if _is_model(within) else {}
        within = known[part].annotation if part in known else None
    names = list(within.model_fields) if _is_model(within) else []
    found = difflib.get_close_matches(str(place[-1]), names, n=1)
    return ".".join([*map(str, place[:-1]), *found]) if found else ""


def _is_model(kind: object) -> TypeGuard[type[BaseModel]]:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def read_settings(model: type[Model], path: Path) -> Model:
    """Read and validate ``path``."""
    return parse_settings(model, read_toml(path), str(path))

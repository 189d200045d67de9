"""Which program wrote something: kept with every episode, catalogue, export and run."""

from __future__ import annotations

from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version


@lru_cache(maxsize=8)
def version_of(package: str) -> str:
    """Return the version of an installed package, "" if it is not installed."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def program() -> str:
    """Return name and version of this program."""
    return f"touchdown {version_of('touchdown') or '(not installed)'}"

"""Which program and which computer wrote something."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("numpy", "torch")


def program() -> str:
    """Return name and version of this program."""
    return f"touchdown {_version('touchdown') or '(not installed)'}"


def hardware() -> dict[str, object]:
    """Return what a run ran on."""
    return {"machine": platform.machine(), "cores": os.cpu_count(), "system": platform.system()}


def environment() -> dict[str, object]:
    """Return the versions that numbers may depend on."""
    return {"python": platform.python_version(), **{name: _version(name) for name in PACKAGES}}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""

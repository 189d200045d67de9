"""Which computer wrote something, and with which packages."""

from __future__ import annotations

import os
import platform

from backend.core.program import version_of

PACKAGES = ("numpy", "torch")


def hardware() -> dict[str, object]:
    """Return what a run ran on."""
    return {"machine": platform.machine(), "cores": os.cpu_count(), "system": platform.system()}


def environment() -> dict[str, object]:
    """Return the versions that numbers may depend on."""
    return {"python": platform.python_version(), **{name: version_of(name) for name in PACKAGES}}

"""The optional packages of the exchange formats, asked for when they are needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from backend.core.faults import InputError


def need(module: str) -> ModuleType:
    """Import a package of the extra ``exchange``; raises ``InputError`` naming what to install."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise InputError(
            f"The package '{module.partition('.')[0]}' is not installed.",
            "extra 'exchange'",
            "Install it: pip install 'touchdown[exchange]'.",
        ) from error

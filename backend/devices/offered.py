"""Drivers by name: those that ship, then those that installed packages offer by entry point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import entry_points
from typing import TypeVar

from backend.core.faults import InputError

Maker = TypeVar("Maker")


def find_offered(group: str, name: str, shipped: Mapping[str, Maker], where: str) -> Maker:
    """Return what makes the driver ``name``; raises ``InputError`` for one nobody offers.

    A package offers a driver as ``name = "module:callable"`` under the entry points ``group``; one
    that ships cannot be replaced.
    """
    if name in shipped:
        return shipped[name]
    offered = {point.name: point for point in entry_points(group=group)}
    if name not in offered:
        raise no_driver(name, where, [*shipped, *sorted(offered)])
    try:
        maker: Maker = offered[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"The driver '{name}' cannot be loaded: {error}.", where, "Install its package anew."
        ) from error
    return maker


def no_driver(name: str, where: str, known: Sequence[str]) -> InputError:
    """Return the error of a driver that none of the installed packages offers."""
    return InputError(
        f"There is no driver '{name}'.",
        where,
        f"Use one of {', '.join(known)}, or install the package that offers it.",
    )

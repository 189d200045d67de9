"""Selection of rows in dataclasses of batched arrays, one row per probe."""

from __future__ import annotations

from dataclasses import fields
from functools import cache
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray

AXIS_1 = "anchor"  # this array has the probes along axis 1, all others along axis 0


class Rows:
    """Base of dataclasses of arrays and other ``Rows`` with one row per probe.

    Fields of other types are shared by all rows.
    """

    __slots__ = ()

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return the probes ``rows``."""
        parts: dict[str, Any] = {}
        for name in _field_names(type(self)):
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                part = part[:, rows] if name == AXIS_1 else part[rows]
            elif isinstance(part, Rows):
                part = part.take(rows)
            parts[name] = part
        taken: Self = cast(Any, type(self))(**parts)
        return taken

    def put(self, rows: NDArray[np.intp], by: Self) -> None:
        """Overwrite the probes ``rows`` with those of ``by``."""
        for name in _field_names(type(self)):
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                part[(slice(None), rows) if name == AXIS_1 else rows] = getattr(by, name)
            elif isinstance(part, Rows):
                part.put(rows, getattr(by, name))

    def copied(self) -> Self:
        """Return a copy that shares no array."""
        parts: dict[str, Any] = {}
        for name in _field_names(type(self)):
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                part = part.copy()
            elif isinstance(part, Rows):
                part = part.copied()
            parts[name] = part
        made: Self = cast(Any, type(self))(**parts)
        return made

    def replaced(self, rows: NDArray[np.intp], by: Self) -> Self:
        """Return a copy in which the probes ``rows`` are those of ``by``."""
        changed = self.copied()
        changed.put(rows, by)
        return changed


@cache
def _field_names(kind: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))

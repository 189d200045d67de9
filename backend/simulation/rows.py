"""Selection of rows in dataclasses of batched arrays, one row per probe."""

from __future__ import annotations

from dataclasses import Field, replace
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

AXIS_1 = "anchor"  # this array has the probes along axis 1, all others along axis 0


class Rows:
    """Base of dataclasses of arrays and other ``Rows`` with one row per probe.

    Fields of other types are shared by all rows.
    """

    __slots__ = ()
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return the probes ``rows``."""
        parts: list[Any] = []
        for name in self.__dataclass_fields__:
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                part = part.take(rows, axis=1 if name == AXIS_1 else 0)
            elif isinstance(part, Rows):
                part = part.take(rows)
            parts.append(part)
        return type(self)(*parts)

    def put(self, rows: NDArray[np.intp], by: Self) -> None:
        """Overwrite the probes ``rows`` with those of ``by``."""
        for name in self.__dataclass_fields__:
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                part[(slice(None), rows) if name == AXIS_1 else rows] = getattr(by, name)
            elif isinstance(part, Rows):
                part.put(rows, getattr(by, name))

    def copied(self) -> Self:
        """Return a copy that shares no array."""
        parts: dict[str, Any] = {}
        for name in self.__dataclass_fields__:
            part = getattr(self, name)
            if isinstance(part, np.ndarray):
                parts[name] = part.copy()
            elif isinstance(part, Rows):
                parts[name] = part.copied()
        return replace(self, **parts)

    def replaced(self, rows: NDArray[np.intp], by: Self) -> Self:
        """Return a copy in which the probes ``rows`` are those of ``by``."""
        changed = self.copied()
        changed.put(rows, by)
        return changed

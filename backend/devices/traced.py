"""What an arm tells beyond its Protocol: the contact it feels, and one line for a recorder."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

TRACE = (
    *(f"command_{axis}_mm" for axis in "xyz"),
    *(f"measured_{axis}_mm" for axis in "xyz"),
    *(f"sent_j{n}_rad" for n in range(1, 7)),
    *(f"measured_j{n}_rad" for n in range(1, 7)),
    *("phase", "missed", "holds", "moving", "press_n"),
)
"""Names of the values that ``trace`` returns; ``phase`` is the place in the life of the stream."""


@runtime_checkable
class Traced(Protocol):
    """An arm whose stream can be looked into while it runs."""

    @property
    def press_n(self) -> float:
        """Felt press force by the zero of the contact law; NaN without contact."""

    def trace(self) -> tuple[float, ...]:
        """Return the values of ``TRACE`` as they are now."""

"""How far a connection has come: the same four steps for every device on a wire."""

from __future__ import annotations

from typing import Literal, Protocol, runtime_checkable

Step = Literal["reach", "identify", "configure", "first sample"]
STEPS: tuple[Step, ...] = ("reach", "identify", "configure", "first sample")
"""The wire is open; the device is the one that was meant; it is set up; it delivers."""


class Steps:
    """Written by whoever connects, read by anyone."""

    def __init__(self) -> None:
        self.done = 0
        """So many of ``STEPS`` are done."""

    def begin(self) -> None:
        """Start anew."""
        self.done = 0

    def reached(self, step: Step) -> None:
        """Count ``step`` as done, and all before it."""
        self.done = max(self.done, STEPS.index(step) + 1)


@runtime_checkable
class Stepwise(Protocol):
    """A device that says how far its connection has come."""

    @property
    def steps(self) -> Steps:
        """The steps of the present connection."""

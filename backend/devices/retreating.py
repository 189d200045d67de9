"""Arms that draw back from a contact: the reaction to too much force, between holding and STOP."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

RETREAT_MM, RETREAT_MM_S = 2.0, 10.0
RETREATS = frozenset({"FT-TRIP", "FT-OVERLOAD", "CONTACT-STIFF", "CONTACT-SWINGS"})
"""Codes of faults at which an arm that can draws back from the contact; at all others it stops."""


@runtime_checkable
class Retreating(Protocol):
    """An arm that does so by itself, once it is told."""

    def retreat(self) -> None:
        """Rise by ``RETREAT_MM`` from where the arm is, then stand; the motion under way ends.

        From any thread, waits for nothing; where nothing can be driven it is a stop. A press that
        draws back already goes on with that.
        """

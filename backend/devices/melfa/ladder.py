"""What to do when replies stay away: counted in cycles, by missed replies and by time alike.

Time counts too, so that a stall of this program itself is seen as one of the link.
"""

from __future__ import annotations

from enum import IntEnum


class Rung(IntEnum):
    """How far the silence has gone; the higher the worse."""

    GO = 0
    STAND = 1
    """The command stands: nothing is extrapolated."""
    HOLD = 2
    """Stand still from zero speed; goes on by itself when replies return. A press is void."""
    FAULT = 3
    """Latched: end of stream, stop by the command channel."""


STAND_CYCLES = 2
HOLD_CYCLES = 10
FAULT_CYCLES = 29


def rung(missed: int, silent_s: float, cycle_s: float) -> Rung:
    """Return the rung for ``missed`` replies in a row and ``silent_s`` since the last accepted."""
    # The tolerance keeps a cycle that ends exactly now from counting as not yet over.
    cycles = max(missed, int(silent_s / cycle_s + 1e-6))
    if cycles >= FAULT_CYCLES:
        return Rung.FAULT
    if cycles >= HOLD_CYCLES:
        return Rung.HOLD
    return Rung.STAND if cycles >= STAND_CYCLES else Rung.GO

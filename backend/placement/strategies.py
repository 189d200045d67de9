"""The strategies by name."""

from __future__ import annotations

from backend.config.method import StackSettings
from backend.core.faults import InputError
from backend.placement.fused import FusedReasoner
from backend.placement.strategy import XY, Held, PaperReasoner, Reasoner
from backend.placement.zero_wrench import ZeroWrenchReasoner


def begin(held: Held, settings: StackSettings, origin_mm: XY) -> Reasoner:
    """Return the memory of a trial that begins with a probe at ``origin_mm``.

    Raises ``InputError`` for a strategy that concludes nothing from probes.
    """
    if settings.strategy == "fused":
        return FusedReasoner(held, settings, origin_mm)
    if settings.strategy == "zero-wrench":
        return ZeroWrenchReasoner(held, settings, origin_mm)
    if settings.strategy == "pick-and-place":
        raise InputError("This strategy does not probe.", "strategy", "Choose another one.")
    return PaperReasoner(held, settings, origin_mm)

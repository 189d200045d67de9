"""How a trial ended, as its plan returns it."""

from __future__ import annotations

from dataclasses import dataclass

from backend.core.faults import Fault
from backend.core.flow import Outcome


@dataclass(frozen=True, slots=True)
class Ending:
    """Outcome of a trial, the reason in words, and the number of probes.

    ``fault``: what failed once the piece was let go; the outcome holds, the run ends with it.
    """

    outcome: Outcome
    reason: str
    probes: int
    fault: Fault | None = None

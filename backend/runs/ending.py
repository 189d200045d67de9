"""How a trial ended, as its plan returns it."""

from __future__ import annotations

from dataclasses import dataclass

from backend.core.flow import Outcome


@dataclass(frozen=True, slots=True)
class Ending:
    """Outcome of a trial, the reason in words, and the number of probes."""

    outcome: Outcome
    reason: str
    probes: int

"""What one probe left behind, and what the method concluded from it."""

from __future__ import annotations

from dataclasses import dataclass

from backend.core.flow import Episode, PlaceAction, Stability


@dataclass(frozen=True, slots=True)
class Felt:
    """A probe as felt: ``ended_s`` bench time of its last sample, ``sampled_s`` the wall clock then
    (for the decision latency only).
    """

    episode: Episode
    probe: int
    ended_s: float
    sampled_s: float


@dataclass(frozen=True, slots=True)
class Judged:
    """A felt probe with the conclusion, reached at bench time ``at_s`` while still pressed."""

    felt: Felt
    stability: Stability
    action: PlaceAction
    at_s: float

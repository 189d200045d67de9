"""The belief map: contact probabilities of several probes fused in log odds (method 8).

Cells are independent and the bottom does not move, so the recursion of Ota et al. (arXiv
2309.14552) adds the logit of each new estimate to the cells that the face covers. Cells that it
does not cover keep their value: absence of evidence is not evidence of absence.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.config.method import BeliefSettings
from backend.core.faults import InputError
from backend.core.flow import BeliefMap, ContactPatch, FloatArray
from backend.placement.coverage import CellGrid, Evidence, cover


@dataclass(frozen=True, slots=True)
class Belief:
    """The map and the evidence it was built from.

    ``visits`` holds the offset of every probe, replaced ones included; ``evidence`` only those
    that count. ``base_rate`` is the share of contact points in the training data.
    """

    settings: BeliefSettings
    map: BeliefMap
    evidence: tuple[Evidence, ...] = ()
    visits: tuple[tuple[float, float], ...] = ()
    base_rate: float = 0.5

    @classmethod
    def unknown(
        cls,
        settings: BeliefSettings,
        origin_mm: tuple[float, float],
        base_rate: float | None = None,
    ) -> Belief:
        """Return the belief before any probe: probability 0.5 everywhere.

        ``origin_mm`` is the offset of the first probe: cells coincide with its face lattice.
        Raises ``InputError`` if the prior correction is on and the model has no base rate.
        """
        if settings.prior_correction and not (base_rate is not None and 0 < base_rate < 1):
            raise InputError(
                "The prior correction needs the base rate of the model's training data.",
                "belief.prior_correction",
                "Use a model whose card names its base rate, or switch the correction off.",
            )
        reach = math.ceil(settings.half_extent_mm / settings.pitch_mm)
        side = 2 * reach + 1
        corner = (
            origin_mm[0] - reach * settings.pitch_mm,
            origin_mm[1] - reach * settings.pitch_mm,
        )
        grid = CellGrid(corner, settings.pitch_mm, (side, side))
        rate = 0.5 if base_rate is None else base_rate
        return cls(settings, _fused(grid, (), settings.log_odds_limit), base_rate=rate)

    def updated(self, patch: ContactPatch, offset_mm: tuple[float, float]) -> Belief:
        """Return the belief after a probe at ``offset_mm`` (commanded ``F``, frame of the map).

        A probe nearer than ``min_shift_mm`` to former ones replaces them. A patch that is not a
        number everywhere is counted as a visit and changes nothing.
        """
        visits = (*self.visits, offset_mm)
        if not is_finite(patch) or not all(map(math.isfinite, offset_mm)):
            return Belief(self.settings, self.map, self.evidence, visits, self.base_rate)
        grid = CellGrid.of(self.map)
        values = self.log_odds(patch.probability)
        kept = tuple(e for e in self.evidence if not self._repeats(e.offset_mm, offset_mm))
        evidence = (*kept, cover(grid, patch.points_mm, values, offset_mm))
        fused = _fused(grid, evidence, self.settings.log_odds_limit)
        return Belief(self.settings, fused, evidence, visits, self.base_rate)

    def log_odds(self, probability: FloatArray) -> FloatArray:
        """Return the evidence in log odds of ``probability`` (N,): clip, temperature, prior."""
        clip = self.settings.clip
        p = np.clip(probability, clip, 1.0 - clip)
        evidence = np.log(p / (1.0 - p)) / self.settings.temperature
        if self.settings.prior_correction:
            evidence = evidence - math.log(self.base_rate / (1.0 - self.base_rate))
        return np.asarray(evidence, dtype=np.float64)

    def _repeats(self, former: tuple[float, float], new: tuple[float, float]) -> bool:
        return math.dist(former, new) < self.settings.min_shift_mm


def is_finite(patch: ContactPatch) -> bool:
    """Whether the patch holds at least one point and probabilities only; NaN gives False."""
    p = patch.probability
    if not len(p) or not np.isfinite(patch.points_mm).all():
        return False
    return bool(((p >= 0.0) & (p <= 1.0)).all())


def _fused(grid: CellGrid, evidence: tuple[Evidence, ...], limit: float) -> BeliefMap:
    """Add all evidence, then limit: the sum does not depend on the order of the probes."""
    log_odds = np.zeros(grid.shape)
    covered = np.zeros(grid.shape, dtype=np.bool_)
    for item in evidence:
        log_odds += item.log_odds
        covered |= item.covered
    return BeliefMap(
        log_odds=np.clip(log_odds, -limit, limit),
        covered=covered,
        origin_mm=grid.origin_mm,
        pitch_mm=grid.pitch_mm,
        probes=len(evidence),
    )

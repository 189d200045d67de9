"""What one or several models make of an episode: where the face was, and how far they agree.

Members differ in seed or training set. Their displacements are averaged; the variance is that of
the mixture: the mean of the members' own, and what lies between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from backend.core.flow import ContactPatch, Episode
from backend.placement.estimator import Estimator
from backend.placement.offset_fit import OffsetFit, OffsetGrid, mean_entropy


@dataclass(frozen=True, slots=True)
class Opinion:
    """Displacement with its joint sigma, and the mean of the members' patches.

    ``spread_mm``: standard deviation per axis between the members. ``entropy`` of the mean patch
    and ``knowledge``, the part of it that comes from members who differ (BALD), in nat a point.
    """

    fit: OffsetFit
    patch: ContactPatch
    spread_mm: float
    entropy: float
    knowledge: float


class Ensemble:
    """One or more models of one piece; raises ``ValueError`` for none, or for several pieces."""

    def __init__(self, members: Sequence[Estimator]) -> None:
        if len({member.card.piece for member in members}) != 1:
            raise ValueError("an ensemble has members, all of one piece")
        self.members = tuple(members)

    @property
    def weights(self) -> str:
        """The hashes of all members' weights, joined by ``+``."""
        return joined([member.card.weights_sha256 for member in self.members])

    def judge(self, episode: Episode, grid: OffsetGrid) -> Opinion:
        """Return what the members make of ``episode``.

        Raises ``InputError`` or ``ValueError`` where one of them cannot judge it.
        """
        patches = [member.estimate(episode) for member in self.members]
        fits = [grid.fit(patch) for patch in patches]
        p = np.stack([patch.probability for patch in patches])
        mean = ContactPatch(patches[0].points_mm.copy(), p.mean(axis=0))
        entropy = mean_entropy(mean.probability)
        own = float(np.mean([mean_entropy(row) for row in p]))
        fit, spread_mm = mixture(fits)
        return Opinion(fit, mean, spread_mm, entropy, max(entropy - own, 0.0))


def mixture(fits: Sequence[OffsetFit]) -> tuple[OffsetFit, float]:
    """Return the mean displacement with its sigma, and the deviation between ``fits`` per axis."""
    at = np.array([fit.offset_mm for fit in fits], dtype=np.float64)
    between = float(at.var(axis=0).mean())
    own = float(np.mean([fit.sigma_mm**2 for fit in fits]))
    x_mm, y_mm = at.mean(axis=0).tolist()
    return OffsetFit((x_mm, y_mm), math.sqrt(own + between)), math.sqrt(between)


def joined(weights: Sequence[str]) -> str:
    """Return the hashes of weights as one name, whatever their order."""
    return "+".join(sorted(weights))

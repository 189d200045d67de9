"""Tower below the touched surface, as entered by the operator.

The robot feels only the uppermost bottom. The positions of the lower ones are entered (or known
from earlier placements), each with its standard uncertainty. The piece is released only if every
interface below supports it as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import pi

import numpy as np

from touchdown.backend.config import TowerSettings
from touchdown.backend.core import FloatArray, InputError
from touchdown.backend.geometry import Body, Piece, contact_edges, inset_mm, signed_distances_mm

XY = tuple[float, float]
DRAWS = 13  # sampled towers, for the uncertainty of the positions


@dataclass(frozen=True, slots=True)
class SupportTower:
    """Bodies from the lowest to the touched one.

    ``offset_mm``: offset of each body above the lowest from the one below it, with standard
    uncertainty ``sigma_mm`` per axis. ``piece_g``: mass of the piece on top after its release.
    """

    bodies: tuple[Body, ...]
    offset_mm: tuple[XY, ...]
    sigma_mm: float
    piece_g: float

    def __post_init__(self) -> None:
        if len(self.offset_mm) != len(self.bodies) - 1:
            raise ValueError("every body above the lowest needs an offset")

    @classmethod
    def entered(
        cls, piece: Piece, bottoms: Sequence[Piece], entry: TowerSettings
    ) -> SupportTower | None:
        """Return the tower of ``bottoms`` (bottom-up, the last one is touched) from an entry.

        None for a single bottom. Raises ``InputError`` if the entry does not fit.
        """
        joints = len(bottoms) - 1
        if not joints:
            return None
        offset_mm = entry.offset_mm or ((0.0, 0.0),) * joints
        if len(offset_mm) != joints:
            raise InputError(
                f"The tower has {joints} bottoms above the lowest, {len(offset_mm)} were entered.",
                "tower.offset_mm",
                "Enter one offset for each, from the lowest up.",
            )
        bodies = tuple(bottom.body() for bottom in bottoms)
        return cls(bodies, offset_mm, entry.sigma_mm, piece.mass_g)

    def insets_mm(self, centre_mm: FloatArray) -> FloatArray:
        """Return the inset (DRAWS, ...) of the load in the weakest lower support.

        ``centre_mm`` (..., 2): centre of mass of the piece relative to the touched body. The inset
        of an interface is the distance to the nearest edge of the hull of its overlap, negative
        outside; the edges of the overlap of two convex faces are edges of the faces.
        """
        draws = normal_draws(len(self.offset_mm))
        return np.stack([self._least(centre_mm, draw) for draw in draws])

    def _least(self, centre_mm: FloatArray, draw: FloatArray) -> FloatArray:
        """Return the inset (...,) of one tower; ``draw`` (joints, 2) standard normal."""
        steps = np.array(self.offset_mm, dtype=np.float64).reshape(-1, 2) + self.sigma_mm * draw
        # positions of the bodies, the touched one at the origin
        climbed = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
        at = climbed - climbed[-1]
        least = np.full(centre_mm.shape[:-1], np.inf)
        moment, mass = self.piece_g * centre_mm, self.piece_g
        for k in range(len(self.bodies) - 1, -1, -1):
            body = self.bodies[k]
            moment = moment + body.mass_g * (at[k] + np.asarray(body.com_xy_mm))
            mass += body.mass_g
            if body.fixed:
                continue
            load = moment / mass
            upper = self.bodies[k - 1].upper if k else None
            if upper is not None and "region" in (body.lower.kind, upper.kind):
                step_x, step_y = (at[k] - at[k - 1]).tolist()
                contact = _contact_edges(body.lower, (step_x, step_y), 0.0, upper)
                least = np.minimum(least, signed_distances_mm(load - at[k - 1], contact))
                continue
            least = np.minimum(least, inset_mm(body.lower, load - at[k]))
            if upper is not None:
                least = np.minimum(least, inset_mm(upper, load - at[k - 1]))
        return least


_contact_edges = lru_cache(maxsize=256)(contact_edges)  # the draws of a tower stay the same


@lru_cache(maxsize=4)
def normal_draws(joints: int) -> FloatArray:
    """Return (DRAWS, joints, 2) evenly spread standard normal values, always the same ones.

    A sunflower pattern per joint, in a different order for each joint.
    """
    k = (np.arange(DRAWS)[:, None] * (2 * np.arange(joints) + 1)[None, :]) % DRAWS
    reach = np.sqrt(-2.0 * np.log1p(-(k + 0.5) / DRAWS))
    angle = k * pi * (3.0 - 5.0**0.5)
    return np.stack([reach * np.cos(angle), reach * np.sin(angle)], axis=-1)

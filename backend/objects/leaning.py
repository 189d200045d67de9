"""Towers of several bottoms: how far the upper ones stand off, whether a piece can stand there.

Drawn in one way for the tables, the live simulated bench and every test: the same seed, the same
tower.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from backend.objects.catalogue import Piece
from backend.objects.tower import Tower, judge

LEAN_MM = 6.0
"""An upper bottom stands off the lower one by 0 to this, uniformly, in any direction."""
PLACES_MM = 2.0
"""Pitch of the places at which a stable position of the piece is looked for."""


def draw_tower(rng: np.random.Generator, bottoms: Sequence[Piece]) -> Tower:
    """Stand ``bottoms`` (bottom-up) on each other, the upper ones leaning; raises ``InputError``.

    One bottom draws nothing. The tower need not stand.
    """
    tower = Tower((bottoms[0].body(),))
    for piece in bottoms[1:]:
        x, y = tower.bodies[-1].at_mm
        reach, angle = rng.uniform(0.0, LEAN_MM), rng.uniform(0.0, 2.0 * math.pi)
        at = (x + reach * math.cos(angle), y + reach * math.sin(angle))
        tower = tower.with_top(piece.body(at))
    return tower


def placeable(piece: Piece, tower: Tower) -> bool:
    """Whether the tower stands, and would with ``piece`` at some place of a coarse grid."""
    if not judge(tower).stands:
        return False
    carrier = tower.bodies[-1]
    if carrier.upper is None:
        return False
    reach = max(carrier.upper.half_extents_mm)
    steps = PLACES_MM * np.arange(-(reach // PLACES_MM), reach // PLACES_MM + 1)
    places = sorted(((x, y) for x in steps for y in steps), key=lambda p: math.hypot(*p))
    return any(
        judge(tower.with_top(piece.body((carrier.at_mm[0] + x, carrier.at_mm[1] + y)))).stands
        for x, y in places
    )

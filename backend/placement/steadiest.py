"""Where on a leaning tower the piece would stand best, by all that is believed of the tower."""

from __future__ import annotations

import numpy as np

from backend.placement.below import Below
from backend.placement.outline_belief import OutlineBelief
from backend.placement.outline_family import inset_mm

XY = tuple[float, float]
DRAWN = 120
REACH_MM, PITCH_MM = 5.0, 1.0
"""Places round the middle of the touched surface that are compared."""


def steadiest_mm(outlines: OutlineBelief, below: Below, risk: float) -> XY:
    """Return the place of the centre of mass whose margin at ``risk`` is the largest."""
    middle = np.asarray(outlines.centre_mm())
    steps = np.arange(-REACH_MM, REACH_MM + PITCH_MM, PITCH_MM)
    around = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    drawn = outlines.drawn(DRAWN)
    relative = middle + around - np.array([centre for _, centre in drawn])[:, None]
    top = np.stack([inset_mm(o, r) for (o, _), r in zip(drawn, relative, strict=True)])
    margins = np.minimum(top, below.insets_mm(relative)).reshape(-1, len(around))
    at_risk = np.quantile(margins, risk, axis=0)
    best = middle + around[int(at_risk.argmax())]
    return float(best[0]), float(best[1])

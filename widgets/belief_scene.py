"""What the belief view shows after one probe: values only, made by the presenter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.core.flow import BeliefMap, FloatArray, Stability

LEAST_HALF_MM = 10.0
NO_PROBE = "No probe in this trial yet", "The map fills in with the first press."


@dataclass(frozen=True, slots=True)
class BeliefScene:
    """One look at the belief map, in the frame ``O``, mm.

    ``path``: face centres of the probes so far, oldest first. ``face``: (k, 2) outline of the
    piece around its face centre. ``truth``: (k, 2) outline of the true overlap, set only after
    the trial on a simulated bench. ``empty``: what stands in place of a map, and why.
    """

    belief: BeliefMap | None = None
    stability: Stability | None = None
    path: tuple[tuple[float, float], ...] = ()
    step_mm: tuple[float, float] | None = None
    target_mm: tuple[float, float] | None = None
    clipped: bool = False
    face: FloatArray | None = None
    truth: FloatArray | None = None
    delta: float = 0.9
    empty: tuple[str, str] = NO_PROBE

    def frame_mm(self) -> tuple[float, float, float]:
        """Centre x, y and half width of the square worth showing: covered cells and the path."""
        points = [np.array(self.path).reshape(-1, 2)]
        if self.belief is not None:
            points.append(self.belief.cell_centres_mm()[self.belief.covered])
        shown = np.concatenate(points)
        if len(shown) == 0:
            return 0.0, 0.0, LEAST_HALF_MM
        low, high = shown.min(axis=0), shown.max(axis=0)
        centre = (low + high) / 2
        half = max(LEAST_HALF_MM, float((high - low).max()) / 2 + 2.0)
        return float(centre[0]), float(centre[1]), half

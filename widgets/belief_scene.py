"""What the belief view shows after one probe: values only, made by the presenter."""

from __future__ import annotations

from dataclasses import dataclass

from backend.core.flow import BeliefMap, FloatArray, Stability


@dataclass(frozen=True, slots=True)
class BeliefScene:
    """One look at the belief map, in the frame ``O``, mm.

    ``path``: face centres of the probes so far, oldest first. ``face``: (k, 2) outline of the
    piece around its face centre. ``truth``: (k, 2) outline of the true overlap, set only after
    the trial on a simulated bench.
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

    def half_extent_mm(self) -> float:
        """Half width of the square worth showing: covered cells and the path, at least 14 mm."""
        reach = [14.0]
        if self.belief is not None and self.belief.covered.any():
            centres = self.belief.cell_centres_mm()[self.belief.covered]
            reach.append(float(abs(centres).max()) + 2.0)
        reach += [max(abs(x), abs(y)) + 2.0 for x, y in self.path]
        return max(reach)

"""Release at zero wrench: no learning, no belief. Lets go where the push does not turn the piece.

After "Precise Object Placement Using Force-Torque Feedback" (arXiv 2404.17668): where the moment of
the contact force about the centre of mass vanishes, the support is taken to lie under it. Divided
by the force that moment is a length: how far from the centre of mass the push acts.
"""

from __future__ import annotations

import math

import numpy as np

from backend.config.method import StackSettings
from backend.core.flow import TACTILE_CHANNELS, ContactPatch, PlaceAction, Stability, SupportKind
from backend.placement.balance import pressed_at_mm
from backend.placement.belief import Belief
from backend.placement.policy import Aim, give_up, situation, towards
from backend.placement.strategy import XY, Conclusion, Held, Touched
from backend.placement.targets import next_on_spiral


class ZeroWrenchReasoner:
    """Steps towards where the push acts; the network's estimate is not looked at."""

    def __init__(self, held: Held, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings, self._lever_mm = held, settings, held.lever_mm()
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._felt: list[tuple[XY, float]] = []

    def conclude(self, touched: Touched) -> Conclusion:
        """Release where the push acts under the centre of mass; else follow it."""
        here, com = touched.offset_mm, self._held.com_xy_mm
        unknown = ContactPatch(touched.patch.points_mm, np.full(len(touched.patch.points_mm), 0.5))
        self._belief = self._belief.updated(unknown, here)
        wrench = touched.observation[:, TACTILE_CHANNELS:].astype(np.float64)
        at = pressed_at_mm(wrench, self._lever_mm)
        felt = bool(np.isfinite(at).all())
        acts = np.asarray(here) + at if felt else np.zeros((0, 2))
        apart_mm = math.hypot(at[0] - com[0], at[1] - com[1]) if felt else math.inf
        self._felt.append((here, apart_mm))
        stability = Stability(
            self._vanishes(apart_mm),
            -apart_mm,
            SupportKind.POINT if felt else SupportKind.NONE,
            acts.reshape(-1, 2),
            (here[0] + com[0], here[1] + com[1]),
            "patch",
        )
        target = (float(acts[0] - com[0]), float(acts[1] - com[1])) if felt else here
        return Conclusion(self._belief.map, stability, self._choose(stability, target, here))

    def stable_at(self, offset_mm: XY) -> bool:
        """Judge by the presses made there; elsewhere it knows nothing."""
        nearest_mm = self._settings.belief.min_shift_mm
        there = [a for place, a in self._felt if math.dist(place, offset_mm) <= nearest_mm]
        return bool(there) and self._vanishes(there[-1])

    def likely_at(self, offset_mm: XY) -> bool:
        """Judge alike: there is no belief that could be weighed otherwise."""
        return self.stable_at(offset_mm)

    def _vanishes(self, apart_mm: float) -> bool:
        return apart_mm <= self._settings.zero_wrench.release_mm

    def _choose(self, stability: Stability, target: XY, here: XY) -> PlaceAction:
        policy, words = self._settings.policy, situation(stability)
        if stability.stable:
            return PlaceAction("release", (0.0, 0.0), None, False, f"{words}: release.")
        if len(self._felt) >= policy.max_probes:
            count = len(self._felt)
            return give_up(f"{words} after {count} probes, the most allowed: giving up.")
        aim = Aim(target, "")
        if math.dist(here, target) < self._settings.belief.min_shift_mm:
            aim = Aim(next_on_spiral(here, self._belief, policy), "looking around")
        return towards(stability, aim, here, policy.longest_step_mm, 0.0)

"""Strategies that believe in whole outlines: release by risk, step to where the support must be."""

from __future__ import annotations

from dataclasses import replace
from math import dist

import numpy as np

from backend.config.method import StabilitySettings, StackSettings
from backend.core.flow import (
    TACTILE_CHANNELS,
    BeliefMap,
    FloatArray,
    PlaceAction,
    Stability,
    SupportKind,
)
from backend.placement import looking
from backend.placement.balance import centre_of_pressure_mm
from backend.placement.belief import Belief, is_finite
from backend.placement.coverage import CellGrid
from backend.placement.outline_belief import OutlineBelief, pressed_within
from backend.placement.policy import Aim, give_up, situation, towards
from backend.placement.stability import judge
from backend.placement.steadiest import steadiest_mm
from backend.placement.strategy import XY, Conclusion, Held, Touched
from backend.placement.targets import next_on_spiral

FIRST_TICK, LAST_TICKS = 0, slice(-4, None)
LEAST_RISE_N = 2.0
"""A press that gains less than this says nothing of where it acts."""


class OutlineReasoner:
    """Weighs displaced outlines by the fused map, with ``pressure`` also by where presses acted.

    With ``looking`` the next press is where its outcome decides most, not nearest to the middle.
    """

    def __init__(
        self,
        held: Held,
        settings: StackSettings,
        origin_mm: XY,
        *,
        pressure: bool,
        looking: bool = False,
    ) -> None:
        self._held, self._settings = held, settings
        self._lever_mm = held.lever_mm() if pressure else None
        self._looking = looking
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._pressed: FloatArray | float = 0.0
        self._outlines: OutlineBelief | None = None

    def conclude(self, touched: Touched) -> Conclusion:
        """Fuse, weigh the outlines, judge by the accepted risk, choose."""
        settings, rules, here = self._settings, self._settings.outlines, touched.offset_mm
        self._belief = self._belief.updated(touched.patch, here)
        if not is_finite(touched.patch):
            stability = judge(
                self._belief, touched.patch, self._held.com_xy_mm, here, StabilitySettings()
            )
            return Conclusion(self._belief.map, stability, give_up(NOTHING))
        if self._lever_mm is not None:
            self._note(touched, self._lever_mm)
        outlines = OutlineBelief.given(self._belief.map, rules.weight, self._pressed)
        self._outlines = outlines
        centre = self._com_at(here)
        margin_mm = outlines.margin_mm(centre, rules.risk, self._held.below)
        stability = Stability(
            margin_mm >= rules.inset_mm,
            margin_mm,
            SupportKind.AREA,
            outlines.likeliest_mm(),
            centre,
            settings.stability.judge_from,
        )
        action = self._choose(stability, outlines, touched)
        return Conclusion(self._shown(outlines), stability, action)

    def stable_at(self, offset_mm: XY) -> bool:
        """Judge by the accepted risk there."""
        rules, outlines = self._settings.outlines, self._outlines
        if outlines is None:
            return False
        margin_mm = outlines.margin_mm(self._com_at(offset_mm), rules.risk, self._held.below)
        return margin_mm >= rules.inset_mm

    def likely_at(self, offset_mm: XY) -> bool:
        """Judge by the median margin there."""
        outlines = self._outlines
        if outlines is None:
            return False
        return outlines.margin_mm(self._com_at(offset_mm), 0.5, self._held.below) > 0.0

    def _com_at(self, offset_mm: XY) -> XY:
        com = self._held.com_xy_mm
        return offset_mm[0] + com[0], offset_mm[1] + com[1]

    def _note(self, touched: Touched, lever_mm: float) -> None:
        at = pressed_at_mm(touched.observation[:, TACTILE_CHANNELS:].astype(np.float64), lever_mm)
        if np.isfinite(at).all():
            x, y = np.asarray(touched.offset_mm) + at
            grid, sd_mm = CellGrid.of(self._belief.map), self._settings.outlines.pressure_sd_mm
            self._pressed = self._pressed + pressed_within(grid, (float(x), float(y)), sd_mm)

    def _choose(
        self, stability: Stability, outlines: OutlineBelief, touched: Touched
    ) -> PlaceAction:
        here = touched.offset_mm
        policy, required = self._settings.policy, self._settings.outlines.inset_mm
        words = situation(stability, required)
        if stability.stable:
            why = f"{words}: release. {_standing(outlines, here)}"
            return PlaceAction("release", (0.0, 0.0), None, False, why)
        probes = len(self._belief.visits)
        if probes >= policy.max_probes:
            return give_up(f"{words} after {probes} probes, the most allowed: giving up.")
        target = self._target(outlines)
        if self._looking:
            aim = Aim(self._look(outlines, target, touched), "where it decides most")
            return towards(stability, aim, here, policy.longest_step_mm, required)
        aim = Aim(target, "")
        if np.hypot(target[0] - here[0], target[1] - here[1]) < self._settings.belief.min_shift_mm:
            aim = Aim(next_on_spiral(here, self._belief, policy), "looking around")
        return towards(stability, aim, here, policy.longest_step_mm, required)

    def _target(self, outlines: OutlineBelief) -> XY:
        """Return where the face should come to: the centre of mass over the middle of the support,
        or over the place that the whole tower carries best.
        """
        below, com = self._held.below, self._held.com_xy_mm
        aim = outlines.centre_mm()
        if below is not None:
            aim = steadiest_mm(outlines, below, self._settings.outlines.risk)
        return aim[0] - com[0], aim[1] - com[1]

    def _look(self, outlines: OutlineBelief, target: XY, touched: Touched) -> XY:
        settings, here = self._settings, touched.offset_mm
        longest_mm, nearest_mm = settings.policy.longest_step_mm, settings.belief.min_shift_mm
        reached = looking.places(here, target, longest_mm)
        new = [p for p in reached if all(dist(p, v) >= nearest_mm for v in self._belief.visits)]
        if not new:
            return next_on_spiral(here, self._belief, settings.policy)
        patch = touched.patch
        sure = float(np.abs(self._belief.log_odds(patch.probability)).mean())
        question = looking.Question(
            patch.points_mm, self._held.com_xy_mm, sure, target, self._held.below
        )
        values = looking.worth(
            outlines, question, new, longest_mm, settings.outlines, settings.looking
        )
        return new[int(values.argmax())]

    def _shown(self, outlines: OutlineBelief) -> BeliefMap:
        """Return the probability of support as a map; what no probe covered is believed as well."""
        limit = self._settings.belief.log_odds_limit
        p = outlines.support()
        with np.errstate(divide="ignore"):
            log_odds = np.clip(np.log(p) - np.log1p(-p), -limit, limit)
        return replace(self._belief.map, log_odds=log_odds)


def _standing(outlines: OutlineBelief, here: XY) -> str:
    """Say where the piece will stand: what an entry needs when the next one comes on top."""
    x, y = np.subtract(here, outlines.centre_mm())
    return f"It stands {x:+.1f}, {y:+.1f} mm from the middle, sigma {outlines.spread_mm():.1f} mm."


NOTHING = "The model returned no usable estimate: giving up without a release."


def pressed_at_mm(wrench: FloatArray, lever_mm: float) -> FloatArray:
    """Return (2,) where a press acted, in ``F``: the centre of pressure without slow sensor errors.

    ``wrench`` (20, 6) in N and N·m at the sensor, ``lever_mm`` above the face. The offset left by
    the tare (several mm of centre) is the same at all ticks: the growth from the first tick, when
    hardly anything presses, to the last ones does not contain it. NaN where the press hardly grows.
    """
    growth = wrench[LAST_TICKS].mean(axis=0) - wrench[FIRST_TICK]
    return centre_of_pressure_mm(growth, lever_mm, LEAST_RISE_N)

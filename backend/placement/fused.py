"""The strategy of learned fusion: a network reads all probes of the trial at once.

It says how far any point lies within the support, as a distribution. Released where the centre of
mass lies within in all but an accepted share; otherwise a step towards where it would lie deepest.
On a tower both hold for every interface below as well, as far as its operator knows them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from backend.config.method import FusedSettings, StackSettings
from backend.core.flow import (
    TACTILE_CHANNELS,
    BeliefMap,
    FloatArray,
    PlaceAction,
    Stability,
    SupportKind,
)
from backend.learning.fused.checkpoint import FusedCheckpoint, load_fused, shipped_fused
from backend.learning.fused.forward import FusedForward, Inset
from backend.learning.fused.summary import TICKS, Face, felt_at
from backend.placement.belief import Belief
from backend.placement.lower import Lower, Middle, disc_of, holding, middle_of
from backend.placement.policy import Aim, give_up, situation, towards
from backend.placement.stability import support_hull_mm
from backend.placement.strategy import XY, Conclusion, Held, Touched
from backend.placement.targets import next_on_spiral

NOTHING = "The signals are no numbers, or unlike all it learned from: giving up without a release."
NO_CONTACT = "No contact was found"
EVEN = 0.5
FARTHEST_MM = 14.0
"""Farther from the last probe the network was asked too seldom to be followed."""
STEPS_MM = np.arange(-15.0, 15.0, 0.05)


class FusedReasoner:
    """Keeps the signals of all probes; asks the network anew after each."""

    def __init__(self, held: Held, settings: StackSettings, origin_mm: XY) -> None:
        found = network_of(settings.fused)
        self._forward = FusedForward(found.arrays, found.shape)
        self._held, self._settings = held, settings
        self._sensor_mm = held.lever_mm() - held.grip_height_mm
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._seen: list[FloatArray] = []
        self._offset_mm: list[XY] = []
        self._missed_mm: list[XY] = []
        self._last: FloatArray | None = None
        self._lower: Lower | None = None

    def conclude(self, touched: Touched) -> Conclusion:
        """Ask about the place and the map, judge by the accepted risk, choose."""
        settings, here = self._settings, touched.offset_mm
        self._belief = self._belief.updated(touched.patch, here)
        self._offset_mm.append(here)
        self._seen.append(np.asarray(touched.observation[TICKS, :], dtype=np.float64))
        com = self._held.com_xy_mm
        centre = here[0] + com[0], here[1] + com[1]
        known = self._last = self._known(touched.patch.points_mm)
        if known is None:
            nothing = Stability(
                False, np.nan, SupportKind.NO_ESTIMATE, np.zeros((0, 2)), centre, "belief"
            )
            return Conclusion(self._belief.map, nothing, give_up(NOTHING))
        cells = (self._belief.map.cell_centres_mm() - np.asarray(here)).reshape(-1, 2)
        over = self._inset(known, cells, here)
        near = np.hypot(*(cells - com).T) <= FARTHEST_MM
        reached, cells = Inset(*(part[near] for part in over.parts())), cells[near]
        middle = self._note_middle(reached, cells + here)
        margin_mm = self._margin_mm(self._inset(known, np.array([com]), here), centre)
        shown = self._shown(over)
        stability = Stability(
            margin_mm >= settings.fused.inset_mm,
            margin_mm,
            SupportKind.AREA,
            support_hull_mm(replace(self._belief, map=shown), shown.log_odds > 0.0),
            centre,
            "belief",
        )
        target = deepest(self._expected_mm(reached, cells + here), cells - com)
        action = self._choose(stability, target, middle)
        return Conclusion(shown, stability, action)

    def inset_at(self, offset_mm: XY) -> Inset | None:
        """Return how far in the support the centre of mass would lie there; None before a probe."""
        if self._last is None:
            return None
        here, com = self._offset_mm[-1], self._held.com_xy_mm
        point = offset_mm[0] - here[0] + com[0], offset_mm[1] - here[1] + com[1]
        return self._inset(self._last, np.array([point]), here)

    def missed(self, offset_mm: XY) -> PlaceAction:
        """Go half way back to where something was last felt; before that, round in a spiral.

        A place without contact counts as a probe.
        """
        policy = self._settings.policy
        self._missed_mm.append(offset_mm)
        if self._probes() >= policy.max_probes:
            return give_up(f"{NO_CONTACT} after {self._probes()} probes, the most allowed.")
        last = self._offset_mm[-1] if self._offset_mm else offset_mm
        to = 0.5 * (last[0] + offset_mm[0]), 0.5 * (last[1] + offset_mm[1])
        where = "half way back"
        if math.dist(to, offset_mm) < self._settings.belief.min_shift_mm:
            tried = replace(self._belief, visits=(*self._offset_mm, *self._missed_mm))
            first = self._offset_mm[0] if self._offset_mm else self._missed_mm[0]
            to, where = next_on_spiral(first, tried, policy), "looking around"
        step = to[0] - offset_mm[0], to[1] - offset_mm[1]
        clipped = math.hypot(*step) > policy.longest_step_mm
        part = policy.longest_step_mm / math.hypot(*step) if clipped else 1.0
        step = step[0] * part, step[1] * part
        words = f"{NO_CONTACT} ({where}): move {math.hypot(*step):.1f} mm."
        return PlaceAction("shift", step, to, clipped, words)

    def stable_at(self, offset_mm: XY) -> bool:
        """Ask about another place of the face."""
        inset = self.inset_at(offset_mm)
        if inset is None:
            return False
        margin_mm = self._margin_mm(inset, self._com_at(offset_mm))
        return margin_mm >= self._settings.fused.inset_mm

    def likely_at(self, offset_mm: XY) -> bool:
        """Whether the whole tower would stand there rather than fall."""
        inset = self.inset_at(offset_mm)
        if inset is None:
            return False
        return bool(holding(inset, self._lower, self._com_at(offset_mm), np.zeros(1))[0] > EVEN)

    def _com_at(self, offset_mm: XY) -> XY:
        com = self._held.com_xy_mm
        return offset_mm[0] + com[0], offset_mm[1] + com[1]

    def _probes(self) -> int:
        return len(self._belief.visits) + len(self._missed_mm)

    def _known(self, points_mm: FloatArray) -> FloatArray | None:
        """Return what is known after all probes; None if there is a signal that cannot be read."""
        seen = np.stack(self._seen).astype(np.float32)
        if not np.isfinite(seen).all():
            return None
        held = self._held
        com = np.asarray(held.com_xy_mm, dtype=np.float64)
        face = Face.of(points_mm, com, np.asarray(held.grip_height_mm))
        fields = seen[..., :TACTILE_CHANNELS]
        wrench = felt_at(seen[..., TACTILE_CHANNELS:], self._sensor_mm)
        known = self._forward.known(wrench, fields, np.array(self._offset_mm), face)
        return np.asarray(known[-1], dtype=np.float64) if np.isfinite(known).all() else None

    def _inset(self, known: FloatArray, points_mm: FloatArray, here: XY) -> Inset:
        away = np.subtract(here, self._offset_mm[0])
        return self._forward.inset(known, points_mm, away)

    def _note_middle(self, over: Inset, places_mm: FloatArray) -> Middle:
        """Return the middle of the touched face, frame of the map; keep what lies below it.

        ``places_mm`` (n, 2), likewise: of which the network says ``over``.
        """
        below = self._held.below
        face = None if below is None else below.bodies[-1].upper
        face = face or disc_of(over, self._settings.belief.pitch_mm**2)
        middle = middle_of(over, places_mm, face)
        self._lower = None if below is None else Lower(below, middle)
        return middle

    def _margin_mm(self, top: Inset, centre_mm: XY) -> float:
        """Return the inset of one place that is not reached with the accepted risk."""
        holds = holding(top, self._lower, centre_mm, STEPS_MM)
        kept = np.flatnonzero(holds >= 1.0 - self._settings.fused.risk)
        return float(STEPS_MM[kept[-1]]) if len(kept) else float(STEPS_MM[0])

    def _expected_mm(self, over: Inset, places_mm: FloatArray) -> FloatArray:
        """Return (n,) how deep the centre of mass is expected to lie in the shallowest interface.

        Over ``places_mm`` (n, 2), frame of the map, of which the network says ``over``.
        """
        if self._lower is None:
            return over.expected_mm()
        lower = self._lower.insets_mm(places_mm).mean(axis=0)
        return np.asarray(np.minimum(over.expected_mm(), lower))

    def _choose(self, stability: Stability, target: XY, middle: Middle) -> PlaceAction:
        here = self._offset_mm[-1]
        policy, required = self._settings.policy, self._settings.fused.inset_mm
        words = situation(stability, required)
        if stability.stable:
            why = f"{words}: release. {middle.standing(here)}"
            return PlaceAction("release", (0.0, 0.0), None, False, why)
        probes = self._probes()
        if probes >= policy.max_probes:
            return give_up(f"{words} after {probes} probes, the most allowed: giving up.")
        to = here[0] + target[0], here[1] + target[1]
        aim = Aim(to, "")
        if np.hypot(*target) < self._settings.belief.min_shift_mm:
            aim = Aim(next_on_spiral(here, self._belief, policy), "looking around")
        return towards(stability, aim, here, policy.longest_step_mm, required)

    def _shown(self, over: Inset) -> BeliefMap:
        """Return the probability of support as a map."""
        limit, shape = self._settings.belief.log_odds_limit, self._belief.map.log_odds.shape
        p = over.exceeds(0.0).reshape(shape)
        with np.errstate(divide="ignore"):
            log_odds = np.clip(np.log(p) - np.log1p(-p), -limit, limit)
        return replace(self._belief.map, log_odds=log_odds)


def network_of(settings: FusedSettings) -> FusedCheckpoint:
    """Return the network that the settings name; raises ``InputError``."""
    return load_fused(Path(settings.weights)) if settings.weights else shipped_fused()


def deepest(expected_mm: FloatArray, shifts_mm: FloatArray) -> XY:
    """Return the shift that brings the centre of mass where it is expected to lie deepest.

    ``expected_mm`` (n,): how deep after each of ``shifts_mm`` (n, 2) from here.
    """
    x, y = shifts_mm[int(expected_mm.argmax())]
    return float(x), float(y)

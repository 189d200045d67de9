"""Placement strategies: from the estimate of a probe to belief, verdict and next action.

`make_strategy` chooses one by name: the paper's, learned fusion, zero wrench. A strategy keeps the
belief of one trial; it sees observations only, never the bottom. Zero wrench follows "Precise
Object Placement Using Force-Torque Feedback" (arXiv 2404.17668).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from math import pi, sqrt
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import FusedSettings, StackSettings
from touchdown.backend.core import (
    TACTILE_CHANNELS,
    BeliefMap,
    ContactPatch,
    FloatArray,
    InputError,
    PlaceAction,
    Stability,
    SupportKind,
)
from touchdown.backend.geometry import Outline, circle, inset_mm
from touchdown.backend.learning.fused import (
    TICKS,
    FusedCheckpoint,
    FusedForward,
    GraspedFace,
    InsetDistribution,
    load_fused,
    shipped_fused,
    wrench_at_sensor,
)
from touchdown.backend.placement.belief import Belief
from touchdown.backend.placement.equilibrium import pressed_at_mm
from touchdown.backend.placement.policy import (
    ShiftTarget,
    choose_action,
    describe_situation,
    give_up,
    judge_stability,
    next_on_spiral,
    shift_towards,
    support_hull_mm,
)
from touchdown.backend.placement.support_tower import SupportTower, normal_draws

XY = tuple[float, float]
AROUND_MM = 10.0  # the middle is looked for so far around the point that is expected to lie deepest
# Points so near the edge tell by how much the middle may be off: their inset moves with it.
EDGE_MM = 4.0
NUDGE_MM = 0.05
REFINED = 4
LEAST_SD_MM = 0.3  # nothing is trusted to be nearer than this


@dataclass(frozen=True, slots=True)
class FaceCentre:
    """The middle of the touched face, ``at_mm``, known within ``sigma_mm`` along x and along y."""

    at_mm: XY
    sigma_mm: float

    def standing(self, face_mm: XY) -> str:
        """Say where the piece will stand: what an entry needs when the next one comes on top."""
        x, y = np.subtract(face_mm, self.at_mm)
        return f"It stands {x:+.1f}, {y:+.1f} mm from the middle, sigma {self.sigma_mm:.1f} mm."

    def drawn(self) -> FloatArray:
        """Return (k, 2) places where it may be, spread evenly: the same ones every time."""
        return np.asarray(np.asarray(self.at_mm) + self.sigma_mm * normal_draws(1)[:, 0])


@dataclass(frozen=True, slots=True)
class LowerSupport:
    """What ``below`` leaves, wherever its uppermost face has its middle."""

    below: SupportTower
    middle: FaceCentre

    def insets_mm(self, points_mm: FloatArray) -> FloatArray:
        """Return (k, n): how far within the weakest support below the load lies, for each draw.

        ``points_mm`` (n, 2): the piece's centre of mass, in the frame of the middle.
        """
        relative = points_mm - self.middle.drawn()[:, None]
        return self.below.insets_mm(relative).reshape(-1, len(points_mm))


def holding_probability(
    top: InsetDistribution, lower: LowerSupport | None, centre_mm: XY, least_mm: FloatArray
) -> FloatArray:
    """Return (n,) how likely the load lies more than each of ``least_mm`` (n,) within all supports.

    ``top``: how far the centre of mass, at ``centre_mm``, lies within the touched face. With a
    ``lower`` part at least so likely, whatever the interfaces have in common: ways to fall add up.
    """
    repeated = InsetDistribution(*(np.repeat(part, len(least_mm), axis=0) for part in top.parts()))
    reached = repeated.exceeds(least_mm)
    if lower is None:
        return reached
    insets = np.sort(lower.insets_mm(np.array([centre_mm])).ravel())
    falls = np.searchsorted(insets, least_mm, side="right") / len(insets)
    return np.asarray(np.maximum(reached - falls, 0.0), dtype=np.float64)


def fit_face_centre(over: InsetDistribution, points_mm: FloatArray, face: Outline) -> FaceCentre:
    """Return where the middle of the touched ``face`` is, from insets ``over`` points (n, 2) in mm.

    The middle fits the expected insets best; how much they vary near the edge tells how well it is
    known.
    """
    expected, variance = over.expected_mm(), over.variance_mm2()
    weight = 1.0 / np.maximum(variance, LEAST_SD_MM**2)
    start = points_mm[int(expected.argmax())]
    steps = np.arange(-AROUND_MM, AROUND_MM + 1.0)
    around = start + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    misfit = (inset_mm(face, points_mm - around[:, None]) - expected) ** 2 @ weight
    at = around[int(np.argmin(misfit))]
    for _ in range(REFINED):
        slope = _slope(face, points_mm - at)
        off = expected - inset_mm(face, points_mm - at)
        normal = (slope * weight[:, None]).T @ slope + LEAST_SD_MM**2 * np.eye(2)
        at = at + np.linalg.solve(normal, (slope * weight[:, None]).T @ off)
    inset = inset_mm(face, points_mm - at)
    near = np.abs(inset) <= EDGE_MM
    varies = (variance + (expected - inset) ** 2)[near]
    sigma_mm = sqrt(float(varies.mean())) if near.any() else AROUND_MM
    return FaceCentre((float(at[0]), float(at[1])), max(sigma_mm, LEAST_SD_MM))


def _slope(face: Outline, relative: FloatArray) -> FloatArray:
    """Return (n, 2): by how much the inset grows as the middle moves along x and along y."""
    moved = [NUDGE_MM * np.eye(2)[axis] for axis in range(2)]
    ways = [inset_mm(face, relative - m) - inset_mm(face, relative + m) for m in moved]
    return np.asarray(np.stack(ways, axis=-1) / (2.0 * NUDGE_MM), dtype=np.float64)


def equivalent_disc(over: InsetDistribution, cell_mm2: float) -> Outline:
    """Return a disc as large as the cells of ``over`` that rather lie within the touched face."""
    within = float((over.expected_mm() > 0.0).sum())
    return circle(2.0 * sqrt(max(within, 1.0) * cell_mm2 / pi))


@dataclass(frozen=True, slots=True)
class GraspedPiece:
    """What a strategy knows of the grasped piece before the first probe.

    ``com_xy_mm``: centre of mass in ``F``; ``grip_height_mm``: pivot above the face;
    ``base_rate``: share of contact in the training data of the model, None without a model.
    ``sensor_height_mm``: wrist sensor above the pivot, as the bench tells; None if it does not.
    ``below``: the tower under the touched surface as entered, None if nobody told of one.
    """

    com_xy_mm: XY
    grip_height_mm: float
    base_rate: float | None = None
    sensor_height_mm: float | None = None
    below: SupportTower | None = None

    def lever_mm(self) -> float:
        """Return the height of the sensor above the face; raises ``InputError`` if nobody told."""
        if self.sensor_height_mm is None:
            raise InputError(
                "This strategy needs the height of the wrist sensor above the grasp pivot.",
                "mounting.sensor_height_mm",
                "Tell it in the lab file, or choose another strategy.",
            )
        return self.grip_height_mm + self.sensor_height_mm


@dataclass(frozen=True, slots=True)
class ProbeObservation:
    """One probe: ``observation`` (20, 258) as the model saw it, the ``patch`` that it estimated,
    and the commanded ``offset_mm`` of the face (frame of the map).
    """

    observation: NDArray[np.float32]
    patch: ContactPatch
    offset_mm: XY


@dataclass(frozen=True, slots=True)
class PlaceDecision:
    """What follows from all probes so far: the ``map`` as believed, the verdict here, the move."""

    map: BeliefMap
    stability: Stability
    action: PlaceAction


class Strategy(Protocol):
    """The memory of one trial."""

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Take the next probe; return what follows."""

    def stable_at(self, offset_mm: XY) -> bool:
        """Whether all probes so far would have it released with the face at ``offset_mm``."""

    def likely_at(self, offset_mm: XY) -> bool:
        """Whether it would there rather stand than fall, whatever risk a release may take."""


@runtime_checkable
class SearchingStrategy(Strategy, Protocol):
    """The memory of one trial by a strategy to which a place without contact is no end."""

    def missed(self, offset_mm: XY) -> PlaceAction:
        """Take note that no contact was found at ``offset_mm``; return the shift, or the end."""


class PaperStrategy:
    """Ota et al.: independent cells, hull of the confident ones, step towards its middle."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings = held, settings
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._patch: ContactPatch | None = None

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Fuse, judge, choose."""
        settings, here = self._settings, touched.offset_mm
        self._belief, self._patch = self._belief.updated(touched.patch, here), touched.patch
        stability = judge_stability(
            self._belief, touched.patch, self._held.com_xy_mm, here, settings.stability
        )
        action = choose_action(stability, self._belief, here, settings.policy, settings.stability)
        return PlaceDecision(self._belief.map, stability, action)

    def stable_at(self, offset_mm: XY) -> bool:
        """Judge the map there; with ``judge_from`` "patch" the latest patch, as if felt there."""
        if self._patch is None:
            return False
        com, rules = self._held.com_xy_mm, self._settings.stability
        return judge_stability(self._belief, self._patch, com, offset_mm, rules).stable

    def likely_at(self, offset_mm: XY) -> bool:
        """Judge alike: it tells stable from not stable in one way only."""
        return self.stable_at(offset_mm)


NOTHING = "The signals are no numbers, or unlike all it learned from: giving up without a release."
NO_CONTACT = "No contact was found"
EVEN = 0.5
FARTHEST_MM = 14.0  # farther from the last probe the network was asked too seldom to be followed
STEPS_MM = np.arange(-15.0, 15.0, 0.05)


class FusedStrategy:
    """Keeps the signals of all probes; asks the network anew after each."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        found = load_network_of(settings.fused)
        self._forward = FusedForward(found.arrays, found.shape)
        self._held, self._settings = held, settings
        self._sensor_mm = held.lever_mm() - held.grip_height_mm
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._seen: list[FloatArray] = []
        self._offset_mm: list[XY] = []
        self._missed_mm: list[XY] = []
        self._last: FloatArray | None = None
        self._lower: LowerSupport | None = None

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
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
            return PlaceDecision(self._belief.map, nothing, give_up(NOTHING))
        cells = (self._belief.map.cell_centres_mm() - np.asarray(here)).reshape(-1, 2)
        over = self._inset(known, cells, here)
        near = np.hypot(*(cells - com).T) <= FARTHEST_MM
        reached, cells = InsetDistribution(*(part[near] for part in over.parts())), cells[near]
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
        target = deepest_shift(self._expected_mm(reached, cells + here), cells - com)
        action = self._choose(stability, target, middle)
        return PlaceDecision(shown, stability, action)

    def inset_at(self, offset_mm: XY) -> InsetDistribution | None:
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
        return bool(
            holding_probability(inset, self._lower, self._com_at(offset_mm), np.zeros(1))[0] > EVEN
        )

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
        face = GraspedFace.of(points_mm, com, np.asarray(held.grip_height_mm))
        fields = seen[..., :TACTILE_CHANNELS]
        wrench = wrench_at_sensor(seen[..., TACTILE_CHANNELS:], self._sensor_mm)
        known = self._forward.known(wrench, fields, np.array(self._offset_mm), face)
        return np.asarray(known[-1], dtype=np.float64) if np.isfinite(known).all() else None

    def _inset(self, known: FloatArray, points_mm: FloatArray, here: XY) -> InsetDistribution:
        away = np.subtract(here, self._offset_mm[0])
        return self._forward.inset(known, points_mm, away)

    def _note_middle(self, over: InsetDistribution, places_mm: FloatArray) -> FaceCentre:
        """Return the middle of the touched face, frame of the map; keep what lies below it.

        ``places_mm`` (n, 2), likewise: of which the network says ``over``.
        """
        below = self._held.below
        face = None if below is None else below.bodies[-1].upper
        face = face or equivalent_disc(over, self._settings.belief.pitch_mm**2)
        middle = fit_face_centre(over, places_mm, face)
        self._lower = None if below is None else LowerSupport(below, middle)
        return middle

    def _margin_mm(self, top: InsetDistribution, centre_mm: XY) -> float:
        """Return the inset of one place that is not reached with the accepted risk."""
        holds = holding_probability(top, self._lower, centre_mm, STEPS_MM)
        kept = np.flatnonzero(holds >= 1.0 - self._settings.fused.risk)
        return float(STEPS_MM[kept[-1]]) if len(kept) else float(STEPS_MM[0])

    def _expected_mm(self, over: InsetDistribution, places_mm: FloatArray) -> FloatArray:
        """Return (n,) how deep the centre of mass is expected to lie in the shallowest interface.

        Over ``places_mm`` (n, 2), frame of the map, of which the network says ``over``.
        """
        if self._lower is None:
            return over.expected_mm()
        lower = self._lower.insets_mm(places_mm).mean(axis=0)
        return np.asarray(np.minimum(over.expected_mm(), lower))

    def _choose(self, stability: Stability, target: XY, middle: FaceCentre) -> PlaceAction:
        here = self._offset_mm[-1]
        policy, required = self._settings.policy, self._settings.fused.inset_mm
        words = describe_situation(stability, required)
        if stability.stable:
            why = f"{words}: release. {middle.standing(here)}"
            return PlaceAction("release", (0.0, 0.0), None, False, why)
        probes = self._probes()
        if probes >= policy.max_probes:
            return give_up(f"{words} after {probes} probes, the most allowed: giving up.")
        to = here[0] + target[0], here[1] + target[1]
        aim = ShiftTarget(to, "")
        if np.hypot(*target) < self._settings.belief.min_shift_mm:
            aim = ShiftTarget(next_on_spiral(here, self._belief, policy), "looking around")
        return shift_towards(stability, aim, here, policy.longest_step_mm, required)

    def _shown(self, over: InsetDistribution) -> BeliefMap:
        """Return the probability of support as a map."""
        limit, shape = self._settings.belief.log_odds_limit, self._belief.map.log_odds.shape
        p = over.exceeds(0.0).reshape(shape)
        with np.errstate(divide="ignore"):
            log_odds = np.clip(np.log(p) - np.log1p(-p), -limit, limit)
        return replace(self._belief.map, log_odds=log_odds)


def load_network_of(settings: FusedSettings) -> FusedCheckpoint:
    """Return the network that the settings name; raises ``InputError``."""
    return load_fused(Path(settings.weights)) if settings.weights else shipped_fused()


def deepest_shift(expected_mm: FloatArray, shifts_mm: FloatArray) -> XY:
    """Return the shift that brings the centre of mass where it is expected to lie deepest.

    ``expected_mm`` (n,): how deep after each of ``shifts_mm`` (n, 2) from here.
    """
    x, y = shifts_mm[int(expected_mm.argmax())]
    return float(x), float(y)


class ZeroWrenchStrategy:
    """Steps towards where the push acts; the network's estimate is not looked at."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings, self._lever_mm = held, settings, held.lever_mm()
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._felt: list[tuple[XY, float]] = []

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
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
        return PlaceDecision(self._belief.map, stability, self._choose(stability, target, here))

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
        policy, words = self._settings.policy, describe_situation(stability)
        if stability.stable:
            return PlaceAction("release", (0.0, 0.0), None, False, f"{words}: release.")
        if len(self._felt) >= policy.max_probes:
            count = len(self._felt)
            return give_up(f"{words} after {count} probes, the most allowed: giving up.")
        aim = ShiftTarget(target, "")
        if math.dist(here, target) < self._settings.belief.min_shift_mm:
            aim = ShiftTarget(next_on_spiral(here, self._belief, policy), "looking around")
        return shift_towards(stability, aim, here, policy.longest_step_mm, 0.0)


def make_strategy(held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> Strategy:
    """Return the memory of a trial that begins with a probe at ``origin_mm``.

    Raises ``InputError`` for a strategy that concludes nothing from probes.
    """
    if settings.strategy == "fused":
        return FusedStrategy(held, settings, origin_mm)
    if settings.strategy == "zero-wrench":
        return ZeroWrenchStrategy(held, settings, origin_mm)
    if settings.strategy == "pick-and-place":
        raise InputError("This strategy does not probe.", "strategy", "Choose another one.")
    return PaperStrategy(held, settings, origin_mm)

"""Placement strategies: from the estimate of a probe to belief, stability and next action.

``make_strategy`` selects one by name: paper, paper with calibration, learned fusion, zero wrench. A
strategy keeps the belief of one trial; it uses observations only, never the bottom. Zero wrench
follows "Precise Object Placement Using Force-Torque Feedback" (arXiv 2404.17668).
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import pi, sqrt
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
from touchdown.backend.geometry import Outline, Piece, circle, inset_mm
from touchdown.backend.learning import PatchCalibration
from touchdown.backend.learning.fused import (
    TICKS,
    FusedCheckpoint,
    FusedForward,
    GraspedFace,
    InsetDistribution,
    load_network,
    wrench_at_sensor,
)
from touchdown.backend.placement.belief import Belief
from touchdown.backend.placement.equilibrium import convex_hull, pressed_at_mm, signed_margin_mm
from touchdown.backend.placement.policy import (
    ShiftTarget,
    ask_whether,
    choose_action,
    count_places,
    describe_situation,
    give_up,
    judge_stability,
    next_on_spiral,
    release,
    release_or_give_up,
    shift_towards,
    support_hull_mm,
    too_few_probes,
)
from touchdown.backend.placement.support_tower import XY, SupportTower, normal_draws

Array = NDArray[np.float32]
SEARCH_RADIUS_MM = 10.0  # around the deepest point, for the face centre
SEARCHED = slice(None, None, 3)  # points of the first search
# Points this near the edge determine the uncertainty of the centre.
EDGE_MM = 4.0
NUDGE_MM = 0.05
REFINED = 4
LEAST_SD_MM = 0.3  # smallest standard deviation of an inset


@dataclass(frozen=True, slots=True)
class FaceCentre:
    """Estimated centre ``at_mm`` of the touched face, with uncertainty ``sigma_mm`` per axis."""

    at_mm: XY
    sigma_mm: float

    def describe(self, face_mm: XY) -> str:
        """Return a text with the final position, for the tower entry of the next piece."""
        x, y = np.subtract(face_mm, self.at_mm)
        return f"It stands {x:+.1f}, {y:+.1f} mm from the middle, sigma {self.sigma_mm:.1f} mm."

    def samples(self) -> FloatArray:
        """Return (k, 2) evenly spread candidate positions, always the same ones."""
        return np.asarray(np.asarray(self.at_mm) + self.sigma_mm * normal_draws(1)[:, 0])


@dataclass(frozen=True, slots=True)
class LowerSupport:
    """Support by the bodies ``below``, for candidate positions of the uppermost face."""

    below: SupportTower
    centre: FaceCentre

    def insets_mm(self, points_mm: FloatArray) -> FloatArray:
        """Return the inset (k, n) of the load in the weakest lower support, per candidate.

        ``points_mm`` (n, 2): centre of mass of the piece, relative to the centre of the touched
        face.
        """
        relative = points_mm - self.centre.samples()[:, None]
        return self.below.insets_mm(relative).reshape(-1, len(points_mm))


def holding_probability(
    top: InsetDistribution,
    lower: LowerSupport | None,
    centre_mm: XY,
    least_mm: FloatArray,
    *,
    agreed: bool = False,
) -> FloatArray:
    """Return the probability (n,) that the load is deeper than ``least_mm`` (n,) in all supports.

    ``top``: inset of the centre of mass, at ``centre_mm``, in the touched face. With ``lower`` this
    is a lower bound: failure probabilities are added, whatever the correlation of the interfaces.
    ``agreed``: take the probability of the least confident network.
    """
    repeated = top.at(np.zeros(len(least_mm), dtype=np.intp))
    reached = repeated.surely_exceeds(least_mm) if agreed else repeated.exceeds(least_mm)
    if lower is None:
        return reached
    insets = np.sort(lower.insets_mm(np.array([centre_mm])).ravel())
    falls = np.searchsorted(insets, least_mm, side="right") / len(insets)
    return np.asarray(np.maximum(reached - falls, 0.0), dtype=np.float64)


def fit_face_centre(over: InsetDistribution, points_mm: FloatArray, face: Outline) -> FaceCentre:
    """Return the centre of the touched ``face`` from insets ``over`` points (n, 2) in mm.

    Least squares on the expected insets; their variance near the edge gives the uncertainty.
    """
    expected, variance = over.expected_mm(), over.variance_mm2()
    weight = 1.0 / np.maximum(variance, LEAST_SD_MM**2)
    start = points_mm[int(expected.argmax())]
    steps = np.arange(-SEARCH_RADIUS_MM, SEARCH_RADIUS_MM + 1.0)
    around = start + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    insets = inset_mm(face, points_mm[SEARCHED] - around[:, None])
    misfit = (insets - expected[SEARCHED]) ** 2 @ weight[SEARCHED]
    at = around[int(np.argmin(misfit))]
    for _ in range(REFINED):
        # Gradient of the inset with respect to the position of the centre.
        ways = [
            inset_mm(face, points_mm - at - m) - inset_mm(face, points_mm - at + m)
            for m in NUDGE_MM * np.eye(2)
        ]
        slope = np.stack(ways, axis=-1) / (2.0 * NUDGE_MM)
        off = expected - inset_mm(face, points_mm - at)
        normal = (slope * weight[:, None]).T @ slope + LEAST_SD_MM**2 * np.eye(2)
        at = at + np.linalg.solve(normal, (slope * weight[:, None]).T @ off)
    inset = inset_mm(face, points_mm - at)
    near = np.abs(inset) <= EDGE_MM
    varies = (variance + (expected - inset) ** 2)[near]
    sigma_mm = sqrt(float(varies.mean())) if near.any() else SEARCH_RADIUS_MM
    return FaceCentre((float(at[0]), float(at[1])), max(sigma_mm, LEAST_SD_MM))


def equivalent_disc(over: InsetDistribution, cell_mm2: float) -> Outline:
    """Return a disc with the area of the cells of ``over`` that are likely in the touched face."""
    within = float((over.expected_mm() > 0.0).sum())
    return circle(2.0 * sqrt(max(within, 1.0) * cell_mm2 / pi))


@dataclass(frozen=True, slots=True)
class GraspedPiece:
    """Information about the grasped piece before the first probe.

    ``com_xy_mm``: centre of mass in ``F``; ``grip_height_mm``: pivot above the face; ``base_rate``:
    share of contact in the training data, None without a model. ``sensor_height_mm``: wrist sensor
    above the pivot, None if unknown. ``below``: entered tower under the touched surface, None if
    there is none. ``calibration``: that of the model's probabilities, None if it has none.
    ``com_sigma_mm``: standard uncertainty of a weighed centre of mass.
    """

    com_xy_mm: XY
    grip_height_mm: float
    base_rate: float | None = None
    sensor_height_mm: float | None = None
    below: SupportTower | None = None
    calibration: PatchCalibration | None = None
    com_sigma_mm: float = 0.0

    def lever_mm(self) -> float:
        """Return the height of the sensor above the face; raises ``InputError`` if unknown."""
        if self.sensor_height_mm is None:
            raise InputError(
                "This strategy needs the height of the wrist sensor above the grasp pivot.",
                "mounting.sensor_height_mm",
                "Add it to the lab file, or choose another strategy.",
            )
        return self.grip_height_mm + self.sensor_height_mm

    def known_calibration(self) -> PatchCalibration:
        """Return the calibration of the model; raises ``InputError`` without one."""
        if self.calibration is None:
            raise InputError(
                "The model has no calibration of its probabilities, which paper-calibrated needs.",
                "strategy",
                "Fit one to labelled probes (touchdown evaluate MODEL DATA --calibrate), or choose "
                "the strategy paper.",
            )
        return self.calibration


@dataclass(frozen=True, slots=True)
class ProbeObservation:
    """One probe: ``observation`` (20, 258) as given to the model, and its estimated ``patch``.

    ``offset_mm``: commanded offset of the face (frame of the map).
    """

    observation: NDArray[np.float32]
    patch: ContactPatch
    offset_mm: XY


@dataclass(frozen=True, slots=True)
class PlaceDecision:
    """Result after a probe: belief ``map``, stability at this offset, next action."""

    map: BeliefMap
    stability: Stability
    action: PlaceAction


class Strategy(Protocol):
    """Strategy of one trial with its belief."""

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Process the next probe; return the decision."""


@runtime_checkable
class SearchingStrategy(Strategy, Protocol):
    """Strategy that continues without contact, asks where it is unsure, compares its signals."""

    def missed(self, offset_mm: XY) -> PlaceAction:
        """Record that there was no contact at ``offset_mm``; return a shift or a question."""

    def go_on(self) -> PlaceAction:
        """Allow as many probes again after the operator's yes; return the next shift."""

    def signal_distances(self) -> tuple[float, float]:
        """Return how far the signals of the trial are from the training data."""


class GraspStrategy:
    """Strategy that keeps its evidence when the piece is gripped again."""

    _held: GraspedPiece

    def regrasped(self, sigma_mm: float) -> None:
        """Keep the evidence; its place on the piece is uncertain by ``sigma_mm`` more."""
        sigma_mm = math.hypot(self._held.com_sigma_mm, sigma_mm)
        self._held = replace(self._held, com_sigma_mm=sigma_mm)


class PaperStrategy(GraspStrategy):
    """Strategy of Ota et al.: independent cells, hull of the confident ones, step to its centre.

    ``paper`` adds the raw logits of all probes. ``paper-calibrated`` adds calibrated evidence to a
    prior that counts once.
    """

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings = held, settings
        calibrated = settings.strategy == "paper-calibrated"
        calibration = held.known_calibration() if calibrated else None
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate, calibration)

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Update the belief, judge stability, choose the action."""
        policy, here = self._settings.policy, touched.offset_mm
        margin_mm = self._settings.stability.margin_mm + COM_SIGMAS * self._held.com_sigma_mm
        judged = self._settings.stability.model_copy(update={"margin_mm": margin_mm})
        self._belief = self._belief.updated(touched.patch, here)
        com = self._held.com_xy_mm
        stability = judge_stability(self._belief, touched.patch, com, here, judged)
        action = choose_action(stability, self._belief, here, policy, judged)
        return PlaceDecision(self._belief.map, stability, action)


NO_ESTIMATE = (
    "The signals are not finite or outside the training data: giving up without a release."
)
COM_SIGMAS = 2.0  # standard uncertainties of a weighed centre of mass in the paper's margin
NO_CONTACT = "No contact was found"
EVEN = 0.5
FARTHEST_MM = 14.0  # positions farther from the last probe are outside of the training data
STEPS_MM = np.arange(-15.0, 15.0, 0.05)
EXPECTED_SHARE = 1e-3  # probability that is worth a millimetre of expected inset


class FusedStrategy(GraspStrategy):
    """Strategy with the learned fusion of the signals of all probes."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        found = load_network_of(settings.fused)
        self._forward = FusedForward(found.arrays, found.card.hyper)
        self._held, self._settings = held, settings
        self._sensor_mm = held.lever_mm() - held.grip_height_mm
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)
        self._seen: list[FloatArray] = []
        self._offset_mm: list[XY] = []
        self._pressed_mm: list[FloatArray] = []
        self._missed_mm: list[XY] = []
        self._last: FloatArray | None = None
        self._lower: LowerSupport | None = None
        self._allowed, self._further = settings.policy.max_probes, give_up(NO_ESTIMATE)

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Evaluate this position and the map, judge by the accepted risk, choose the action."""
        settings, here = self._settings, touched.offset_mm
        self._belief = self._belief.updated(touched.patch, here)
        self._record(touched)
        com = self._held.com_xy_mm
        centre = (here[0] + com[0], here[1] + com[1])
        self._points_mm = touched.patch.points_mm
        known = self._last = self._state()
        if known is None:
            nothing = Stability(
                False, np.nan, SupportKind.NO_ESTIMATE, np.zeros((0, 2)), centre, "belief"
            )
            return PlaceDecision(self._belief.map, nothing, give_up(NO_ESTIMATE))
        cells = (self._belief.map.cell_centres_mm() - np.asarray(here)).reshape(-1, 2)
        near = np.hypot(*(cells - com).T) <= FARTHEST_MM
        seen = near | self._belief.map.covered.ravel()
        over = self._inset(known[:1], cells[seen], here)  # without mirror images: many points
        supported = np.full(len(cells), EVEN)
        supported[seen] = over.exceeds(0.0)
        reached, cells = over.at(near[seen]), cells[near]
        face_centre = self._update_face_centre(reached, cells + here)
        inset = self._inset(known, np.array([com]), here)
        margin_mm, weak = self._margin_mm(inset, centre), self._weak_evidence(inset, centre)
        shown = self._probability_map(supported)
        stable = margin_mm >= settings.fused.inset_mm and not weak
        hull = support_hull_mm(replace(self._belief, map=shown), shown.log_odds > 0.0)
        stability = Stability(stable, margin_mm, SupportKind.AREA, hull, centre, "belief")
        target = best_shift(self._promise(reached, cells + here), cells - com)
        action = self._choose(stability, target, face_centre, weak)
        return PlaceDecision(shown, stability, action)

    def _record(self, touched: ProbeObservation) -> None:
        """Add a probe to the inputs of the network; it replaces those within ``merge_mm``."""
        here, nearest_mm = touched.offset_mm, self._settings.fused.merge_mm
        kept = [k for k, at in enumerate(self._offset_mm) if math.dist(at, here) >= nearest_mm]
        seen = np.asarray(touched.observation[TICKS, :], dtype=np.float64)
        self._offset_mm = [*(self._offset_mm[k] for k in kept), here]
        self._seen = [*(self._seen[k] for k in kept), seen]
        wrench = touched.observation[:, TACTILE_CHANNELS:].astype(np.float64)
        if np.isfinite(wrench).all():
            at = pressed_at_mm(wrench, self._held.lever_mm())
            self._pressed_mm += [np.asarray(here) + at] if np.isfinite(at).all() else []

    def _weak_evidence(self, inset: InsetDistribution, centre_mm: XY) -> str:
        """Return the reason against a release that the settings name, or "".

        ``inset``: of the centre of mass, at ``centre_mm``. Every centre of pressure lies in the
        support and the face; if both are convex, so does the hull of all of them.
        """
        rules, sd_mm = self._settings.fused, sqrt(float(inset.variance_mm2()[0]))
        if 0.0 < rules.largest_sd_mm < sd_mm:
            return f"standard deviation {sd_mm:.1f} mm, {rules.largest_sd_mm:g} mm allowed"
        if rules.pressure_sd_mm:
            hull = convex_hull(np.array(self._pressed_mm))
            if not signed_margin_mm(hull, centre_mm) >= 2.0 * rules.pressure_sd_mm:
                return "the centres of pressure do not enclose it"
        return ""

    def missed(self, offset_mm: XY) -> PlaceAction:
        """Return half way to the last contact; before any contact, follow a spiral.

        A position without contact counts as a probe.
        """
        policy = self._settings.policy
        self._missed_mm.append(offset_mm)
        last = self._offset_mm[-1] if self._offset_mm else offset_mm
        to = 0.5 * (last[0] + offset_mm[0]), 0.5 * (last[1] + offset_mm[1])
        where = "half way back"
        if math.dist(to, offset_mm) < self._settings.belief.min_shift_mm:
            tried = replace(self._belief, visits=(*self._belief.visits, *self._missed_mm))
            first = self._offset_mm[0] if self._offset_mm else self._missed_mm[0]
            to, where = next_on_spiral(first, tried, policy), "looking around"
        step = to[0] - offset_mm[0], to[1] - offset_mm[1]
        clipped = math.hypot(*step) > policy.longest_step_mm
        part = policy.longest_step_mm / math.hypot(*step) if clipped else 1.0
        step = step[0] * part, step[1] * part
        words = f"{NO_CONTACT} ({where}): move {math.hypot(*step):.1f} mm."
        return self._shift_or_ask(PlaceAction("shift", step, to, clipped, words), NO_CONTACT)

    def go_on(self) -> PlaceAction:
        """Allow as many probes again; return the shift that the question was about."""
        self._allowed += self._settings.policy.max_probes
        return self._further

    def _shift_or_ask(self, shift: PlaceAction, situation: str) -> PlaceAction:
        """Return ``shift``; after the most probes allowed, the question whether to take it."""
        if self._probes() < self._allowed:
            return shift
        self._further = shift
        return ask_whether(shift, situation, self._probes())

    def _probes(self) -> int:
        return len(self._belief.visits) + len(self._missed_mm)

    def _signals(self) -> tuple[Array, Array, FloatArray, GraspedFace]:
        """Return wrench, marker fields and offsets of all probes, and the face."""
        seen, held = np.stack(self._seen).astype(np.float32), self._held
        com = np.asarray(held.com_xy_mm, dtype=np.float64)
        face = GraspedFace.of(self._points_mm, com, np.asarray(held.grip_height_mm))
        wrench = wrench_at_sensor(seen[..., TACTILE_CHANNELS:], self._sensor_mm)
        return wrench, seen[..., :TACTILE_CHANNELS], np.array(self._offset_mm), face

    def _state(self) -> FloatArray | None:
        """Return the state after all probes; None if a signal is outside the training data."""
        if not np.isfinite(self._seen).all():
            return None
        known = self._forward.known_by_mirror(*self._signals())
        return np.asarray(known[:, -1], dtype=np.float64) if np.isfinite(known).all() else None

    def signal_distances(self) -> tuple[float, float]:
        """Return how far the signals of all probes are from the training data."""
        return self._forward.distances(*self._signals())

    def _inset(self, known: FloatArray, points_mm: FloatArray, here: XY) -> InsetDistribution:
        away = np.subtract(here, self._offset_mm[0])
        found = self._forward.inset(known, points_mm, away)
        return replace(found, sd_mm=np.hypot(found.sd_mm, self._held.com_sigma_mm))

    def _update_face_centre(self, over: InsetDistribution, places_mm: FloatArray) -> FaceCentre:
        """Return the centre of the touched face in the frame of the map; keep the lower support.

        ``places_mm`` (n, 2): positions of the insets ``over``.
        """
        below = self._held.below
        face = None if below is None else below.bodies[-1].upper
        face = face or equivalent_disc(over, self._settings.belief.pitch_mm**2)
        centre = fit_face_centre(over, places_mm, face)
        self._lower = None if below is None else LowerSupport(below, centre)
        return centre

    def _margin_mm(self, top: InsetDistribution, centre_mm: XY) -> float:
        """Return the inset of one position that is exceeded with the required probability."""
        rules, most = self._settings.fused, self._settings.policy.max_probes
        holds = holding_probability(
            top, self._lower, centre_mm, STEPS_MM, agreed=rules.ensemble == "minimum"
        )
        kept = np.flatnonzero(holds >= 1.0 - rules.accepted_risk(self._probes(), most))
        return float(STEPS_MM[kept[-1]]) if len(kept) else float(STEPS_MM[0])

    def _promise(self, over: InsetDistribution, places_mm: FloatArray) -> FloatArray:
        """Return the probability (n,) that all interfaces hold the centre of mass at places.

        A share of the expected inset is added, which decides where the probability is zero.
        ``places_mm`` (n, 2): positions of the insets ``over``, in the frame of the map.
        """
        holds, expected = over.exceeds(0.0), over.expected_mm()
        if self._lower is not None:
            lower = self._lower.insets_mm(places_mm)
            holds = holds * (lower > 0.0).mean(axis=0)
            expected = np.minimum(expected, lower.mean(axis=0))
        return np.asarray(holds + EXPECTED_SHARE * expected)

    def _choose(
        self, stability: Stability, target: XY, face_centre: FaceCentre, weak: str
    ) -> PlaceAction:
        here = self._offset_mm[-1]
        policy, required = self._settings.policy, self._settings.fused.inset_mm
        words, more = describe_situation(stability, required), f" {face_centre.describe(here)}"
        if stability.stable and count_places(self._belief) >= policy.least_probes:
            return release(words, more)
        why = too_few_probes(policy) if stability.stable else weak
        aim = ShiftTarget((here[0] + target[0], here[1] + target[1]), why)
        if np.hypot(*target) < self._settings.belief.min_shift_mm:
            aim = ShiftTarget(next_on_spiral(here, self._belief, policy), why or "looking around")
        shift = shift_towards(stability, aim, here, policy.longest_step_mm, required)
        return self._shift_or_ask(shift, words)

    def _probability_map(self, supported: FloatArray) -> BeliefMap:
        limit, shape = self._settings.belief.log_odds_limit, self._belief.map.log_odds.shape
        p = supported.reshape(shape)
        with np.errstate(divide="ignore"):
            log_odds = np.clip(np.log(p) - np.log1p(-p), -limit, limit)
        return replace(self._belief.map, log_odds=log_odds)


def check_outlines(settings: StackSettings, pieces: Iterable[Piece]) -> None:
    """Raise ``InputError`` if the strategy was not made for the outline of one of ``pieces``."""
    if settings.strategy != "fused" or load_network_of(settings.fused).card.outlines == "any":
        return
    for piece in pieces:
        if "region" in (piece.face.kind, piece.lower.kind):
            raise InputError(
                f"The network of 'fused' knows convex outlines only; '{piece.name}' has holes, "
                "notches or several parts.",
                "strategy",
                "Choose learned fusion for any outline (fused-any), or paper.",
            )


def load_network_of(settings: FusedSettings) -> FusedCheckpoint:
    """Return the network named by the settings; raises ``InputError``."""
    return load_network(settings.weights)


def best_shift(value: FloatArray, shifts_mm: FloatArray) -> XY:
    """Return the one of ``shifts_mm`` (n, 2) with the greatest ``value`` (n,)."""
    x, y = shifts_mm[int(value.argmax())]
    return float(x), float(y)


class ZeroWrenchStrategy(GraspStrategy):
    """Strategy that steps towards the centre of pressure, without the network."""

    def __init__(self, held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> None:
        self._held, self._settings, self._lever_mm = held, settings, held.lever_mm()
        self._belief = Belief.unknown(settings.belief, origin_mm, held.base_rate)

    def conclude(self, touched: ProbeObservation) -> PlaceDecision:
        """Release if the centre of pressure is under the centre of mass; else step to it."""
        here, com = touched.offset_mm, self._held.com_xy_mm
        unknown = ContactPatch(touched.patch.points_mm, np.full(len(touched.patch.points_mm), 0.5))
        self._belief = self._belief.updated(unknown, here)
        wrench = touched.observation[:, TACTILE_CHANNELS:].astype(np.float64)
        at = pressed_at_mm(wrench, self._lever_mm)
        felt = bool(np.isfinite(at).all())
        acts = np.asarray(here) + at if felt else np.zeros((0, 2))
        apart_mm = math.hypot(at[0] - com[0], at[1] - com[1]) if felt else math.inf
        stability = Stability(
            -apart_mm >= self._settings.required_margin_mm,
            -apart_mm,
            SupportKind.POINT if felt else SupportKind.NONE,
            acts.reshape(-1, 2),
            (here[0] + com[0], here[1] + com[1]),
            "patch",
        )
        target = (float(acts[0] - com[0]), float(acts[1] - com[1])) if felt else here
        return PlaceDecision(self._belief.map, stability, self._choose(stability, target, here))

    def _choose(self, stability: Stability, target: XY, here: XY) -> PlaceAction:
        policy, words = self._settings.policy, describe_situation(stability)
        probes, places = len(self._belief.visits), count_places(self._belief)
        if ended := release_or_give_up(stability, words, probes, policy, places):
            return ended
        aim = ShiftTarget(target, too_few_probes(policy) if stability.stable else "")
        if math.dist(here, target) < self._settings.belief.min_shift_mm:
            aim = ShiftTarget(next_on_spiral(here, self._belief, policy), "looking around")
        return shift_towards(stability, aim, here, policy.longest_step_mm, 0.0)


def make_strategy(held: GraspedPiece, settings: StackSettings, origin_mm: XY) -> Strategy:
    """Return the strategy of one trial.

    Parameters
    ----------
    held : GraspedPiece
        Grasped piece, with centre of mass in frame ``F``.
    settings : StackSettings
        Strategy ("paper", "paper-calibrated", "fused" or "zero-wrench") and its settings.
    origin_mm : tuple of float
        Offset of the first probe.

    Returns
    -------
    Strategy
        Strategy whose ``conclude`` takes one probe after the other.

    Raises
    ------
    InputError
        If the strategy does not probe, or lacks data such as the height of the sensor or the
        calibration of the model.

    """
    if settings.strategy == "fused":
        return FusedStrategy(held, settings, origin_mm)
    if settings.strategy == "zero-wrench":
        return ZeroWrenchStrategy(held, settings, origin_mm)
    if settings.strategy == "pick-and-place":
        raise InputError("This strategy does not probe.", "strategy", "Choose another one.")
    return PaperStrategy(held, settings, origin_mm)

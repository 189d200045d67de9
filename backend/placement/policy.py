"""Policy of the paper: judge stability, then release, shift, or give up (methods 9, 10)."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.config import PolicySettings, StabilitySettings
from touchdown.backend.core import ContactPatch, FloatArray, PlaceAction, Stability, SupportKind
from touchdown.backend.placement import equilibrium
from touchdown.backend.placement.belief import (
    Belief,
    CellGrid,
    cover_cells,
    face_lattice,
    is_finite,
)
from touchdown.backend.placement.support_tower import XY


def judge_stability(
    belief: Belief,
    patch: ContactPatch,
    com_xy_mm: tuple[float, float],
    offset_mm: tuple[float, float],
    settings: StabilitySettings,
) -> Stability:
    """Judge the stability of the piece at an offset.

    Parameters
    ----------
    belief : Belief
        Belief after the latest probe.
    patch : ContactPatch
        Latest estimate; its points (N, 2) are the face in frame ``F``.
    com_xy_mm : tuple of float
        Centre of mass in frame ``F``.
    offset_mm : tuple of float
        Offset of the face in the frame of the map.
    settings : StabilitySettings
        Threshold ``delta``, required margin, and evidence to judge from: map or patch.

    Returns
    -------
    Stability
        Signed margin of the centre of mass, hull (k, 2) in mm, and kind of support. Only cells
        under the piece count as support. Not stable if a value is not finite.

    """
    centre = (offset_mm[0] + com_xy_mm[0], offset_mm[1] + com_xy_mm[1])
    finite = is_finite(patch) and bool(np.isfinite(belief.map.log_odds).all())
    if not finite or not all(map(math.isfinite, centre)):
        return Stability(
            False, math.nan, SupportKind.NO_ESTIMATE, np.zeros((0, 2)), centre, settings.judge_from
        )
    if settings.judge_from == "belief":
        hull = _hull_on_map(belief, patch, offset_mm, settings.delta)
    else:
        hull = _hull_on_face(belief, patch, offset_mm, settings.delta)
    margin_mm = equilibrium.signed_margin_mm(hull, centre)
    support = equilibrium.support_kind(hull)
    stable = support is SupportKind.AREA and margin_mm >= settings.margin_mm
    return Stability(stable, margin_mm, support, hull, centre, settings.judge_from)


def confident_cells(belief: Belief, delta: float) -> NDArray[np.bool_]:
    """Return the cells (ny, nx) with a probability of support above ``delta``."""
    return np.asarray(belief.map.log_odds > log_odds_threshold(delta), dtype=np.bool_)


def log_odds_threshold(delta: float) -> float:
    """Return the log odds of ``delta``; 2.1972 for 0.9."""
    return math.log(delta / (1.0 - delta))


def support_hull_mm(belief: Belief, cells: NDArray[np.bool_]) -> FloatArray:
    """Return the hull (k, 2) in mm of the centres of the marked ``cells`` (ny, nx)."""
    rows, columns = np.nonzero(cells)
    # Cell indices are integers, so collinear cells are detected exactly.
    hull = equilibrium.convex_hull(np.stack((columns, rows), axis=1))
    return CellGrid.of(belief.map).to_mm(hull)


def _hull_on_map(
    belief: Belief, patch: ContactPatch, offset_mm: tuple[float, float], delta: float
) -> FloatArray:
    last = belief.evidence[-1] if belief.evidence else None
    if last is None or last.offset_mm != offset_mm:
        last = cover_cells(CellGrid.of(belief.map), patch.points_mm, patch.probability, offset_mm)
    under = last.covered
    return support_hull_mm(belief, confident_cells(belief, delta) & under)


def _hull_on_face(
    belief: Belief, patch: ContactPatch, offset_mm: tuple[float, float], delta: float
) -> FloatArray:
    """Return the hull of the latest patch alone, on the face points."""
    face = face_lattice(patch.points_mm, belief.map.pitch_mm)
    log_odds = belief.prior_log_odds + belief.log_odds(patch.probability)
    hull = equilibrium.convex_hull(face.index[log_odds > log_odds_threshold(delta)])
    corner = np.add(face.corner_mm, offset_mm)
    return np.asarray(corner + face.pitch_mm * hull, dtype=np.float64)


BEST_PERCENTILE = 95.0


def hull_centre(
    belief: Belief, delta: float, what: Literal["area", "cells", "vertices"]
) -> XY | None:
    """Return the centre of the confident support on the whole map, None if there is none.

    The paper divides a sum over the points of the hull by their number. ``what`` selects the
    points: all cells inside the hull ("area"), the confident cells, or the vertices of the hull.
    """
    cells = confident_cells(belief, delta)
    hull = support_hull_mm(belief, cells)
    if not len(hull):
        return None
    if what == "vertices" or (what == "area" and len(hull) < 3):
        return _mean(hull)
    # All cells inside the hull lie in the bounding box of the confident ones.
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    box = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    centres = belief.map.cell_centres_mm()[box]
    return _mean(centres[cells[box] if what == "cells" else equilibrium.inside_hull(hull, centres)])


def best_cells(belief: Belief) -> XY | None:
    """Return the mean of the covered cells at or above the 95th percentile of probability.

    "At or above", since no cell is above it if many share the highest value.
    """
    covered: NDArray[np.bool_] = belief.map.covered
    if not covered.any():
        return None
    least = np.percentile(belief.map.log_odds[covered], BEST_PERCENTILE)
    chosen = covered & (belief.map.log_odds >= least)
    return _mean(belief.map.cell_centres_mm()[chosen])


def next_on_spiral(centre_mm: XY, belief: Belief, settings: PolicySettings) -> XY:
    """Return the first position on a square spiral around ``centre_mm`` that was not probed."""
    step = settings.longest_step_mm
    for column, row in _spiral():
        place = (centre_mm[0] + step * column, centre_mm[1] + step * row)
        if not any(math.dist(place, visit) < 0.5 * step for visit in belief.visits):
            return place
    raise AssertionError("unreachable: the spiral does not end")


def _spiral() -> Iterator[tuple[int, int]]:
    """Yield integer positions outwards from (0, 0) at distance 1: right, up, left, down."""
    x, y = 0, 0
    yield x, y
    for turn in count():
        dx, dy = ((1, 0), (0, 1), (-1, 0), (0, -1))[turn % 4]
        for _ in range(turn // 2 + 1):
            x, y = x + dx, y + dy
            yield x, y


def _mean(points: FloatArray) -> XY:
    x, y = points.reshape(-1, 2).mean(axis=0)
    return float(x), float(y)


@dataclass(frozen=True, slots=True)
class ShiftTarget:
    """Target position of the face centre, and the reason in words."""

    target_mm: XY
    why: str


def choose_action(
    stability: Stability,
    belief: Belief,
    offset_mm: XY,
    settings: PolicySettings,
    judged_by: StabilitySettings,
) -> PlaceAction:
    """Return the next action for the piece at ``offset_mm`` (frame of the map).

    ``belief.visits`` is the history of probes; their number is limited by ``max_probes``.
    """
    if stability.support is SupportKind.NO_ESTIMATE:
        return give_up("The model returned no usable estimate: giving up without a release.")
    situation = describe_situation(stability, judged_by.margin_mm)
    probes, places = len(belief.visits), count_places(belief)
    if ended := release_or_give_up(stability, situation, probes, settings, places):
        return ended
    aim = _aim(stability, belief, offset_mm, settings, judged_by.delta)
    if aim is None:
        return give_up(f"{situation} and no better place is known: giving up.")
    if stability.stable:
        aim = ShiftTarget(aim.target_mm, too_few_probes(settings))
    return shift_towards(stability, aim, offset_mm, settings.longest_step_mm, judged_by.margin_mm)


def describe_situation(stability: Stability, required_mm: float = 0.0) -> str:
    """Return a text with the distance of the centre of mass from the hull."""
    margin_mm = stability.margin_mm
    if stability.support is SupportKind.AREA:
        if margin_mm < 0:
            return f"Centre of mass {-margin_mm:.1f} mm outside the hull"
        if stability.stable:
            return f"Centre of mass {margin_mm:.1f} mm inside the hull"
        return f"Centre of mass {margin_mm:.1f} mm inside the hull, {required_mm:.1f} mm required"
    if stability.support is SupportKind.NONE:
        return "No confident support under the piece"
    words = stability.support.value
    return f"{words[0].upper()}{words[1:]}, {-margin_mm:.1f} mm from the centre of mass"


def _aim(
    stability: Stability, belief: Belief, here: XY, settings: PolicySettings, delta: float
) -> ShiftTarget | None:
    """Return the greedy target, else the fallback; None to give up."""
    # The centre of mass, not the face centre, has to be above the centre of the support.
    com = (stability.centre_mm[0] - here[0], stability.centre_mm[1] - here[1])
    nearest = belief.settings.min_shift_mm
    centre = hull_centre(belief, delta, settings.hull_centre)
    why = "no confident support on the map"
    if centre is not None:
        target = (centre[0] - com[0], centre[1] - com[1])
        if _moves(here, target, nearest):
            return ShiftTarget(target, "")
        why = "already over the middle of the support"
    if settings.fallback == "stop":
        return None
    if settings.fallback == "spiral":
        start = belief.visits[0] if belief.visits else here
        return ShiftTarget(
            next_on_spiral(start, belief, settings), f"{why}: next place on the spiral"
        )
    best = best_cells(belief)
    target = here if best is None else (best[0] - com[0], best[1] - com[1])
    if _moves(here, target, nearest):
        return ShiftTarget(target, f"{why}: towards the most probable cells")
    return ShiftTarget(next_on_spiral(here, belief, settings), f"{why}: looking around")


def _moves(here: XY, target: XY, nearest_mm: float) -> bool:
    """Return True if the target is far enough for a move, also with ``min_shift_mm`` zero."""
    return math.dist(here, target) >= max(nearest_mm, 1e-6)


def shift_towards(
    stability: Stability, aim: ShiftTarget, here: XY, longest_mm: float, required_mm: float
) -> PlaceAction:
    """Return the shift from ``here`` towards the target, at most ``longest_mm`` long."""
    away = (aim.target_mm[0] - here[0], aim.target_mm[1] - here[1])
    distance_mm = math.hypot(*away)
    clipped = distance_mm > longest_mm
    part = longest_mm / distance_mm if clipped else 1.0
    step = (away[0] * part, away[1] * part)
    reason = f"{describe_situation(stability, required_mm)}"
    reason += f" ({aim.why})" if aim.why else ""
    x, y = (f"{mm:+z.1f}".replace("-", "\N{MINUS SIGN}") for mm in step)
    far = f", the longest step; the target is {distance_mm:.1f} mm away" if clipped else ""
    reason += f": move {math.hypot(*step):.1f} mm (x {x}, y {y}){far}."
    return PlaceAction("shift", step, aim.target_mm, clipped, reason)


def release_or_give_up(
    stability: Stability, situation: str, probes: int, settings: PolicySettings, places: int
) -> PlaceAction | None:
    """Return the release of a stable piece, the end after ``max_probes``, or None.

    ``places``: number of different places with contact, at least ``least_probes`` for a release.
    """
    if stability.stable and places >= settings.least_probes:
        return release(situation)
    if probes >= settings.max_probes:
        return give_up(f"{situation} after {probes} probes, the most allowed: giving up.")
    return None


def too_few_probes(settings: PolicySettings) -> str:
    """Return the reason for a shift from a stable place."""
    return f"{settings.least_probes} probes are required"


def count_places(belief: Belief) -> int:
    """Return the number of probes at least ``min_shift_mm`` from all former ones."""
    places: list[XY] = []
    for visit in belief.visits:
        if all(math.dist(visit, place) >= belief.settings.min_shift_mm for place in places):
            places.append(visit)
    return len(places)


def release(situation: str, more: str = "") -> PlaceAction:
    """Return the release of the piece; ``more``: text after the reason."""
    return PlaceAction("release", (0.0, 0.0), None, False, f"{situation}: release.{more}")


def ask_whether(further: PlaceAction, situation: str, probes: int) -> PlaceAction:
    """Return the question whether to go on probing with ``further`` after ``probes`` probes."""
    count, step_mm = f"{probes} probe{'s' * (probes != 1)}", math.hypot(*further.step_mm)
    reason = f"{situation} after {count}: go on probing {step_mm:.1f} mm away?"
    return PlaceAction("ask", (0.0, 0.0), further.target_mm, False, reason)


def give_up(reason: str) -> PlaceAction:
    """Return the action that ends a trial without a release."""
    return PlaceAction("give_up", (0.0, 0.0), None, False, reason)

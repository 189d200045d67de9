"""What to do next: release, shift towards the middle of the support, or give up (method 10)."""

from __future__ import annotations

import math
from dataclasses import dataclass

from backend.config.method import PolicySettings, StabilitySettings
from backend.core.flow import PlaceAction, Stability, SupportKind
from backend.placement.belief import Belief
from backend.placement.targets import best_cells, hull_centre, next_on_spiral

XY = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Aim:
    """Where the policy wants the face centre to be, and the words why."""

    target_mm: XY
    why: str


def choose(
    stability: Stability,
    belief: Belief,
    offset_mm: XY,
    settings: PolicySettings,
    judged_by: StabilitySettings,
) -> PlaceAction:
    """Return the next action of the piece at ``offset_mm`` (frame of the map).

    ``belief.visits`` is the history of probes; their number counts against ``max_probes``.
    """
    if stability.stable:
        return PlaceAction("release", (0.0, 0.0), None, False, f"{situation(stability)}: release.")
    if stability.support is SupportKind.NO_ESTIMATE:
        return give_up("The model returned no usable estimate: giving up without a release.")
    probes = len(belief.visits)
    if probes >= settings.max_probes:
        return give_up(f"{situation(stability, judged_by.margin_mm)} after {probes} probes, "
                        "the most allowed: giving up.")  # fmt: skip
    aim = _aim(stability, belief, offset_mm, settings, judged_by.delta)
    if aim is None:
        return give_up(f"{situation(stability, judged_by.margin_mm)} and no better place is "
                        "known: giving up.")  # fmt: skip
    return towards(stability, aim, offset_mm, settings.longest_step_mm, judged_by.margin_mm)


def situation(stability: Stability, required_mm: float = 0.0) -> str:
    """Say where the centre of mass is, with its distance."""
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
) -> Aim | None:
    """Return the greedy target; where there is none, or it is here, the fallback; None to stop."""
    # The centre of mass, not the face centre, must come over the middle of the support.
    com = (stability.centre_mm[0] - here[0], stability.centre_mm[1] - here[1])
    nearest = belief.settings.min_shift_mm
    centre = hull_centre(belief, delta, settings.hull_centre)
    why = "no confident support on the map"
    if centre is not None:
        target = (centre[0] - com[0], centre[1] - com[1])
        if _moves(here, target, nearest):
            return Aim(target, "")
        why = "already over the middle of the support"
    if settings.fallback == "stop":
        return None
    if settings.fallback == "spiral":
        start = belief.visits[0] if belief.visits else here
        return Aim(next_on_spiral(start, belief, settings), f"{why}: next place on the spiral")
    best = best_cells(belief)
    target = here if best is None else (best[0] - com[0], best[1] - com[1])
    if _moves(here, target, nearest):
        return Aim(target, f"{why}: towards the most probable cells")
    return Aim(next_on_spiral(here, belief, settings), f"{why}: looking around")


def _moves(here: XY, target: XY, nearest_mm: float) -> bool:
    """Whether going there is a move at all; also false where ``min_shift_mm`` is zero."""
    return math.dist(here, target) >= max(nearest_mm, 1e-6)


def towards(
    stability: Stability, aim: Aim, here: XY, longest_mm: float, required_mm: float
) -> PlaceAction:
    """Return the shift from ``here`` towards the aim, at most ``longest_mm`` long."""
    away = (aim.target_mm[0] - here[0], aim.target_mm[1] - here[1])
    distance_mm = math.hypot(*away)
    clipped = distance_mm > longest_mm
    part = longest_mm / distance_mm if clipped else 1.0
    step = (away[0] * part, away[1] * part)
    degrees = math.degrees(math.atan2(step[1], step[0])) % 360.0
    reason = f"{situation(stability, required_mm)}"
    reason += f" ({aim.why})" if aim.why else ""
    reason += f": move {math.hypot(*step):.1f} mm towards {degrees:.0f}°"
    reason += f", {distance_mm:.1f} mm wanted." if clipped else "."
    return PlaceAction("shift", step, aim.target_mm, clipped, reason)


def give_up(reason: str) -> PlaceAction:
    """Return the end of a trial without a release."""
    return PlaceAction("give_up", (0.0, 0.0), None, False, reason)

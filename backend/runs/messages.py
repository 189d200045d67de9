"""Messages to the operator about a run: estimate, belief, action and reason, with numbers."""

from __future__ import annotations

import math

from touchdown.backend import core

CONTRADICTED = "The physics engine contradicts the static judge here; the static judge decides."


def decision_message(
    probe: int, patch: core.ContactPatch, stability: core.Stability, action: core.PlaceAction
) -> str:
    """Return one line per probe: estimate, stability with signed margin, chosen move."""
    points = int((patch.probability > 0.5).sum())
    share = 100.0 * points / max(1, len(patch.probability))
    support = f"not stable, {stability.support.value}"
    if stability.support is core.SupportKind.AREA:
        digits = 1 if abs(stability.margin_mm) >= 0.1 else 2
        margin = f"{stability.margin_mm:+.{digits}f}".replace("-", "\N{MINUS SIGN}")
        support = f"{'stable' if stability.stable else 'not stable'}, estimated margin {margin} mm"
    contact = f"contact on {share:.0f} % of the face ({points} points)"
    return f"Probe {probe}: {contact}. Estimate: {support}. {action.reason}"


def release_message(stands: bool, margin_mm: float, kick_mm: float = 0.0) -> str:
    """Return the outcome of a release, with a shift by the fingers that can be seen."""
    if not math.isfinite(margin_mm):
        return "The piece stands." if stands else "The piece fell: nothing supported it."
    if margin_mm > 0.0 and not stands:
        return "The piece fell: it was released too high above its support."
    where = f"{abs(margin_mm):.1f} mm {'inside' if stands else 'outside'} its support"
    if kick_mm >= 0.05:
        return f"The fingers shifted the piece by {kick_mm:.1f} mm: {where}."
    if stands:
        return f"The piece stands, {where}."
    return f"The piece fell: its centre of mass was {where}."


DECISION_WORDS = {
    "discard": "discarded while collecting",
    "redo": "probed again",
    "skip": "left out of the campaign",
}  # recorded reason of a deletion, by decision


def hand_over_message(awaited: core.HandOverAwaited) -> str:
    """Return the next manual step of the operator."""
    if awaited.anew:
        return f"Take the {awaited.piece} and the gels off and refit them: a new series begins."
    if awaited.gives:
        return f"Hold the {awaited.piece} between the jaws: they close on it."
    return f"Take hold of the {awaited.piece}: the jaws open."


def mounting_question(awaited: core.MountingAwaited) -> str:
    """Return the question whether the last mounting of the campaign continues."""
    what = f"the {awaited.bottom} or the gels"
    return f"Were {what} mounted again since mounting {awaited.mounting} of this campaign?"


def rejected_message(probe: int, reasons: tuple[str, ...]) -> str:
    """Return the reasons for rejecting a probe."""
    return f"Probe {probe} is not an observation: {'; '.join(reasons)}."


_SEEN = {
    core.Outcome.PLACED: "The operator saw it stand.",
    core.Outcome.FELL: "The operator saw it fall.",
    core.Outcome.KNOCKED_OVER: "The operator saw the bottom disturbed.",
}


def seen_outcome_message(outcome: core.Outcome, reason: str) -> str:
    """Return the outcome as observed by the operator, with the given reason."""
    if outcome is core.Outcome.ABORTED:
        return f"Void: {reason.rstrip('.')}."
    said = _SEEN[outcome]
    return f"{said} {reason}".strip()


def scene_to_set_message(awaited: core.SetUpAwaited) -> str:
    """Return the scene the operator has to set before a trial on devices."""
    x, y = (f"{value:+.1f}".replace("-", "\N{MINUS SIGN}") for value in awaited.start_mm)
    bottom = " on ".join(reversed(awaited.bottom.split("+")))
    held = "" if awaited.holds else f" The {awaited.piece} is handed over next."
    return (
        f"Put the bottom ({bottom}) in its place and take your hands away. The {awaited.piece} "
        f"starts {x}, {y} mm off its centre, where it would fall.{held}"
    )


def outcome_question(awaited: core.OutcomeAwaited) -> str:
    """Return the question for the outcome, with the outcome proposed by the signals."""
    said = {
        core.Outcome.PLACED: "it stands",
        core.Outcome.FELL: "it fell",
        core.Outcome.KNOCKED_OVER: "the bottom was disturbed",
    }.get(awaited.proposed, "the trial is void")
    return f"What is the outcome? {awaited.why} Proposed: {said}."

"""Evidence beside the label in edit."""

from __future__ import annotations

import math
from collections.abc import Sequence

from touchdown.app.label.text import models_text
from touchdown.app.shell import LabelDraft, LabelItem, as_float_pair
from touchdown.backend.annotations import Revision
from touchdown.backend.placement import NOTABLE_SIGMAS, OffsetFit, sigmas_apart
from touchdown.widgets.views import Ghost, offset_text

LEAST_SIGMA_MM = 0.05  # lower bound of the label's uncertainty in comparisons


def sigmas_from_model(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return the distance to the model's label in joint sigmas, None without one."""
    if item.model is None or edit.source == item.model.source:
        return None
    return _sigmas_between(edit, item.model.fit)


def sigmas_from_scene(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return the distance to the camera measurement in joint sigmas."""
    seen = item.scene.place if item.scene is not None else None
    return None if seen is None else _sigmas_between(edit, seen)


def sigmas_from_signals(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return by how many sigmas the signals fit another place better; None if not judged."""
    if item.doubt is None or edit.changed or item.doubt[0] != edit.base.rev_uuid:
        return None
    return math.sqrt(item.doubt[1])


def evidence_badges(edit: LabelDraft, item: LabelItem) -> tuple[str, ...]:
    """Return the badge of a notable difference from the most certain evidence, if any.

    The camera measurement is used where there is one: it is ten times as certain. Next come the
    other episodes of the pair, if the dataset was scored. The model is used last.
    """
    name, distance = "scene", sigmas_from_scene(edit, item)
    if distance is None and (item.scene is None or item.scene.place is None):
        name, distance = "signals", sigmas_from_signals(edit, item)
        if distance is None:
            name, distance = "model", sigmas_from_model(edit, item)
    if distance is None or distance <= NOTABLE_SIGMAS:
        return ()
    return (f"{name} {distance:.1f} \N{GREEK SMALL LETTER SIGMA} off",)


def evidence_ghosts(item: LabelItem, history: Sequence[Revision]) -> tuple[Ghost, ...]:
    """Return the commanded displacement and those measured by arm, camera and model."""
    said = {r.source: r.label for r in history if r.label.is_set}
    ghosts = []
    commanded = said.get("commanded")
    at = commanded.offset_mm if commanded is not None else item.episode.offset_mm
    sigma_um = (commanded.sigma_um or 0) if commanded is not None else 0
    ghosts.append(Ghost("commanded", as_float_pair(at), sigma_um / 1e3))
    measured = said.get("measured")
    if measured is not None:
        sigma_mm = (measured.sigma_um or 0) / 1e3
        ghosts.append(Ghost("measured", as_float_pair(measured.offset_mm), sigma_mm))
    if item.scene is not None and item.scene.place is not None:
        ghosts.append(Ghost("scene", item.scene.place.offset_mm, item.scene.place.sigma_mm))
    if item.model is not None:
        fit = item.model.fit
        ghosts.append(Ghost("model", fit.offset_mm, fit.sigma_mm))
    return tuple(ghosts)


def scene_evidence_text(edit: LabelDraft, item: LabelItem, *, hidden: bool) -> str:
    """Return the measurement of the scene camera as text."""
    if hidden:
        return ""
    if item.scene is None:
        return "No scene picture: a slip in the grasp would be unseen."
    place = item.scene.place
    if place is None:
        return "Scene camera: the rim of the face cannot be made out."
    far = _distance_text(sigmas_from_scene(edit, item))
    return f"Scene camera: {offset_text(place.offset_mm, place.sigma_mm)}{far}"


def model_evidence_text(edit: LabelDraft, item: LabelItem, *, hidden: bool) -> str:
    """Return the model's estimate as text."""
    if hidden:
        return "Model and other sources are hidden."
    model = item.model
    if model is None:
        return "No model of this piece, or it cannot judge this episode."
    where = offset_text(model.fit.offset_mm, model.fit.sigma_mm)
    name = models_text(model.weights).capitalize()
    spread = f", they differ by {model.spread_mm:.2f} mm" if "+" in model.weights else ""
    return f"{name}: {where}{spread}{_distance_text(sigmas_from_model(edit, item))} (M)"


def _sigmas_between(edit: LabelDraft, other: OffsetFit) -> float | None:
    if edit.offset_mm is None:
        return None
    return sigmas_apart(edit.offset_mm, max(edit.sigma_mm, LEAST_SIGMA_MM), other)


def _distance_text(distance: float | None) -> str:
    return "" if distance is None else f", {distance:.1f} sigma off"

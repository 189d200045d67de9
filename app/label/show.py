"""From an item and its edit to what the views show."""

from __future__ import annotations

from collections.abc import Sequence

from app.label.edit import Edit, as_pair
from app.label.item import CURSOR_S, LabelItem, ModelLabel
from app.label.page import LabelPage
from app.label.words import rests_on, source_words
from backend.catalogue.values import Revision
from backend.placement.offset_fit import NOTABLE_SIGMAS, sigmas_apart
from backend.placement.resting import rest_at
from widgets.offset_scene import Ghost, OffsetScene, offset_in_words, verdict_in_words

LEAST_SIGMA_MM = 0.05
"""What a label is trusted at best when it is compared with a model."""


def show_item(page: LabelPage, item: LabelItem) -> None:
    """Show what was recorded."""
    first, last = item.span_s
    at_s = min(max(CURSOR_S, first), last)
    page.film.show_reel(item.reel, (max(first, 0.0), last), at_s)
    ahead = item.ahead
    page.forces.show_trace(item.trace, None if ahead is None else ahead.forces)
    page.moments.show_trace(item.trace, None if ahead is None else ahead.moments)
    page.phase.show_trace(item.trace, None if ahead is None else ahead.phase)
    page.show_cursor(at_s)
    entry = item.entry
    page.view_panel.detail.setText(f"{entry.piece} on {entry.bottom}, {entry.uuid[-8:]}")


def show_edit(
    page: LabelPage, item: LabelItem, edit: Edit, history: Sequence[Revision], *, hidden: bool
) -> None:
    """Show where the face is, and what follows from it."""
    scene = scene_of(item, edit, history, hidden=hidden)
    page.view.show_scene(scene)
    page.verdict.setText(verdict_in_words(scene))
    where = offset_in_words(scene.offset_mm, scene.sigma_mm)
    if edit.changed:
        page.basis.setText(f"{where}. Not saved yet, {source_words(edit.source)}.")
    else:
        page.basis.setText(f"{offset_in_words(scene.offset_mm)}: {rests_on(edit.base)}")
    page.basis.setToolTip(page.basis.text())
    page.model_line.setText(model_words(edit, item.model, hidden=hidden))


def scene_of(
    item: LabelItem, edit: Edit, history: Sequence[Revision], *, hidden: bool
) -> OffsetScene:
    """Return the scene of an edit; ``hidden``: nothing of a model, nor of other sources."""
    ghosts = () if hidden else ghosts_of(item, history)
    offset = edit.offset_mm
    if offset is None:
        return OffsetScene(item.bottom, item.face, ghosts=ghosts)
    pair = item.pair
    f = rest_at(pair.points_mm, pair.centre_mm, pair.bottom, offset, edit.yaw_rad)
    return OffsetScene(
        item.bottom, item.face, offset, edit.yaw_rad, f.points_mm, f.touching, f.hull_mm,
        f.centre_mm, f.margin_mm, f.support, f.too_close, edit.sigma_mm, ghosts,
    )  # fmt: skip


def ghosts_of(item: LabelItem, history: Sequence[Revision]) -> tuple[Ghost, ...]:
    """Return where the bench was told to go, where it measured itself, and the model's place."""
    said = {r.source: r.label for r in history if r.label.is_set}
    ghosts = []
    commanded = said.get("commanded")
    at = commanded.offset_mm if commanded is not None else item.episode.offset_mm
    sigma_um = (commanded.sigma_um or 0) if commanded is not None else 0
    ghosts.append(Ghost("commanded", as_pair(at), sigma_um / 1e3))
    measured = said.get("measured")
    if measured is not None:
        sigma_mm = (measured.sigma_um or 0) / 1e3
        ghosts.append(Ghost("measured", as_pair(measured.offset_mm), sigma_mm))
    if item.model is not None:
        fit = item.model.fit
        ghosts.append(Ghost("model", fit.offset_mm, fit.sigma_mm))
    return tuple(ghosts)


def apart(edit: Edit, model: ModelLabel | None) -> float | None:
    """Return how many joint uncertainties the label lies from the model's; None: no telling."""
    if model is None or edit.offset_mm is None or edit.source == model.source:
        return None
    return sigmas_apart(edit.offset_mm, max(edit.sigma_mm, LEAST_SIGMA_MM), model.fit)


def badges_of(edit: Edit, model: ModelLabel | None) -> tuple[str, ...]:
    """Return the badge of a notable difference, if there is one."""
    distance = apart(edit, model)
    if distance is None or distance <= NOTABLE_SIGMAS:
        return ()
    return (f"model {distance:.1f} \N{GREEK SMALL LETTER SIGMA} off",)


def model_words(edit: Edit, model: ModelLabel | None, *, hidden: bool) -> str:
    """Say what the model makes of it."""
    if hidden:
        return "Model and other sources are hidden."
    if model is None:
        return "No model of this piece, or it cannot judge this episode."
    where = offset_in_words(model.fit.offset_mm, model.fit.sigma_mm)
    distance = apart(edit, model)
    far = "" if distance is None else f", {distance:.1f} sigma off"
    return f"Model {model.weights_sha256[:8]}: {where}{far} (M)"

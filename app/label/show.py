"""From an item and its edit to what the views show."""

from __future__ import annotations

from collections.abc import Sequence

from app.label.edit import Edit
from app.label.evidence import ghosts_of, model_words, scene_words
from app.label.item import CURSOR_S, LabelItem
from app.label.page import LabelPage
from app.label.scene_shots import shots_of
from app.label.words import rests_on, source_words
from backend.catalogue.values import Revision
from backend.placement.resting import rest_at
from widgets.offset_scene import OffsetScene, offset_in_words, verdict_in_words


def show_item(page: LabelPage, item: LabelItem) -> None:
    """Show what was recorded."""
    page.show_something()
    first, last = item.span_s
    at_s = min(max(CURSOR_S, first), last)
    page.film.take_reel(item.reel, (max(first, 0.0), last))
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
    page.model_line.setText(model_words(edit, item, hidden=hidden))
    page.scene_line.setText(scene_words(edit, item, hidden=hidden))
    outlines = item.face, item.bottom
    page.shots.show_shots(shots_of(item.scene, edit, outlines, hidden=hidden))


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

"""Text of the label workspace: queues, versions, and evidence beside the label."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Literal

from touchdown.app.shell import LabelDraft, LabelItem, as_float_pair
from touchdown.backend.annotations import (
    EpisodeEntry,
    Label,
    LabelState,
    Operation,
    Revision,
    ScoredLabel,
    Source,
)
from touchdown.backend.placement import NOTABLE_SIGMAS, OffsetFit, sigmas_apart
from touchdown.widgets.base import count_noun, signed, tr
from touchdown.widgets.lists import HistoryRow, LabelListRow
from touchdown.widgets.views import Ghost, offset_text

QUEUES: tuple[tuple[str, str], ...] = (
    ("unlabelled", "Unlabelled and drafts"),
    ("review", "Waiting for review"),
    ("returned", "Rejected, to correct"),
    ("doubt", "The signals speak against it"),
    ("disagreement", "Disagreement with the model"),
    ("training", "Most to learn"),
    ("coverage", "Holes in the coverage"),
    ("duplicates", "Alike signals, other labels"),
    ("conflicts", "Conflicts after a merge"),
    ("audit", "Random audit"),
    ("gold", "Gold: approved labels, answered blind"),
    ("all", "All episodes"),
)

EnterAct = Literal["accept", "approve", ""]
FINDING = "finding"  # the queue of a finding of the dataset check
RETRAIN_EVERY = 25  # labels of the queue of training, after which a training is offered


def source_text(source: Source) -> str:
    """Return a source as text; a model is named by the start of its weight hash."""
    kind, _, weights = source.partition(":")
    return models_text(weights) if kind == "model" else tr(kind)


def models_text(weights: str) -> str:
    """Return the models named by the start of their weight hashes, joined by ``+``."""
    first, *others = weights.split("+")
    said = tr("model {}", first[:8])
    return tr("{} and {} more", said, len(others)) if others else said


def provenance_text(revision: Revision) -> str:
    """Return source and uncertainty of a label as text."""
    sigma = revision.label.sigma_um
    known = tr("sigma\N{NO-BREAK SPACE}{:.2f}\N{NO-BREAK SPACE}mm", (sigma or 0) / 1000.0)
    spread = tr("uncertainty unknown") if sigma is None else known
    kind = revision.source.partition(":")[0]
    basis = {
        "commanded": tr("commanded"),
        "measured": tr("measured"),
        "human": tr("set by {}", revision.person),
        "model": tr("{} alone", source_text(revision.source)),
    }.get(kind, revision.source)
    return f"{basis}, {spread}"


# By act of Enter, and if the other sources differ from the position (None: there are none).
TAKES = {
    ("accept", None): "Accept takes this position, {}",
    ("accept", False): "The sources agree: accept {}",
    ("accept", True): "The sources differ: drag the outline to the true place, or accept {}",
    ("approve", None): "Approve takes this position, {}",
    ("approve", False): "The sources agree: approve {}",
    ("approve", True): "The sources differ: drag the outline to the true place, or approve {}",
}


def basis_text(
    edit: LabelDraft, model: OffsetFit | None, act: EnterAct, differ: bool | None = None
) -> str:
    """Return the displacement that Enter takes with ``act``, its source, and the next step."""
    if not edit.label.is_set:
        if act and model is not None:
            at = offset_text(model.offset_mm, model.sigma_mm)
            return tr("Accept takes the displacement of the model, {}.", at)
        return tr("No displacement is set yet.")
    where = offset_text(edit.offset_mm, edit.sigma_mm if edit.changed else 0.0)
    if act:
        where = tr(TAKES[act, differ], where)
    if edit.changed:
        return tr("{}. Not saved yet, {}.", where, source_text(edit.source))
    return f"{where}: {provenance_text(edit.base)}"


def next_step_text(head: Revision, *, reviewing: bool, opines: bool) -> str:
    """Return the next step for a label, where Enter does not simply accept it."""
    if opines:
        return tr("Blind: Enter keeps your displacement as an opinion, the label does not change.")
    if head.state == "rejected":
        why = tr(head.reason or "no reason")
        return tr("Rejected by {}: {}. Correct it, then Enter.", head.person, why)
    if reviewing and head.state == "submitted":
        return tr("Submitted by {}: Enter approves, D rejects.", head.person)
    return ""


def local_time_text(at_ns: int) -> str:
    """Return the local time of day."""
    return f"{datetime.fromtimestamp(at_ns / 1e9):%H:%M:%S}"


def label_text(label: Label) -> str:
    """Return a label as text."""
    if not label.is_set:
        return tr("no displacement")
    x, y = label.offset_mm.tolist()
    return offset_text((x, y), (label.sigma_um or 0) / 1e3)


def history_rows(revisions: Sequence[Revision], head: Revision) -> list[HistoryRow]:
    """Return all versions, newest first, each with its changes."""
    rows = []
    for number, revision in enumerate(revisions, start=1):
        before = revisions[number - 2] if number > 1 else None
        when = f"{datetime.fromtimestamp(revision.at_ns / 1e9):%Y-%m-%d %H:%M:%S}"
        reason = f" ({tr(revision.reason)})" if revision.reason else ""
        what = f"{tr(revision.state)}{reason}: {label_text(revision.label)}"
        who = f"{revision.person}, {source_text(revision.source)}, {when}"
        holds = revision.rev_uuid == head.rev_uuid
        change = revision_difference(before, revision)
        rows.append(HistoryRow(revision.rev_uuid, number, what, who, change, holds))
    return rows[::-1]


def revision_difference(before: Revision | None, after: Revision) -> str:
    """Return the changes of a revision against the previous one."""
    if before is None:
        return ""
    parts = []
    if before.label.is_set and after.label.is_set:
        dx, dy = (after.label.offset_mm - before.label.offset_mm).tolist()
        if dx or dy:
            parts.append(tr("moved {}", offset_text((dx, dy))))
    if before.source != after.source:
        parts.append(tr("{} to {}", source_text(before.source), source_text(after.source)))
    if before.verdict != after.verdict:
        parts.append(tr("stability {}", tr(after.verdict or "none")))
    if before.geometry != after.geometry:
        parts.append(tr("other geometry"))
    return "; ".join(parts)


def beside_text(known: ScoredLabel) -> str:
    """Return score, label and predicted label (x, y in mm); unknown ones are left out."""
    places = [
        f"{name}{', '.join(signed(float(mm)) for mm in said.offset_mm)}"
        for name, said in (("", known.label), (f"{tr('model')} ", known.model))
        if said is not None and said.is_set
    ]
    score = "" if known.score is None else f"{known.score:.1f}: "
    return score + "; ".join(places)


def queue_row(
    entry: EpisodeEntry,
    state: LabelState,
    badges: Sequence[str] = (),
    beside: ScoredLabel | None = None,
) -> LabelListRow:
    """Return the row of an episode in the queue; ``beside``: its label and that of the model."""
    when = f"{datetime.fromtimestamp(entry.recorded_ns / 1e9):%d %b %H:%M:%S}"
    marks = [
        word
        for word, holds in (
            (tr("flag"), entry.flagged),
            (tr("conflict"), entry.conflict),
            (tr("refused by quality"), not entry.quality.accepted),
            (tr(entry.file_state), entry.file_state != "complete"),
        )
        if holds
    ]
    title = tr("{} on {}", entry.piece, entry.bottom)
    known = () if beside is None else (beside_text(beside),)
    return LabelListRow(entry.uuid, title, when, state, (*known, *marks, *badges))


def blind_queue_row(entry: EpisodeEntry, *, answered: bool) -> LabelListRow:
    """Return the row of an episode that is answered blind; control items look like the rest."""
    plain = queue_row(replace(entry, flagged=False, conflict=False), "unlabelled")
    return replace(plain, badges=(tr("answered"),) if answered else ())


def operation_text(operation: Operation) -> str:
    """Return one action as a line of the log."""
    episodes = operation.episodes
    what = operation.verb.removeprefix("label.").replace("_", " ")
    which = count_noun(len(episodes), "episode")
    which = tr("episode {}", episodes[0][-8:]) if len(episodes) == 1 else which
    when = f"{datetime.fromtimestamp(operation.at_ns / 1e9):%Y-%m-%d %H:%M:%S}"
    return f"{when}  {operation.actor}: {tr(what)}, {which}"


LEAST_SIGMA_MM = 0.05  # lower bound of the label's uncertainty in comparisons


def sigmas_from_model(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return the distance to the model's label in joint sigmas, None without one."""
    known = item.model is not None and edit.source != item.model.source
    return _sigmas_between(edit, item.model.fit if known and item.model is not None else None)


def sigmas_from_scene(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return the distance to the camera measurement in joint sigmas."""
    return _sigmas_between(edit, None if item.scene is None else item.scene.place)


def sigmas_from_signals(edit: LabelDraft, item: LabelItem) -> float | None:
    """Return by how many sigmas the signals fit another place better; None if not judged."""
    if item.doubt is None or edit.changed or item.doubt[0] != edit.base.rev_uuid:
        return None
    return math.sqrt(item.doubt[1])


def sources_differ(edit: LabelDraft, item: LabelItem) -> bool | None:
    """Return if the most certain evidence is notably off, None without any."""
    judged = sigmas_from_scene, sigmas_from_signals, sigmas_from_model
    known = any(sigmas(edit, item) is not None for sigmas in judged)
    return bool(evidence_badges(edit, item)) if known else None


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
    return (tr("{} {:.1f} \N{GREEK SMALL LETTER SIGMA} off", tr(name), distance),)


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
        return tr("No scene picture: a slip in the grasp is not detected.")
    place = item.scene.place
    if place is None:
        return tr("Scene camera: the rim of the face is not detected.")
    far = _distance_text(sigmas_from_scene(edit, item))
    return f"{tr('Scene camera')}: {offset_text(place.offset_mm, place.sigma_mm)}{far}"


def model_evidence_text(edit: LabelDraft, item: LabelItem, *, hidden: bool) -> str:
    """Return the model's estimate as text."""
    if hidden:
        return tr("Model and other sources are hidden.")
    model = item.model
    if model is None:
        return tr("No model of this piece, or it cannot judge this episode.")
    where = offset_text(model.fit.offset_mm, model.fit.sigma_mm)
    name = models_text(model.weights).capitalize()
    several = "+" in model.weights
    spread = f", {tr('they differ by {:.2f} mm', model.spread_mm)}" if several else ""
    return f"{name}: {where}{spread}{_distance_text(sigmas_from_model(edit, item))} (M)"


def _sigmas_between(edit: LabelDraft, other: OffsetFit | None) -> float | None:
    if edit.offset_mm is None or other is None:
        return None
    return sigmas_apart(edit.offset_mm, max(edit.sigma_mm, LEAST_SIGMA_MM), other)


def _distance_text(distance: float | None) -> str:
    return "" if distance is None else f", {tr('{:.1f} sigma off', distance)}"

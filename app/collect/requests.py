"""Requests and decisions of the collect workspace."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast, get_args

import numpy as np

from touchdown.app.collect.probes import ProbeRecord, displacement_text, quality_text, read_probe
from touchdown.app.shell import ACTIVE_STATES, is_pressing, start_obstacle
from touchdown.backend import runs
from touchdown.backend.annotations import Dataset
from touchdown.backend.bench import Session
from touchdown.backend.config import RecordingPlan
from touchdown.backend.core import EpisodeDecision, HandOverAwaited, MountingAwaited
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import ProbeText, TargetButtons, TargetForm


def probe_text(held: ProbeRecord | None, *, asking: bool, running: bool, back: bool) -> ProbeText:
    """Return the description of a probe. ``back``: an older one is shown, or no run is active."""
    if held is None:
        if running:
            return ProbeText("Probing", detail=tr("The first probe is on its way."))
        return ProbeText("No probe yet", detail=tr("Press Start collecting (F5)."))
    entry = held.entry
    accepted = entry.quality.accepted
    result, tone = (tr("\N{CHECK MARK} Observation"), "good") if accepted else (
        tr("\N{MULTIPLICATION X} No observation"), "bad"
    )  # fmt: skip
    if entry.deleted:
        result, tone = "Discarded", ""
    elif entry.flagged:
        result = tr("{}, flagged", result)
    return ProbeText(
        result,
        tone,
        f"{_place_text(held)}, {entry.uuid[-8:]}",
        _detail_text(held, back=back, running=running),
        asking,
        _allowed_decisions(held, live=running and not back),
    )


def _place_text(held: ProbeRecord) -> str:
    """Return the displacement, if known, and the item of the plan, if any."""
    at = f"x, y {displacement_text(held.offset_mm, 2, ' mm')}"
    if not np.isfinite(held.offset_mm).all():
        at = tr("No displacement")
    item = held.entry.plan_item
    return tr("{}, no plan", at) if item is None else tr("{}, item {}", at, item + 1)


def _detail_text(held: ProbeRecord, *, back: bool, running: bool) -> str:
    quality = held.entry.quality
    if not quality.accepted:
        return tr("{}. It is kept with its reasons and probed again.", quality_text(quality))
    parts = [tr("slip {:.2f} mm", quality.slip_mm)]
    if held.commanded_mm is not None:
        parts.insert(0, tr("commanded {}", displacement_text(held.commanded_mm, 2, " mm")))
    if held.signals is not None:
        parts.append(tr("Fz {:.1f} N at the end", held.signals[4]))
    if quality.dropped_frames:
        parts.append(tr("{} lost", count_noun(quality.dropped_frames, "frame")))
    text = ", ".join(parts)
    text = f"{text[0].upper()}{text[1:]}."
    if back and running:
        text = f"{text} {tr('Looking back: the run goes on.')}"
    return text


def _allowed_decisions(held: ProbeRecord, *, live: bool) -> tuple[str, ...]:
    if held.entry.deleted:
        return () if live else ("keep",)
    if live:
        return ("keep", "discard", "flag", "redo", "skip")
    return ("discard", "flag") if held.entry.plan_item is None else ("discard", "flag", "skip")


def apply_decision(
    dataset: Dataset, person: str, uuid: str, decision: EpisodeDecision
) -> ProbeRecord:
    """Apply a decision on a stored probe; return its new index entry.

    A discarded probe is repeated when its campaign continues, a skipped one is not. Keep restores a
    deleted probe; a second flag removes the first. Raises ``RefusedError`` like the label store.
    """
    labels, entry = dataset.labels, dataset.entry(uuid)
    if decision == "flag":
        labels.flag(person, uuid, present=not entry.flagged)
    elif decision == "keep":
        labels.restore(person, uuid)
    else:
        labels.delete(person, uuid, runs.DECISION_WORDS[decision])
    return read_probe(dataset, dataset.entry(uuid), signals=True)


ANSWERS = "Mounted again", "As it was"  # answers to the question about the mounting


@dataclass(frozen=True, slots=True)
class CampaignState:
    """Everything that decides which buttons of the page are enabled.

    ``mine``: the active run collects. ``go_on``: remaining work of the last campaign. ``trouble``:
    why the dataset could not be opened.
    """

    person: str
    dataset: Dataset | None
    mine: bool
    go_on: str
    asked: HandOverAwaited | MountingAwaited | None
    trouble: str = ""


def campaign_buttons(bench: Session | None, now: CampaignState) -> TargetButtons:
    """Return the enabled buttons."""
    state = runs.RunState.IDLE if bench is None else bench.status().state
    active = state in ACTIVE_STATES
    why = campaign_obstacle(bench, now)
    paused = state in (runs.RunState.PAUSED, runs.RunState.PAUSING)
    return TargetButtons(
        start=not why and not active,
        pause=now.mine and (paused or state is runs.RunState.RUNNING),
        end=now.mine and active and state is not runs.RunState.CANCELLING,
        paused=paused,
        go_on=now.go_on,
        why_not=why,
        in_contact=bench is not None and not bench.interlock.latched and is_pressing(bench),
        ask=_open_question(now) if active else "",
        answers=ANSWERS if active and isinstance(now.asked, MountingAwaited) else None,
        form=not (now.mine and active),
    )


def _open_question(now: CampaignState) -> str:
    if isinstance(now.asked, MountingAwaited):
        return runs.mounting_question(now.asked)
    return "" if now.asked is None else runs.hand_over_message(now.asked)


def campaign_obstacle(bench: Session | None, now: CampaignState) -> str:
    """Return why no campaign can start, "" if one can or is running."""
    if bench is None or not bench.devices:
        return tr("The bench is being prepared")
    if bench.status().state in ACTIVE_STATES:
        return "" if now.mine else tr("A run is going on")
    if why := start_obstacle(bench):
        pressing = not bench.interlock.latched and is_pressing(bench)
        return tr("In contact: lift first") if pressing else why
    if not now.person:
        return tr("Say who collects: give your name above (Ctrl+U)")
    if now.dataset is None:
        opening = tr("The dataset is being opened")
        return tr("No dataset: {}", now.trouble) if now.trouble else opening
    return "" if now.dataset.writable else tr("The dataset is open for reading only")


TAKEN_OVER = {"grips_per_mounting", *runs.PRESS_OF_PLAN}


def recording_plan(pattern: str) -> RecordingPlan | None:
    """Return the recording plan of an entry of the field *Pattern*, None for a pattern."""
    return None if pattern in get_args(runs.Pattern) else runs.read_plan(pattern)


def collect_request(form: TargetForm, person: str, *, campaign: str = "") -> runs.CollectRequest:
    """Return the request of a form. With ``campaign``, the plan of that campaign applies."""
    plan = recording_plan(form.pattern)
    return runs.CollectRequest(
        piece=form.piece,
        bottom=form.bottom,
        count=form.count,
        seed=form.seed or runs.fresh_seed(),
        pattern="random" if plan else cast("runs.Pattern", form.pattern),
        person=person,
        within_mm=form.within_mm or None,
        origin_mm=(form.origin_x_mm, form.origin_y_mm),
        check_origin=form.check_origin,
        campaign=campaign,
        ask=form.ask,
        probes_per_grip=form.probes_per_grip or None,
        hand_over=form.hand_over,
        **({} if plan is None or campaign else plan.model_dump(include=TAKEN_OVER)),
    )

"""What may be asked of a campaign now, and why not."""

from __future__ import annotations

from dataclasses import dataclass

from app.activity import ACTIVE, why_no_run
from app.link import Link
from backend.catalogue.dataset import Dataset
from backend.core.facts import HandOverAwaited, MountingAwaited
from backend.runs.requests import RunState
from backend.runs.words import hand_over, mounting
from widgets.target_panel import TargetButtons

ANSWERS = "Fitted anew", "As it was"
"""To the question about the mounting."""


@dataclass(frozen=True, slots=True)
class Standing:
    """How things stand: whose page it is, what is open, and what the run in progress waits for.

    ``mine``: the run that goes on collects. ``go_on``: what the last campaign still lacks.
    """

    person: str
    dataset: Dataset | None
    mine: bool
    go_on: str
    asked: HandOverAwaited | MountingAwaited | None


def buttons(link: Link | None, now: Standing) -> TargetButtons:
    """Return which buttons may be pressed."""
    state = RunState.IDLE if link is None else link.status().state
    active = state in ACTIVE
    why = why_not(link, now)
    paused = state in (RunState.PAUSED, RunState.PAUSING)
    return TargetButtons(
        start=not why and not active,
        pause=now.mine and (paused or state is RunState.RUNNING),
        end=now.mine and active and state is not RunState.CANCELLING,
        paused=paused,
        go_on=now.go_on,
        why_not=why,
        in_contact=not active and _in_contact(link),
        ask=_question(now) if active else "",
        answers=ANSWERS if active and isinstance(now.asked, MountingAwaited) else None,
        form=not (now.mine and active),
    )


def _question(now: Standing) -> str:
    if isinstance(now.asked, MountingAwaited):
        return mounting(now.asked)
    return "" if now.asked is None else hand_over(now.asked)


def why_not(link: Link | None, now: Standing) -> str:
    """Return why nothing can be started, "" if it can, or if the campaign runs."""
    if link is None or not link.devices:
        return "The bench is being prepared"
    if link.status().state in ACTIVE:
        return "" if now.mine else "A run is going on"
    if why := why_no_run(link):
        return "In contact: lift first" if _in_contact(link) else why
    if not now.person:
        return "Say who collects: give your name above (Ctrl+U)"
    if now.dataset is None:
        return "The dataset is being opened"
    return "" if now.dataset.writable else "The dataset is open for reading only"


def _in_contact(link: Link | None) -> bool:
    return (
        link is not None
        and link.hand is not None
        and not link.interlock.latched
        and bool(link.hand.pressing_n)
    )

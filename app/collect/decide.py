"""Decisions about probes: in words, and carried out where no run does it."""

from __future__ import annotations

import numpy as np

from app.collect.harvest import Held, pair_words, quality_words, read_probe
from backend.catalogue.dataset import Dataset
from backend.core.facts import Decision
from backend.runs.words import DECIDED
from widgets.last_probe_panel import ProbeWords


def words_of(held: Held | None, *, asking: bool, running: bool, back: bool) -> ProbeWords:
    """Return a probe in words. ``back``: an older one is looked at, or no run goes on."""
    if held is None:
        detail = "The first one is on its way." if running else "Press Start collecting (F5)."
        return ProbeWords("No probe yet", detail=detail)
    entry = held.entry
    accepted = entry.quality.accepted
    verdict, tone = ("\N{CHECK MARK} Observation", "good") if accepted else (
        "\N{MULTIPLICATION X} No observation", "bad"
    )  # fmt: skip
    if entry.deleted:
        verdict, tone = "Discarded", ""
    elif entry.flagged:
        verdict += ", flagged"
    return ProbeWords(
        verdict,
        tone,
        f"{_where(held)}, {entry.uuid[-8:]}",
        _detail(held, back=back, running=running),
        asking,
        _allowed(held, live=running and not back),
    )


def _where(held: Held) -> str:
    """Say the displacement, if it is known, and the item of the plan, if there was one."""
    at = f"x, y {pair_words(held.offset_mm, 2, ' mm')}"
    if not np.isfinite(held.offset_mm).all():
        at = "No displacement"
    item = held.entry.plan_item
    return f"{at}, no plan" if item is None else f"{at}, item {item + 1}"


def _detail(held: Held, *, back: bool, running: bool) -> str:
    quality = held.entry.quality
    if not quality.accepted:
        return f"{quality_words(quality)}. It is kept with its reasons and probed again."
    parts = [f"slip {quality.slip_mm:.2f} mm"]
    if held.commanded_mm is not None:
        parts.insert(0, f"commanded {pair_words(held.commanded_mm, 2, ' mm')}")
    if held.signals is not None:
        parts.append(f"Fz {held.signals[4]:.1f} N at the end")
    if quality.dropped_frames:
        lost = quality.dropped_frames
        parts.append("1 frame lost" if lost == 1 else f"{lost} frames lost")
    text = ", ".join(parts)
    text = f"{text[0].upper()}{text[1:]}."
    if back and running:
        text += " Looking back: the run goes on."
    return text


def _allowed(held: Held, *, live: bool) -> tuple[str, ...]:
    if held.entry.deleted:
        return () if live else ("keep",)
    if live:
        return ("keep", "discard", "flag", "redo", "skip")
    return ("discard", "flag") if held.entry.plan_item is None else ("discard", "flag", "skip")


def decide_stored(dataset: Dataset, person: str, uuid: str, decision: Decision) -> Held:
    """Carry out a decision about a probe that no run waits for; return it as it is then.

    A discarded one is probed again when its campaign goes on, a skipped one is not; keep brings a
    deleted one back, a second flag takes the first one off. Raises ``RefusedError`` as the labels
    do.
    """
    labels, entry = dataset.labels, dataset.entry(uuid)
    if decision == "flag":
        labels.flag(person, uuid, present=not entry.flagged)
    elif decision == "keep":
        labels.restore(person, uuid)
    else:
        labels.delete(person, uuid, DECIDED[decision])
    return read_probe(dataset, dataset.entry(uuid), signals=True)

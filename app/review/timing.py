"""Timed playback of a recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from touchdown.app.shell import RunStory, TrialStory
from touchdown.backend.annotations import patch_iou
from touchdown.backend.core import (
    ActionChosen,
    BeliefUpdated,
    ContactPatch,
    EpisodeRecorded,
    Event,
    FloatArray,
    PatchEstimated,
    PhaseEntered,
    Released,
    RunStarted,
    TrialFinished,
    TrialStarted,
)
from touchdown.backend.geometry import Outline
from touchdown.widgets.views import TimeMark

TOUCHING = 0.5
"""A point is said to touch above this probability."""


@dataclass(frozen=True, slots=True)
class PatchScore:
    """An estimated patch against the true one: overlap, and the share of points said right."""

    probe: int
    iou: float
    accuracy: float


@dataclass(frozen=True, slots=True)
class TrialTimeline:
    """Facts of one trial, ``head`` of its run first; the bench clock starts with each trial."""

    head: RunStarted
    facts: tuple[Event, ...]

    def numbered(self, number: int) -> TrialTimeline:
        """Return the trial as number ``number`` of several."""
        first, *others = self.facts
        if isinstance(first, TrialStarted):
            first = replace(first, trial=number)
        return TrialTimeline(self.head, (first, *others))

    @property
    def times_s(self) -> FloatArray:
        """(n,) times of the facts; never falling."""
        return np.maximum.accumulate(np.array([f.t_s for f in self.facts], dtype=np.float64))

    def known(self, cursor_s: float) -> tuple[Event, ...]:
        """Return the facts not later than the cursor."""
        return self.facts[: int(np.searchsorted(self.times_s, cursor_s + 1e-9, side="right"))]

    def story(self, cursor_s: float) -> TrialStory:
        """Return what was known of the trial at the cursor."""
        story = RunStory(of_any=True)
        story.take(self.head)
        for fact in (self.facts[0], *self.known(cursor_s)[1:]):
            story.take(fact)
        assert story.trial is not None
        return story.trial

    def patch(self, cursor_s: float) -> PatchEstimated | None:
        """Return the newest patch not later than the cursor."""
        found = [f for f in self.known(cursor_s) if isinstance(f, PatchEstimated)]
        return found[-1] if found else None

    def episodes(self) -> list[EpisodeRecorded]:
        """Return the episodes of the trial in order."""
        return [f for f in self.facts if isinstance(f, EpisodeRecorded)]

    def decided_s(self, probe: int) -> float:
        """Return when all was known of a probe: its last fact, or the end of the trial."""
        known = (PatchEstimated, BeliefUpdated, ActionChosen)
        times = [f.t_s for f in self.facts if isinstance(f, known) and f.probe == probe]
        return max(times) if times else float(self.times_s[-1])

    def marks(self) -> tuple[TimeMark, ...]:
        """Return what happened: probes, decisions, release and outcome."""
        marks: list[TimeMark] = []
        for fact in self.facts:
            if isinstance(fact, PhaseEntered):
                press = fact.phase == "press"
                marks.append(
                    TimeMark(fact.t_s, f"probe {fact.probe}" if press else fact.phase, press)
                )
            elif isinstance(fact, ActionChosen):
                marks.append(TimeMark(fact.t_s, fact.action.kind.replace("_", " "), strong=True))
            elif isinstance(fact, Released):
                marks.append(TimeMark(fact.t_s, "let go", strong=True))
            elif isinstance(fact, TrialFinished):
                marks.append(TimeMark(fact.t_s, fact.outcome.name.lower().replace("_", " "), True))
        return tuple(marks)

    def score(self, cursor_s: float, bottom: Outline | None) -> PatchScore | None:
        """Return how well the newest patch fits the true one; None where no truth is known."""
        patch, whole = self.patch(cursor_s), self.story(float("inf"))
        shift = whole.frame_shift_mm()
        if patch is None or shift is None or bottom is None:
            return None
        return patch_score(patch.probe, patch.patch, patch.offset_mm, shift, bottom)


def patch_score(
    probe: int,
    patch: ContactPatch,
    offset_mm: tuple[float, float],
    shift_mm: tuple[float, float],
    bottom: Outline,
) -> PatchScore:
    """Compare a patch with the points of the face that lie over the true bottom."""
    said = patch.probability > TOUCHING
    real = bottom.contains(patch.points_mm + np.subtract(offset_mm, shift_mm))
    return PatchScore(probe, patch_iou(said, real), float(np.mean(said == real)))


def split_into_trials(facts: Iterable[Event]) -> list[TrialTimeline]:
    """Split the facts of a run into its trials; what comes before the first belongs to none.

    A single probe is shown as a trial of its own.
    """
    head: RunStarted | None = None
    parts: list[list[Event]] = []
    for fact in facts:
        if isinstance(fact, RunStarted):
            head = fact
            if fact.activity == "probe":
                parts.append([TrialStarted(fact.t_s, 1, fact.seed, None)])
        elif isinstance(fact, TrialStarted):
            parts.append([fact])
        elif parts:
            parts[-1].append(fact)
    return [] if head is None else [TrialTimeline(head, tuple(part)) for part in parts]

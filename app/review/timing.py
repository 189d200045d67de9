"""Timed playback of a recording."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from touchdown.app.shell import RunStory, TrialStory
from touchdown.backend import core
from touchdown.backend.annotations import patch_iou
from touchdown.backend.geometry import Outline
from touchdown.widgets.base import tr
from touchdown.widgets.views import TimeMark

TOUCHING = 0.5  # probability above which a point counts as touching


@dataclass(frozen=True, slots=True)
class PatchScore:
    """Fit of an estimated patch to the true one: overlap, and share of correct points."""

    probe: int
    iou: float
    accuracy: float


@dataclass(frozen=True, slots=True)
class TrialTimeline:
    """Events of one trial with the ``head`` of its run. The bench clock starts with each trial."""

    head: core.RunStarted
    events: tuple[core.Event, ...]

    def numbered(self, number: int) -> TrialTimeline:
        """Return the trial with its number."""
        first, *others = self.events
        if isinstance(first, core.TrialStarted):
            first = replace(first, trial=number)
        return TrialTimeline(self.head, (first, *others))

    @property
    def times_s(self) -> core.FloatArray:
        """(n,) times of the events, never decreasing."""
        return np.maximum.accumulate(np.array([f.t_s for f in self.events], dtype=np.float64))

    def known(self, cursor_s: float) -> tuple[core.Event, ...]:
        """Return the events not later than the cursor."""
        return self.events[: int(np.searchsorted(self.times_s, cursor_s + 1e-9, side="right"))]

    def story(self, cursor_s: float) -> TrialStory:
        """Return the state of the trial at the cursor."""
        story = RunStory(of_any=True)
        story.take(self.head)
        for event in (self.events[0], *self.known(cursor_s)[1:]):
            story.take(event)
        assert story.trial is not None
        return story.trial

    def patch(self, cursor_s: float) -> core.PatchEstimated | None:
        """Return the newest patch not later than the cursor."""
        found = [f for f in self.known(cursor_s) if isinstance(f, core.PatchEstimated)]
        return found[-1] if found else None

    def episodes(self) -> list[core.EpisodeRecorded]:
        """Return the episodes of the trial in order."""
        return [f for f in self.events if isinstance(f, core.EpisodeRecorded)]

    def decided_s(self, probe: int) -> float:
        """Return the time of the last event of a probe, or the end of the trial."""
        known = (core.PatchEstimated, core.BeliefUpdated, core.ActionChosen)
        times = [f.t_s for f in self.events if isinstance(f, known) and f.probe == probe]
        return max(times) if times else float(self.times_s[-1])

    def marks(self) -> tuple[TimeMark, ...]:
        """Return the marks of the time line: probes, decisions, release and outcome."""
        marks: list[TimeMark] = []
        for event in self.events:
            if isinstance(event, core.PhaseEntered):
                press = event.phase == "press"
                word = tr("probe {}", event.probe) if press else tr(event.phase)
                marks.append(TimeMark(event.t_s, word, press))
            elif isinstance(event, core.ActionChosen):
                marks.append(
                    TimeMark(event.t_s, tr(event.action.kind.replace("_", " ")), strong=True)
                )
            elif isinstance(event, core.Released):
                marks.append(TimeMark(event.t_s, tr("released"), strong=True))
            elif isinstance(event, core.TrialFinished):
                outcome = event.outcome.name.lower().replace("_", " ")
                marks.append(TimeMark(event.t_s, tr(outcome), strong=True))
        return tuple(marks)

    def score(self, cursor_s: float, bottom: Outline | None) -> PatchScore | None:
        """Return the fit of the newest patch to the true one, None without a known truth."""
        patch, whole = self.patch(cursor_s), self.story(float("inf"))
        shift = whole.frame_shift_mm()
        if patch is None or shift is None or bottom is None:
            return None
        return patch_score(patch.probe, patch.patch, patch.offset_mm, shift, bottom)


def patch_score(
    probe: int,
    patch: core.ContactPatch,
    offset_mm: tuple[float, float],
    shift_mm: tuple[float, float],
    bottom: Outline,
) -> PatchScore:
    """Compare a patch with the points of the face over the true bottom."""
    said = patch.probability > TOUCHING
    real = bottom.contains(patch.points_mm + np.subtract(offset_mm, shift_mm))
    return PatchScore(probe, patch_iou(said, real), float(np.mean(said == real)))


def split_into_trials(events: Iterable[core.Event]) -> list[TrialTimeline]:
    """Split the events of a run into its trials. Events before the first trial are dropped.

    A single probe is returned as a trial.
    """
    head: core.RunStarted | None = None
    parts: list[list[core.Event]] = []
    for event in events:
        if isinstance(event, core.RunStarted):
            head = event
            if event.activity == "probe":
                parts.append([core.TrialStarted(event.t_s, 1, event.seed, None)])
        elif isinstance(event, core.TrialStarted):
            parts.append([event])
        elif parts:
            parts[-1].append(event)
    return [] if head is None else [TrialTimeline(head, tuple(part)) for part in parts]

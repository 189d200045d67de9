"""Replay of a recorded run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from touchdown.app import shell
from touchdown.app.review.episodes import TrialRecording
from touchdown.app.review.page import ReviewPage
from touchdown.app.review.timing import TOUCHING, PatchScore, TrialTimeline
from touchdown.backend.core import Said, TrialFinished
from touchdown.backend.geometry import Outline
from touchdown.backend.runs import Bookmark
from touchdown.widgets import views
from touchdown.widgets.base import tr
from touchdown.widgets.plots import NO_WRENCH

NO_RECORDING = views.DecisionText("No recording chosen", "", "", "Choose one in the list.")
NO_READING = views.DecisionText("No estimate", "", "", "No model evaluated a probe here.")
NO_MAP = ("No belief map", "No model evaluated a probe here.")
TOUCH_S = 0.005  # farthest bookmark from the cursor that counts as the one at it
ONE_PROBE = ("No belief map", "A belief map needs a stacking run; this is a single probe.")


class ReplayPresenter:
    """Holds the cursor. Every view shows the newest samples not later than it."""

    def __init__(self, page: ReviewPage) -> None:
        self._page = page
        self.trial: TrialTimeline | None = None
        self.recorded = TrialRecording()
        self.cursor_s = 0.0
        self._whole: shell.TrialStory | None = None
        self._told: Sequence[str] = ()
        self._faces: tuple[Outline | None, Outline | None] = (None, None)
        self._said_s = np.zeros(0)
        self.bookmarks: Sequence[Bookmark] = ()
        self._known = -1

    @property
    def _single(self) -> bool:
        return self.trial is not None and self.trial.head.activity == "probe"

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time of events and signals."""
        times = [] if self.trial is None else self.trial.times_s.tolist()
        times += [t for span in self.recorded.spans_s for t in span]
        return (min(times), max(times)) if times else (0.0, 0.0)

    def show(
        self,
        trial: TrialTimeline | None,
        face: Outline | None = None,
        bottom: Outline | None = None,
        told: Sequence[str] = (),
    ) -> None:
        """Show a trial at its end; its signals follow later.

        ``told``: the messages of the whole run.
        """
        self.trial, self.recorded, self._faces = trial, TrialRecording(), (face, bottom)
        self._whole = None if trial is None else trial.story(float("inf"))
        self.bookmarks, self._told = (), told
        self._tell()
        self._page.signals_panel.detail.setText("")
        why = NO_WRENCH if trial is not None else ""
        for view in (self._page.forces, self._page.moments):
            view.show_trace(None, why=why)
        self._show_strip()
        self.take(TrialRecording())

    def show_bookmarks(self, bookmarks: Sequence[Bookmark]) -> None:
        """Show the bookmarks of the trial."""
        self.bookmarks = bookmarks
        self._tell()
        self._draw_time()
        self.seek(self.cursor_s)

    def jump_to_bookmark(self, by: int) -> None:
        """Move to the next (1) or the previous (-1) bookmark."""
        times = [mark.t_s for mark in self.bookmarks]
        later = [t for t in times if by * (t - self.cursor_s) > TOUCH_S]
        if later:
            self._page.film.stop()
            self.seek(min(later) if by > 0 else max(later))

    def _tell(self) -> None:
        """List the events and the bookmarks, by time."""
        events = () if self.trial is None else self.trial.events
        lines = [(event.t_s, text) for event in events if (text := _line(event))]
        told = [] if lines else self._told
        lines += [(mark.t_s, tr("Bookmark: {}", mark.note)) for mark in self.bookmarks]
        lines.sort(key=lambda line: line[0])
        self._said_s = np.array([t_s for t_s, _ in lines])
        self._page.story.clear()
        self._page.story.addItems([*(text for _, text in lines), *told])

    def _draw_time(self) -> None:
        marks = () if self.trial is None else self.trial.marks()
        notes = tuple(views.TimeMark(m.t_s, m.note, strong=True, note=True) for m in self.bookmarks)
        both = tuple(sorted((*marks, *notes), key=lambda mark: mark.t_s))
        self._page.time_line.show_scene(views.TimeScene(self.span_s, self.recorded.spans_s, both))

    def take(self, recorded: TrialRecording) -> None:
        """Add the signals of the trial; the cursor stays if it is inside them."""
        self.recorded = recorded
        span = self.span_s
        self._draw_time()
        self._page.film.take_reel(recorded.reel, span)
        self.seek(span[1])

    def seek(self, t_s: float) -> None:
        """Move the cursor."""
        low, high = self.span_s
        self.cursor_s = min(max(t_s, low), high)
        page = self._page
        trace = self.recorded.trace_at(self.cursor_s)
        for view in (page.forces, page.moments):
            if view.trace is not trace:
                view.show_trace(trace)
        page.show_cursor(self.cursor_s)
        if self.trial is None:
            page.film.show_none()
        at = views.latest(self._said_s, self.cursor_s)
        page.story.setCurrentRow(at)
        if at < 0:
            page.story.scrollToTop()
        self._show_belief()

    def step(self, by: int) -> None:
        """Move to the next or previous sample: a picture, or an event without pictures."""
        before = self.cursor_s
        self._page.film.step(by)
        if self.cursor_s == before and self.trial is not None:
            times = np.unique(self.trial.times_s)
            later, earlier = times[times > before + 1e-9], times[times < before - 1e-9]
            found = later[:1] if by > 0 else earlier[-1:]
            if len(found):
                self.seek(float(found[0]))

    def jump(self, by_s: float) -> None:
        """Move the cursor by a duration."""
        self._page.film.stop()
        self.seek(self.cursor_s + by_s)

    def choose_probe(self, index: int) -> None:
        """Move the cursor to the last event of a probe."""
        if self.trial is not None and self._whole is not None:
            self._page.film.stop()
            self.seek(self.trial.decided_s(self._whole.probes[index].probe))

    def score(self) -> PatchScore | None:
        """Return the fit of the patch at the cursor to the true one."""
        return None if self.trial is None else self.trial.score(self.cursor_s, self._faces[1])

    # -- showing ----------------------------------------------------------------------------------

    def _show_strip(self) -> None:
        whole, self._known = self._whole, -1
        if whole is None or not whole.probes or self._single:
            ended = whole is not None and whole.finished is not None
            self._page.strip.show_probes([], -1, views.NO_PROBES if ended else ("", ""))
            return
        scenes = [self._scene(whole, i) for i in range(len(whole.probes))]
        captions = [
            views.caption_of(p.probe, p.stability) + self._iou(p.probe) for p in whole.probes
        ]
        self._page.strip.show_probes(list(zip(scenes, captions, strict=True)), len(scenes) - 1)

    def _iou(self, probe: int) -> str:
        """Return the fit of a probe's estimate to the truth, where it is known."""
        if self.trial is None:
            return ""
        score = self.trial.score(self.trial.decided_s(probe), self._faces[1])
        return "" if score is None or score.probe != probe else f"\nIoU {100 * score.iou:.0f} %"

    def _scene(self, story: shell.TrialStory, index: int) -> views.BeliefScene:
        scene = shell.belief_scene(story, index, *self._faces)
        if scene.truth is None and self._whole is not None:
            truth = shell.true_patch_outline(self._whole, story.probes[index], *self._faces)
            scene = replace(scene, truth=truth)
        return scene

    def _show_belief(self) -> None:
        page, trial = self._page, self.trial
        known = 0 if trial is None else len(trial.known(self.cursor_s))
        if known == self._known:
            return
        self._known = known
        story = None if trial is None else trial.story(self.cursor_s)
        if trial is None or story is None or not story.probes:
            self._show_no_probe(story)
            return
        if self._single:
            self._show_single(trial)
            return
        index = len(story.probes) - 1
        scene, look = self._scene(story, index), story.probes[index]
        page.belief.show_scene(scene)
        page.legend.show_truth(scene.truth is not None)
        text = views.decision_text(look.stability, look.action)
        if story.finished is not None:
            text = shell.outcome_text(story, trial.head)
        page.decision.show_text(text)
        count = len(self._whole.probes) if self._whole is not None else 0
        page.belief_panel.detail.setText(tr("probe {} of {}", look.probe, count))
        page.estimate.setText(patch_score_text(self.score()))
        page.strip.mark(index)

    def _show_single(self, trial: TrialTimeline) -> None:
        patch = trial.patch(self.cursor_s)
        assert patch is not None
        share = float(np.mean(patch.patch.probability > TOUCHING))
        self._page.belief.show_scene(views.BeliefScene(empty=ONE_PROBE))
        said = tr("Contact on {:.0f} % of the face.", 100 * share)
        self._page.decision.show_text(views.DecisionText("Single probe", "", "", said))

    def _show_no_probe(self, story: shell.TrialStory | None) -> None:
        page, whole = self._page, self._whole
        if whole is None:
            scene, text = views.BeliefScene(empty=("", "")), NO_RECORDING
        elif whole.probes or whole.finished is not None:
            scene = views.BeliefScene() if whole.probes else shell.unprobed_scene(whole)
            text = views.DecisionText("No probe", "", "", _ending(story))
        else:
            scene, text = views.BeliefScene(empty=NO_MAP), NO_READING
        page.belief.show_scene(scene)
        page.belief_panel.detail.setText("")
        page.estimate.setText("")
        page.strip.mark(-1)
        page.decision.show_text(text)


def _line(event: object) -> str:
    if isinstance(event, Said):
        return event.text
    if isinstance(event, TrialFinished):
        return f"{tr(views.OUTCOME_WORDS[event.outcome]).capitalize()}: {event.reason}"
    return ""


def _ending(story: shell.TrialStory | None) -> str:
    if story is None or story.finished is None:
        return tr("There is nothing to show at this time.")
    return story.finished.reason


def patch_score_text(score: PatchScore | None) -> str:
    """Return the fit of an estimate to the truth as text."""
    if score is None:
        return tr("Estimate against truth: not known here.")
    figures = "Estimate against truth, probe {}: IoU {:.0f} %, {:.0f} % of the points right"
    return tr(figures, score.probe, 100 * score.iou, 100 * score.accuracy)

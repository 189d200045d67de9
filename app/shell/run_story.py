"""Story of a run, rebuilt from its events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from touchdown.backend import core
from touchdown.backend.geometry import Outline, PieceLibrary, overlap_polygon
from touchdown.backend.learning import rate_interval
from touchdown.backend.runs import excluding_fault
from touchdown.widgets import views
from touchdown.widgets.base import tr

Offset = tuple[float, float]
SEGMENTS = 96  # corners of a drawn circle
PRESSING = frozenset({"press", "hold"})
RELEASED = frozenset({core.Outcome.PLACED, core.Outcome.FELL, core.Outcome.KNOCKED_OVER})


@dataclass(frozen=True, slots=True)
class ProbeStory:
    """State of one probe."""

    probe: int
    offset_mm: Offset | None = None
    belief: core.BeliefMap | None = None
    stability: core.Stability | None = None
    action: core.PlaceAction | None = None
    latency_ms: float | None = None


@dataclass
class TrialStory:
    """One trial: its probes in order and its outcome."""

    trial: int
    seed: int
    start_mm: Offset | None
    probes: list[ProbeStory] = field(default_factory=list)
    phase: str = ""
    finished: core.TrialFinished | None = None
    stands: bool | None = None
    fall: core.Fall | None = None
    weighed: core.PieceWeighed | None = None

    @property
    def excuse(self) -> str:
        """Device fault that excludes the trial from the success rate, "" if it counts."""
        return "" if self.finished is None else excluding_fault(self.finished, self.phase)

    def path(self, upto: int) -> tuple[Offset, ...]:
        """Offsets of the first ``upto`` probes."""
        return tuple(p.offset_mm for p in self.probes[:upto] if p.offset_mm is not None)

    def frame_shift_mm(self) -> Offset | None:
        """Position of the true bottom in the frame of the commanded offsets.

        A grasp offset moves the piece, so the map is displaced by commanded minus true start.
        """
        first = next((p.offset_mm for p in self.probes if p.offset_mm is not None), None)
        if first is None or self.start_mm is None:
            return None
        return first[0] - self.start_mm[0], first[1] - self.start_mm[1]


# Fields of ``ProbeStory`` that an event reports under the same names.
REPORTED: dict[type[core.Event], tuple[str, ...]] = {
    core.PatchEstimated: ("probe", "offset_mm"),
    core.BeliefUpdated: ("probe", "belief"),
    core.StabilityJudged: ("probe", "stability"),
    core.ActionChosen: ("probe", "action", "latency_ms"),
}


class RunStory:
    """State of a run, built from its events in order.

    ``of_any``: accept runs of all activities, as in a log; else only stacking runs are followed.
    """

    def __init__(self, *, of_any: bool = False) -> None:
        self._of_any = of_any
        self.head: core.RunStarted | None = None
        self.trials: list[TrialStory] = []
        self.ended: core.RunFinished | None = None
        self.version = 0
        self._mine = True

    @property
    def trial(self) -> TrialStory | None:
        """The newest trial."""
        return self.trials[-1] if self.trials else None

    @property
    def outcomes(self) -> tuple[core.Outcome, ...]:
        """Outcomes of the finished trials."""
        return tuple(t.finished.outcome for t in self.trials if t.finished is not None)

    def take(self, event: core.Event) -> None:
        """Add the next event."""
        if isinstance(event, core.RunStarted):
            self._mine = self._of_any or event.activity == "stack"
        if not self._mine:
            return
        reported = REPORTED.get(type(event))
        if reported is not None:
            known = {name: getattr(event, name) for name in reported}
            self._note(known.pop("probe"), **known)
        elif not self._follow(event):
            return
        self.version += 1

    def _follow(self, event: core.Event) -> bool:
        """Follow an event that reports no probe; return False if it has no effect."""
        trial = self.trial
        if isinstance(event, core.RunStarted):
            self.head, self.ended = event, None
            self.trials.clear()
        elif isinstance(event, core.TrialStarted):
            self.trials.append(TrialStory(event.trial, event.seed, event.start_mm))
        elif isinstance(event, core.RunFinished):
            self.ended = event
        elif trial is not None and isinstance(event, core.PhaseEntered):
            trial.phase = event.phase
        elif trial is not None and isinstance(event, core.Released):
            trial.stands, trial.fall = event.stands, event.fall
        elif trial is not None and isinstance(event, core.PieceWeighed):
            trial.weighed = event
        elif trial is not None and isinstance(event, core.TrialFinished):
            trial.finished = event
        else:
            # A question or a sentence changes the state of the bench, which is shown beside.
            return isinstance(event, core.ApprovalAwaited | core.Said)
        return True

    def _note(self, probe: int, **known: object) -> None:
        """Update the state of ``probe``; a repeated number replaces the older probe."""
        trial = self.trial
        if trial is None:
            return
        for index, look in enumerate(trial.probes):
            if look.probe == probe:
                trial.probes[index] = replace(look, **known)  # type: ignore[arg-type]
                return
        trial.probes.append(replace(ProbeStory(probe), **known))  # type: ignore[arg-type]


def true_patch_outline(
    trial: TrialStory, look: ProbeStory, face: Outline | None, bottom: Outline | None
) -> core.FloatArray | None:
    """Return the (k, 2) outline of the true overlap at a probe, None if unknown."""
    shift = trial.frame_shift_mm()
    if shift is None or bottom is None or face is None:
        return None
    (x_mm, y_mm), (shift_x_mm, shift_y_mm) = look.offset_mm or (0.0, 0.0), shift
    return overlap_polygon(face, (x_mm - shift_x_mm, y_mm - shift_y_mm), bottom) + shift


def unprobed_scene(trial: TrialStory) -> views.BeliefScene:
    """Return the scene of a trial without an estimate, with the reason."""
    if trial.finished is not None:
        empty = "No probe in this trial", "It ended before the first estimate."
    elif trial.phase in PRESSING:
        empty = "The first probe is running", "Its estimate fills the map."
    else:
        empty = views.NO_PROBE if trial.weighed is None else _weight(trial.weighed)
    return views.BeliefScene(empty=empty)


def _weight(found: core.PieceWeighed) -> tuple[str, str]:
    (x, y), (x_sigma, y_sigma) = found.com_xy_mm, found.sigma_mm
    at = "Centre of mass {:+.1f} \N{PLUS-MINUS SIGN} {:.1f}, {:+.1f} \N{PLUS-MINUS SIGN} {:.1f} mm"
    title = tr(at, x, x_sigma, y, y_sigma)
    return (
        title.replace("-", "\N{MINUS SIGN}"),
        tr("The piece weighs {:.0f} g. The first press fills the map.", found.mass_g),
    )


def belief_scene(
    trial: TrialStory, index: int, face: Outline | None, bottom: Outline | None
) -> views.BeliefScene:
    """Return the belief scene after probe ``index`` (from 0).

    The true overlap of ``face`` and ``bottom`` is shown only after the trial.
    """
    look = trial.probes[index]
    truth = None if trial.finished is None else true_patch_outline(trial, look, face, bottom)
    action = look.action
    return views.BeliefScene(
        belief=look.belief,
        stability=look.stability,
        path=trial.path(index + 1),
        step_mm=action.step_mm if action is not None and action.kind == "shift" else None,
        target_mm=action.target_mm if action is not None and action.kind == "shift" else None,
        clipped=action.clipped if action is not None else False,
        face=None if face is None else face.path(SEGMENTS),
        truth=truth,
        com_sigma_mm=None if trial.weighed is None else trial.weighed.sigma_mm,
    )


def outcome_text(trial: TrialStory, head: core.RunStarted | None) -> views.DecisionText:
    """Return the outcome of a finished trial, with the last estimate beside a true margin."""
    done, margin, caption = trial.finished, "", views.ESTIMATED_MARGIN
    assert done is not None
    placed, text = done.outcome is core.Outcome.PLACED, done.reason
    # Without a release the margin is not part of the outcome.
    if done.outcome in RELEASED and done.margin_mm is not None:
        margin = views.signed_mm(done.margin_mm)
    last = trial.probes[-1].stability if trial.probes else None
    if head is not None and head.simulated:
        caption = views.TRUE_MARGIN
        if margin and last is not None:
            said = "{} Estimate: stands, {}." if last.stable else "{} Estimate: falls, {}."
            if last.stable and not placed:
                said = "{} Estimate: stands, {}, {:.1f} mm too high."
            too_high_mm = last.margin_mm - (done.margin_mm or 0.0)
            text = tr(said, text, views.signed_mm(last.margin_mm), too_high_mm)
    mark = "\N{CHECK MARK}" if placed else "\N{MULTIPLICATION X}"
    word = tr(views.OUTCOME_WORDS[done.outcome])
    several = head is not None and head.trials > 1
    title = f"{mark} {tr('Trial {} {}', done.trial, word) if several else word.capitalize()}"
    return views.DecisionText(title, "good" if placed else "bad", margin, text, caption)


def run_score(trials: Sequence[TrialStory], planned: int, last: str) -> views.Score:
    """Return the score of a run. Aborted trials count as failures.

    Trials ended by a named device fault before the release are listed after ``last`` instead.
    """
    done = [trial for trial in trials if trial.finished is not None]
    outcomes = tuple(t.finished.outcome for t in done if t.finished is not None)
    excuses = sorted({trial.excuse for trial in done} - {""})
    excused = sum(bool(trial.excuse) for trial in done)
    if excused:
        said = "Not counted: {} that device faults ended before the release ({})."
        if excused == 1:
            said = "Not counted: {} trial that a device fault ended before the release ({})."
        last = f"{last} {tr(said, excused, ', '.join(excuses))}".strip()
    placed = sum(outcome is core.Outcome.PLACED for outcome in outcomes)
    counted = len(outcomes) - excused
    interval = rate_interval(placed, counted) if counted else None
    ended = [t.finished for t in done if t.finished is not None]
    aborted = (one for one in ended if one.outcome is core.Outcome.ABORTED)
    void = tuple(tr("Trial {}: {}", one.trial, one.reason) for one in aborted)
    return views.Score(outcomes, planned, interval, last, excused, void)


def face_outlines(
    catalogue: PieceLibrary, head: core.RunStarted | None
) -> tuple[Outline | None, Outline | None]:
    """Return the outlines of the piece's face and of the touched bottom, None if unknown."""
    if head is None:
        return None, None
    return _outline(catalogue, head.piece), _outline(catalogue, head.bottom.split("+")[-1])


def _outline(catalogue: PieceLibrary, name: str) -> Outline | None:
    piece = catalogue.pieces.get(name)
    return None if piece is None else piece.face

"""Presenter of the stack workspace."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from touchdown.app import shell
from touchdown.app.stack.comparison import strategy_by_name
from touchdown.app.stack.page import StackPage
from touchdown.backend import runs
from touchdown.backend.bench import Session
from touchdown.backend.core import Event, InputError, RefusedError, TrialFinished
from touchdown.backend.geometry import LEAST_WEIGHED_G
from touchdown.backend.learning import gel_mismatches
from touchdown.widgets import views
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import RunButtons, RunForm
from touchdown.widgets.shell import CardText, FaultCards

# Text above the map of a trial without an estimate while its run is stopped.
HELD_UP = {
    runs.RunState.PAUSING: ("Pausing", "The arm lifts, then waits until you resume."),
    runs.RunState.PAUSED: ("Paused", "The arm is lifted. Resume goes on."),
    runs.RunState.CANCELLING: ("Cancelling", "The arm lifts; the grip is kept."),
}


class StackPresenter:
    """Follows the present run and shows it."""

    def __init__(self, bench: Session, page: StackPage, cards: FaultCards) -> None:
        self._bench, self._page, self._cards = bench, page, cards
        self.story = shell.RunStory()
        self._parts = (self._draw_decision, self._draw_map, self._draw_strip, self._draw_score)
        self._shown_versions = [-1] * len(self._parts)
        self._next_part = 0
        self._chosen: int | None = None
        self._scenes: dict[tuple[int, int, bool], tuple[shell.ProbeStory, views.BeliefScene]] = {}
        self._buttons: RunButtons | None = None
        self._state = runs.RunState.IDLE
        self._asking = ""

    # -- orders -----------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the run of the form."""
        if not shell.is_run_active(self._bench):
            self.show_model()
            self.begin(stack_request(self._page.run.form()))

    def begin(self, request: runs.StackRequest) -> bool:
        """Start a run; return False and show a card if it is refused."""
        try:
            self._bench.start(request)
        except RefusedError as error:
            latched = self._bench.interlock.latched
            self._cards.show_card(CardText(error.reason, "The run was not started.", error.detail,
                                           "", reset=latched, passing=not latched))  # fmt: skip
        except InputError as error:
            self._cards.show_card(shell.error_card("INPUT", error))
        else:
            return True
        return False

    def answer(self, yes: bool) -> None:
        """Execute the proposed move, or reject it."""
        if self._bench.status().awaiting is not None:
            self._bench.answer(yes)

    def choose(self, index: int) -> None:
        """Show an earlier probe; choosing the newest one follows the run again."""
        trial = self._shown_trial()
        last = len(trial.probes) - 1 if trial is not None else 0
        self._chosen = None if index >= last else index
        self._shown_versions = [-1] * len(self._parts)

    # -- showing ----------------------------------------------------------------------------------

    def show_model(self) -> None:
        """Show the model that a run of the form would use, and its certificate."""
        form, run = self._page.run.form(), self._page.run
        words = shell.run_model_caption(form.piece, form.strategy)
        run.show_model(words.short, words.full)
        bench = self._bench
        pieces = bench.catalogue.pieces
        heavy = form.piece in pieces and pieces[form.piece].mass_g >= LEAST_WEIGHED_G
        run.show_options(weigh=heavy, stages=form.strategy != "pick-and-place")
        withheld = self._withheld(form)
        request = stack_request(form)
        if not request.learned:
            run.show_certificate("", "")
            run.show_signals(withheld)
            return
        try:
            status = runs.certificate_status(bench.identity, bench.method, request)
            guard = bench.guard_of(request.method(bench.method))
        except InputError as error:
            run.show_certificate(error.what, error.fix)
            return
        withdrawn = guard is not None and guard.withdrawn and status.certificate is not None
        text = tr("Certificate withdrawn.") if withdrawn else status.message
        run.show_certificate(text, status.message if withdrawn else status.scope)
        run.show_signals(f"{'' if guard is None else guard.describe()} {withheld}".strip())

    def _withheld(self, form: RunForm) -> str:
        """Return why the daily check withholds releases, and what a replaced gel invalidates."""
        try:
            texts, store = [self._bench.day_checks.obstacle()], self._bench.calibrations
            camera = None if store is None else store.status("camera", {})
            if camera is not None and camera.condition == "gel replaced":
                texts.append(tr("Camera calibration: {}.", camera.why))
            if form.strategy in ("paper", "paper-calibrated"):
                found = gel_mismatches(shell.model_card_in_use(form.piece), self._bench.description)
                texts += [tr("Model trained with another gel: {}.", one) for one in found]
        except InputError as error:
            return error.what
        return " ".join(filter(None, texts))

    def take(self, event: Event) -> None:
        """Handle one event; it is drawn with the next tick."""
        trials = len(self.story.trials)
        self.story.take(event)
        if isinstance(event, TrialFinished):
            self.show_model()
        if len(self.story.trials) != trials:
            self._chosen = None
            self._scenes.clear()

    def draw(self) -> None:
        """Redraw what changed, one part of the page per call, as Qt lays out each part again."""
        status = self._bench.status()
        self._draw_buttons(status)
        if status.awaiting is not None and self._shown_versions[0] != self.story.version:
            # Draw what a question is about before the question.
            self._shown_versions[0] = self.story.version
            self._draw_decision()
        self._draw_question(status)
        if status.state is not self._state:
            self._state = status.state
            self._shown_versions[0] = -1
        for _ in self._parts:
            piece = self._next_part
            self._next_part = (piece + 1) % len(self._parts)
            if self._shown_versions[piece] != self.story.version:
                self._shown_versions[piece] = self.story.version
                self._parts[piece]()
                return
        self._next_part = 0

    def _draw_buttons(self, status: runs.RunStatus) -> None:
        state, active = status.state, status.state in shell.ACTIVE_STATES
        why = "" if active else shell.start_obstacle(self._bench)
        buttons = RunButtons(
            start=not why and not active,
            pause=state in (runs.RunState.RUNNING, runs.RunState.PAUSING, runs.RunState.PAUSED),
            cancel=active and state is not runs.RunState.CANCELLING,
            paused=state in (runs.RunState.PAUSED, runs.RunState.PAUSING),
            form=not active,
            why_not=why,
        )
        if buttons != self._buttons:
            self._buttons = buttons
            self._page.run.show_buttons(buttons)
        text = tr("trial {} of {}", status.trial, status.trials) if active and status.trial else ""
        if text and status.phase and status.probe:
            step = tr("step {} of {}", status.step, status.steps) if status.steps else ""
            text += f", {tr('probe {}: {}', status.probe, step or tr(status.phase))}"
        self._page.run.detail.setText(text)
        # Leaves the width of the header to the progress.
        self._page.add_piece.setVisible(not active)

    def _draw_question(self, status: runs.RunStatus) -> None:
        asking, button = "", ""
        self._page.decision.keep_room(self._page.run.form().mode != "auto")
        if status.awaiting is not None and self._has_heard(status):
            asking, act = views.question_text(status.awaiting)
            button = f"{tr(act)}  {'N' if self._page.run.form().mode == 'step' else 'A'}"
        if asking != self._asking:
            self._asking = asking
            self._page.decision.show_question(asking, button)

    def _has_heard(self, status: runs.RunStatus) -> bool:
        """Return True if the decision on the newest estimate has arrived; events lag the status."""
        trial = self.story.trial
        newest = trial.probes[-1] if trial is not None and trial.probes else None
        if newest is None or newest.action is None:
            return not status.estimated
        return newest.probe >= status.estimated

    def _shown_trial(self) -> shell.TrialStory | None:
        """Return the newest trial; until it has a map, the previous one stays."""
        trials = self.story.trials
        if len(trials) < 2 or trials[-1].finished is not None:
            return self.story.trial
        begun = any(look.belief is not None for look in trials[-1].probes)
        return trials[-1] if begun else trials[-2]

    def _draw_decision(self) -> None:
        trial = self._shown_trial()
        if trial is not None and trial.probes:
            text = self._decision(trial.probes[self._index(trial)])
        elif trial is not None and trial.finished is not None:
            text = shell.outcome_text(trial, self.story.head)
        elif self._bench.status().asks:
            asks = f"{self._bench.status().asks.capitalize()}."
            text = views.DecisionText("Your turn", "", "", asks)
        elif trial is not None and self._state in HELD_UP:
            title, follows = HELD_UP[self._state]
            text = views.DecisionText(title, "", "", follows)
        elif trial is not None:
            title, follows = "Probing", "The press comes next."
            if trial.phase in shell.PRESSING:
                title, follows = "Pressing", "The estimate comes after the press."
            text = views.DecisionText(title, "", "", follows)
        else:
            return
        self._page.decision.show_text(text)

    def _draw_map(self) -> None:
        trial, belief = self._shown_trial(), self._page.belief
        if trial is None or not trial.probes:
            scene = views.BeliefScene() if trial is None else shell.unprobed_scene(trial)
            detail = "", ""
            changed = belief.scene.belief is not None or belief.scene.empty != scene.empty
        else:
            look = trial.probes[self._index(trial)]
            scene = self._scene(self._index(trial))
            detail, changed = _belief_detail(scene, look), belief.scene is not scene
        if changed:
            belief.show_scene(scene)
        self._page.legend.show_truth(
            scene.truth is not None, weighed=scene.com_sigma_mm is not None
        )
        text, tip = detail
        self._page.belief_panel.detail.setText(text)
        self._page.belief_panel.detail.setToolTip(tip)

    def _draw_strip(self) -> None:
        trial = self._shown_trial()
        if trial is None or not trial.probes:
            self._page.strip.show_probes([], -1)
            return
        shown = [
            (self._scene(index), views.caption_of(look.probe, look.stability))
            for index, look in enumerate(trial.probes)
        ]
        self._page.strip.show_probes(shown, self._index(trial))

    def _index(self, trial: shell.TrialStory) -> int:
        """Return the index of the shown probe: the chosen one, else the newest."""
        return len(trial.probes) - 1 if self._chosen is None else self._chosen

    def _decision(self, look: shell.ProbeStory) -> views.DecisionText:
        text = views.decision_text(look.stability, look.action)
        trial = self._shown_trial()
        if self._chosen is not None:
            back = tr("Looking back at probe {}.", look.probe)
            return replace(text, text=f"{back} {tr(text.text)}")
        if trial is None or trial.finished is None:
            return text
        return shell.outcome_text(trial, self.story.head)

    def _scene(self, index: int) -> views.BeliefScene:
        trial = self._shown_trial()
        assert trial is not None
        key = (trial.trial, index, trial.finished is not None)
        look = trial.probes[index]
        kept = self._scenes.get(key)
        if kept is None or kept[0] is not look:
            faces = shell.face_outlines(self._bench.catalogue, self.story.head)
            kept = self._scenes[key] = look, shell.belief_scene(trial, index, *faces)
        return kept[1]

    def _draw_score(self) -> None:
        head, last = self.story.head, ""
        done = next((t.finished for t in reversed(self.story.trials) if t.finished), None)
        if done is not None:
            word, probes = tr(views.OUTCOME_WORDS[done.outcome]), count_noun(done.probes, "probe")
            last = tr("Seed {}: {} after {}.", done.seed, word, probes)
        planned, ended = head.trials if head is not None else 0, len(self.story.outcomes)
        if planned > ended and self.story.ended is not None:
            then = "The run ended after {} of {} trials. Start begins a new run."
            last = f"{last} {tr(then, ended, planned)}"
        elif planned > ended == len(self.story.trials) > 0:
            last = f"{last} {tr('Trial {} of {} follows.', ended + 1, planned)}"
        self._page.score.show_score(shell.run_score(self.story.trials, planned, last.lstrip()))


def stack_request(form: RunForm) -> runs.StackRequest:
    """Return the request of a form."""
    bottoms = (form.under, form.bottom) if form.under else (form.bottom,)
    strategy = strategy_by_name(form.strategy) or "paper"
    return runs.StackRequest(
        piece=form.piece,
        bottoms=bottoms,
        seed=form.seed,
        trials=form.trials,
        strategy=strategy,
        mode=cast("runs.DecisionMode", form.mode),
        origin_mm=(form.origin_x_mm, form.origin_y_mm),
        weigh=form.weigh,
        staged=form.staged,
    )


def _belief_detail(scene: views.BeliefScene, look: shell.ProbeStory) -> tuple[str, str]:
    """Return the line above the map and its tool tip."""
    if scene.belief is None:
        return "", ""
    largest = float(scene.belief.probability.max())
    text, tip = f"p \N{LESS-THAN OR EQUAL TO} {largest:.2f}", tr("probe {}", look.probe)
    if look.stability is not None and look.stability.source == "patch":
        text += f", {tr('judged from the patch')}"
    if look.latency_ms is not None:
        tip += f", {tr('decided in {:.1f} ms', look.latency_ms)}"
    return text, tip

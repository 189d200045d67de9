"""Attended trials: hand-over and outcome."""

from __future__ import annotations

from pathlib import Path

from touchdown.app.shell import SaveWorker, ask_path, error_card
from touchdown.app.stack.page import StackPage
from touchdown.backend import core, runs
from touchdown.backend.bench import Session
from touchdown.widgets.base import tr
from touchdown.widgets.shell import FaultCards
from touchdown.widgets.views import OffsetScene, TrialPrompt

# Events after which no question is open.
_OVER = (
    core.PhaseEntered | core.Released | core.TrialStarted | core.TrialFinished | core.RunFinished
)


class OperatorPromptsPresenter:
    """Shows one question of the run at a time and returns the answer."""

    def __init__(self, bench: Session, page: StackPage, cards: FaultCards) -> None:
        self._bench, self._page, self._cards = bench, page, cards
        self._asked: TrialPrompt | None = None
        self._mine = False
        self._files = SaveWorker(page, "photos")

    def take(self, event: core.Event) -> None:
        """Follow the stacking runs."""
        if isinstance(event, core.RunStarted):
            self._mine = event.activity == "stack"
        if not self._mine:
            return
        if isinstance(event, core.SetUpAwaited):
            said, scene = runs.scene_to_set_message(event), self._scene(event)
            self._ask(TrialPrompt("Set the scene", said, "Ready  Y", scene))
        elif isinstance(event, core.HandOverAwaited):
            said = runs.hand_over_message(event)
            self._ask(TrialPrompt("Hand the piece over", said, "It is there  Y"))
        elif isinstance(event, core.OutcomeAwaited):
            self._ask(TrialPrompt("What became of it?", event.why, proposed=event.proposed))
        elif isinstance(event, _OVER):
            self._ask(None)

    def confirm(self) -> None:
        """Confirm the question: ready, or the proposed outcome."""
        if self._asked is None:
            return
        if self._asked.proposed is not None:
            self._page.trial.judge(self._asked.proposed)
        else:
            self.answer(True)

    def answer(self, yes: bool) -> None:
        """Answer if the scene is set or the hand is in place."""
        if self._asked is not None and self._asked.proposed is None:
            self._ask(None)
            self._bench.answer(yes)

    def see(self, outcome: core.Outcome) -> None:
        """Press the button of an outcome."""
        if self._asked is not None and self._asked.proposed is not None:
            self._page.trial.judge(outcome)

    def judge(self, outcome: core.Outcome, reason: str) -> None:
        """Report the outcome of the trial."""
        if self._asked is not None and self._asked.proposed is not None:
            self._ask(None)
            self._bench.prompt.see(outcome, reason)

    def ask_photo(self) -> None:
        """Let the operator choose a picture of this trial."""
        if self._asked is None or self._asked.proposed is None:
            return
        kinds = " ".join(f"*{kind}" for kind in runs.PHOTO_SUFFIXES)
        names = f"{tr('Pictures')} ({kinds})"
        ask_path(self._page, "Picture of this trial", self.add_photo, names=names)

    def add_photo(self, source: Path) -> None:
        """Store a picture of this trial beside the log of its run."""
        run, trial = self._bench.run_folder, self._bench.status().trial

        def work() -> str:
            if run is None:
                raise core.InputError(
                    "This run is not kept.", str(source), "Name a folder for runs."
                )
            path = runs.keep_photo(run, trial, source)
            self._bench.events.publish(core.PhotoKept(self._bench.clock_s(), trial, path.name))
            return path.name

        self._files.submit(work, self._page.trial.detail.setText, self._refused)

    def close(self) -> None:
        """End the thread that stores pictures."""
        self._files.close()

    # -- inside -----------------------------------------------------------------------------------

    def _ask(self, look: TrialPrompt | None) -> None:
        self._asked = look
        self._page.trial.detail.setText("")
        self._page.show_trial(look)

    def _scene(self, asked: core.SetUpAwaited) -> OffsetScene:
        catalogue = self._bench.catalogue
        face = catalogue.piece(asked.piece).face.path(96)
        bottom = catalogue.piece(asked.bottom.split("+")[-1]).face.path(96)
        return OffsetScene(bottom, face, asked.start_mm, names=(asked.bottom, asked.piece))

    def _refused(self, error: Exception) -> None:
        self._cards.show_card(error_card("PHOTO", error, "No picture was kept."))

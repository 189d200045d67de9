"""Presenter of the Review workspace: a journal is read and told again, fact by fact."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from PySide6.QtCore import QTimer

from app.review.page import ReviewPage
from app.review.run_lines import read_run_line
from app.run_story import RunStory, TrialStory, scene_of
from app.tally import wilson
from backend.core.facts import Said, TrialFinished
from backend.core.faults import InputError
from backend.core.flow import FloatArray, Outcome
from backend.objects.catalogue import Catalogue, load_catalogue
from backend.runs.journal import NAME, read_journal
from widgets.belief_scene import BeliefScene
from widgets.decision_panel import DecisionText, decide_in_words
from widgets.fault_cards import CardText, FaultCards
from widgets.probe_strip import caption_of
from widgets.score_panel import WORDS, Score

MOST_RUNS = 200
MOST_DESCRIBED = 50
"""So many of the newest runs say in the list what they were; older ones once they are opened."""


class ReviewPresenter:
    """Lists runs, reads the chosen one, shows one trial and one probe of it."""

    def __init__(self, page: ReviewPage, runs: Path, cards: FaultCards) -> None:
        self._page, self._runs, self._cards = page, runs, cards
        self._folders: list[Path] = []
        self._catalogue: Catalogue | None = None
        self.story = RunStory()
        self._lines: list[tuple[int, str]] = []
        self._probe = 0
        self._described: dict[Path, int] = {}
        self._to_describe: list[int] = []
        self._describing = QTimer(page)
        self._describing.setInterval(0)
        self._describing.timeout.connect(self._describe_next)
        page.refresh.clicked.connect(self.refresh)
        page.runs.currentRowChanged.connect(self._choose_run)
        page.trials.currentRowChanged.connect(self._choose_trial)
        page.decision.show_text(DecisionText("No run chosen", "", "", "Choose a recorded run."))

    def refresh(self) -> None:
        """Look for runs, newest first; what is chosen stays chosen."""
        found = [p.parent for p in self._runs.glob(f"*/{NAME}")] if self._runs.is_dir() else []
        found = sorted(found, key=lambda p: p.name, reverse=True)[:MOST_RUNS]
        self._page.empty.setVisible(not found)
        self._page.empty.setText("No recordings yet. Every run of the Stack workspace is kept.")
        if found != self._folders:
            self._folders = found
            self._described.clear()
            self._page.runs.blockSignals(True)
            self._page.runs.clear()
            self._page.runs.addItems([run_title(folder.name) for folder in found])
            self._page.runs.setCurrentRow(-1)
            self._page.runs.blockSignals(False)
        # One run per turn of the event loop: a long list does not hold up the live views.
        self._to_describe = list(range(min(len(found), MOST_DESCRIBED)))
        self._describing.start()

    def open(self, run: Path) -> bool:
        """Read a run and show its last trial; a bad journal becomes a card."""
        story, lines = RunStory(), []
        try:
            for fact in read_journal(run):
                story.take(fact)
                trial = len(story.trials)
                if isinstance(fact, Said):
                    lines.append((trial, fact.text))
                elif isinstance(fact, TrialFinished):
                    lines.append((trial, f"{WORDS[fact.outcome].capitalize()}: {fact.reason}"))
        except (InputError, OSError) as error:
            what = error.what if isinstance(error, InputError) else str(error)
            self._cards.show_card(
                CardText(
                    "REPLAY",
                    f"The run could not be read: {what}",
                    f"In {run}.",
                    "The other runs are not affected.",
                    reset=False,
                )
            )
            return False
        self.story, self._lines = story, lines
        self._show_run()
        return True

    def choose_probe(self, index: int) -> None:
        """Show another probe of the trial."""
        self._probe = index
        self._show_trial()

    def _describe_next(self) -> None:
        if self._to_describe:
            self._describe(self._to_describe.pop(0))
        else:
            self._describing.stop()

    def _describe(self, row: int) -> None:
        """Say what the run in ``row`` was; read again only if its journal has grown."""
        item = self._page.runs.item(row)
        folder = self._folders[row]
        try:
            size = (folder / NAME).stat().st_size
            if self._described.get(folder) == size:
                return
            text = read_run_line(folder).text()
        except (InputError, OSError):
            size, text = -1, "cannot be read"
        self._described[folder] = size
        item.setText(f"{run_title(folder.name)}\n{text}")
        item.setToolTip(text)

    def _choose_run(self, row: int) -> None:
        if 0 <= row < len(self._folders):
            self._describe(row)
            self.open(self._folders[row])

    def _choose_trial(self, _row: int) -> None:
        trial = self._trial()
        self._probe = len(trial.probes) - 1 if trial is not None else 0
        self._show_trial()

    def _trial(self) -> TrialStory | None:
        row = self._page.trials.currentRow()
        return self.story.trials[row] if 0 <= row < len(self.story.trials) else None

    def _show_run(self) -> None:
        page = self._page
        page.trials.blockSignals(True)
        page.trials.clear()
        page.trials.addItems([_trial_title(trial) for trial in self.story.trials])
        page.trials.blockSignals(False)
        outcomes = self.story.outcomes
        placed = sum(o is Outcome.PLACED for o in outcomes)
        head, ended = self.story.head, self.story.ended
        last = "The journal ends before the run did." if ended is None else f"Run {ended.ending}."
        if head is not None:
            last = f"{head.piece} on {head.bottom}, {head.strategy}. {last}"
        trials = head.trials if head is not None else 0
        page.score.show_score(Score(outcomes, trials, wilson(placed, len(outcomes)), last))
        page.trials.setCurrentRow(len(self.story.trials) - 1)
        self._show_trial()

    def _show_trial(self) -> None:
        page, trial = self._page, self._trial()
        page.story.clear()
        if trial is None or not trial.probes:
            page.strip.show_probes([], -1)
            page.belief.show_scene(BeliefScene())
            page.decision.show_text(DecisionText("No probe", "", "", self._ending(trial)))
            return
        number = page.trials.currentRow() + 1
        page.story.addItems([text for at, text in self._lines if at == number])
        face, bottom = self._outlines()
        scenes = [scene_of(trial, i, face, bottom) for i in range(len(trial.probes))]
        captions = [caption_of(p.probe, p.stability) for p in trial.probes]
        self._probe = min(max(self._probe, 0), len(scenes) - 1)
        page.strip.show_probes(list(zip(scenes, captions, strict=True)), self._probe)
        page.belief.show_scene(scenes[self._probe])
        page.legend.show_truth(scenes[self._probe].truth is not None)
        look = trial.probes[self._probe]
        page.decision.show_text(decide_in_words(look.stability, look.action))
        page.belief_panel.detail.setText(f"probe {look.probe} of {len(scenes)}")

    def _ending(self, trial: TrialStory | None) -> str:
        if trial is None or trial.finished is None:
            return "There is nothing to show."
        return trial.finished.reason

    def _outlines(self) -> tuple[FloatArray | None, FloatArray | None]:
        head = self.story.head
        if head is None:
            return None, None
        if self._catalogue is None:
            self._catalogue = load_catalogue()
        outlines: list[FloatArray | None] = []
        for name in (head.piece, head.bottom.split("+")[-1]):
            try:
                outlines.append(self._catalogue.piece(name).face.polygon(96))
            except InputError:
                outlines.append(None)
        return outlines[0], outlines[1]


def run_title(name: str) -> str:
    """Write a run's name as date and time where it is one."""
    try:
        when = datetime.strptime(name[:15], "%Y%m%d-%H%M%S")
    except ValueError:
        return name
    return f"{when:%Y-%m-%d  %H:%M:%S} UTC"


def _trial_title(trial: TrialStory) -> str:
    word = "not finished" if trial.finished is None else WORDS[trial.finished.outcome]
    probes = "1 probe" if len(trial.probes) == 1 else f"{len(trial.probes)} probes"
    return f"{trial.trial}.  seed {trial.seed}: {word}, {probes}"

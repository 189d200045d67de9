"""Presenter of the train workspace."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from touchdown.app.shell import SaveWorker, log
from touchdown.app.train import text as words
from touchdown.app.train.page import FIGURES, TrainPage
from touchdown.app.train.reading import ModelInUse, TrainingLookup, TrainingReader, sample_scenes
from touchdown.backend import learning
from touchdown.backend.annotations import LABEL_CHOICES
from touchdown.backend.config import TrainingSettings, parse_settings
from touchdown.backend.core import InputError, ProcessStallDetector
from touchdown.widgets.base import set_property, tr
from touchdown.widgets.forms import TrainingButtons, TrainingForm
from touchdown.widgets.plots import SampleScene
from touchdown.widgets.shell import CardQuestion, FaultCards

Report = (
    learning.TrainingLoaded
    | learning.TrainingEpoch
    | learning.TrainingFinished
    | learning.TrainingCancelled
)
POLL_INTERVAL_S = 0.05
# Closing waits this long for a cancelled process, then again for a killed one.
STOP_TIMEOUT_S, JOIN_S = 1.0, 1.0


class TrainingThread:
    """Starts at once. Calls the presenter on the thread of the window; ``ended`` exactly once."""

    def __init__(
        self, request: learning.TrainingRequest, main_thread: SaveWorker, told: TrainPresenter
    ) -> None:
        self._request, self._main_thread, self._told = request, main_thread, told
        self._lock, self._cancelled = threading.Lock(), False
        self._training: learning.RecordedTraining | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="training", daemon=True)
        self._watch = threading.Thread(target=self._look, name="training watch", daemon=True)
        self._thread.start()
        self._watch.start()

    def cancel(self) -> None:
        """End after the present batch, or at once if the process has stalled. Returns at once."""
        with self._lock:
            self._cancelled = True
            if self._training is not None:
                self._training.cancel()

    def close(self) -> None:
        """End the process and wait for it, for a limited time."""
        self.cancel()
        self._thread.join(STOP_TIMEOUT_S)
        self._kill()
        self._over.set()
        self._thread.join(JOIN_S)
        self._watch.join(JOIN_S)

    def _kill(self) -> None:
        with self._lock:
            if self._training is not None:
                self._training.kill()

    def _run(self) -> None:
        failure: Exception | None = None
        try:
            self._train()
        except Exception as error:  # noqa: BLE001 - an unreported end would block the page
            failure = error
        self._over.set()
        self._main_thread.put(partial(self._told.ended, failure))

    def _train(self) -> None:
        training = learning.RecordedTraining(self._request)
        with self._lock:
            self._training = training
            if self._cancelled:
                training.cancel()
        self._main_thread.put(partial(self._told.begun, training.folder))
        for report in training.reports():
            self._main_thread.put(partial(self._told.report, report))

    def _look(self) -> None:
        """Report a stalled process and its recovery; end a cancelled process that has stalled."""
        watch, told = None, False
        while not self._over.wait(POLL_INTERVAL_S):
            with self._lock:
                training, cancelled = self._training, self._cancelled
            number = None if training is None else training.pid
            if number is None:
                continue
            watch = watch or ProcessStallDetector(number)
            still = watch.look(time.monotonic())
            if still and cancelled:
                self._kill()
            elif still is not told:
                told = still
                self._main_thread.put(partial(self._told.still, still))


class TrainPresenter:
    """Keeps the training runs, the selection, and the run in progress."""

    def __init__(
        self, page: TrainPage, cards: FaultCards, reading: TrainingReader, worker: SaveWorker
    ) -> None:
        self._page, self._cards, self._reading = page, cards, reading
        self._worker = worker
        self.looked: TrainingLookup | None = None
        self.runs: dict[str, learning.TrainingRun] = {}
        self.in_use: ModelInUse | None = None
        self.thread: TrainingThread | None = None
        self.live = ""  # id of the training in progress
        self._looks = self._shown = 0
        self._sampled: tuple[tuple[str, bool], ...] | None = None
        self._stamp_s, self._epochs_s = 0.0, list[float]()
        self._cancelling = False
        self._over = ""  # id of the training that has just ended
        # Gets what a training gave, with text and action of the next step.
        self.offer: Callable[[str, str, Callable[[], None]], None] = lambda *_: None
        self.collect: Callable[[], None] = lambda: None  # shows the workspace that collects

    # -- reading ----------------------------------------------------------------------------------

    def look(self, *, refresh: bool = False) -> None:
        """Read datasets and training runs; a later call replaces an earlier one."""
        form = self._page.form.form()
        if not form.data:
            return
        self._looks += 1
        number = self._looks
        self._page.show_busy(True)

        def work() -> TrainingLookup | None:
            return self._reading.look(form, refresh=refresh) if number == self._looks else None

        self._worker.submit(work, self._take_look, self._failed)

    def _take_look(self, looked: TrainingLookup | None) -> None:
        if looked is None:
            return
        page = self._page
        page.show_busy(False)
        self.looked, self.in_use = looked, looked.in_use
        live = self.runs.get(self.live)
        self.runs = {run.uuid: run for run in looked.runs}
        if live is not None:
            self.runs.setdefault(live.uuid, live)
        overview = looked.overview
        page.form.show_pieces([(name, name) for name in overview.pieces], overview.piece)
        page.split.show_rows(words.split_rows(overview))
        page.split_panel.detail.setText(overview.piece)
        page.runs.empty = "No training on these data yet"
        page.leaks.setText("" if self._why_not() else words.split_text(overview))
        self.choose()
        if not page.runs.chosen() and self.runs:
            page.runs.choose([next(iter(self.runs))])
        over, self._over = self.runs.get(self._over), ""
        if over is not None and over.card is not None:
            step, text = words.next_step([over], self.in_use), words.ended_text(over.card)
            if step is None or not step.button:
                self.offer(text, "Put it in use", lambda: self._use(over.uuid))
            else:
                self.offer(text, step.button, partial(self._carry_out, step))

    def _use(self, uuid: str) -> None:
        self._page.runs.choose([uuid])
        self.promote()

    # -- orders -----------------------------------------------------------------------------------

    def start(self) -> None:
        """Start the training of the form."""
        if self.thread is None and self._can_start():
            self._begin(lambda: training_request(self._page.form.form()))

    def resume(self) -> None:
        """Resume the chosen unfinished training."""
        run = self._chosen_alone()
        if self.thread is None and run is not None and run.can_resume:
            self._begin(lambda: learning.resume_request(run, Path(self._page.form.form().data)))

    def ask_cancel(self) -> None:
        """Ask for confirmation to cancel the training, which continues meanwhile."""
        if self.thread is None or self._cancelling:
            return
        text = "Cancel the training? Whole epochs are kept: it can be resumed."
        self._cards.ask(
            CardQuestion(text, (("Keep training", lambda: None), ("Cancel it", self.cancel)))
        )

    def cancel(self) -> None:
        """End the training after the present batch."""
        if self.thread is not None:
            self._cancelling = True
            self.thread.cancel()
            self._show_progress("cancelling \N{HORIZONTAL ELLIPSIS}")
            self.show_buttons()

    def promote(self) -> None:
        """Put the model of the chosen training in use; ask first if it may be worse."""
        run = self._chosen_alone()
        if run is None or run.card is None:
            return
        used = None if self.in_use is None else self.in_use.card
        question, put = words.promotion_question(run.card, used), partial(self._put_in_use, run)
        if question:
            answers = (("Keep the present one", lambda: None), ("Put it in use", put))
            self._cards.ask(CardQuestion(question, answers))
        else:
            put()

    def _put_in_use(self, run: learning.TrainingRun) -> None:
        def done(in_use: ModelInUse | None) -> None:
            log.info("model of training %s put in use", run.uuid)
            self._take_use(in_use)

        self._worker.submit(lambda: self._reading.promote(run), done, self._failed)

    def roll_back(self) -> None:
        """Put the previous model in use again."""
        if self.in_use is not None and self.in_use.before is not None:
            piece = self.in_use.piece
            log.info("model before put in use again for %s", piece)
            back = partial(self._reading.roll_back, piece)
            self._worker.submit(back, self._take_use, self._failed)

    def carry_out_step(self) -> None:
        """Train as the advice on the chosen trainings says, or go to Collect."""
        if step := words.next_step(self._chosen(), self.in_use):
            self._carry_out(step)

    def _carry_out(self, step: words.NextStep) -> None:
        if step.run is None:
            self.collect()
            return
        form, params = self._page.form.form(), {**step.run.about.params, **step.changes}
        known = {key: value for key, value in params.items() if key in asdict(form)}
        self._page.form.show_form(replace(form, **known))
        self.start()

    def close(self) -> None:
        """End a training and wait for its process."""
        if self.thread is not None:
            self.thread.close()
            self.thread = None

    # -- a training that goes on ------------------------------------------------------------------

    def _begin(self, make: Callable[[], learning.TrainingRequest]) -> None:
        try:
            request = make()
        except InputError as error:
            self._failed(error)
            return
        self._epochs_s, self._cancelling, self.live = [], False, ""
        self.thread = TrainingThread(request, self._worker, self)
        self._show_progress("starting \N{HORIZONTAL ELLIPSIS}")
        self.show_buttons()

    def begun(self, folder: Path) -> None:
        """Show the run that has begun in ``folder``."""
        self.live = folder.name
        self._read_run(folder, choose=True)
        self._show_progress("reading the episodes \N{HORIZONTAL ELLIPSIS}")

    def report(self, report: Report) -> None:
        """Show a report of the run."""
        now_s = time.monotonic()
        if isinstance(report, learning.TrainingEpoch):
            self._epochs_s.append(now_s - self._stamp_s)
            if not self._cancelling:
                left = words.remaining_time_text(report.epoch, report.epochs, self._epochs_s)
                self._show_progress(left)
        elif not isinstance(report, learning.TrainingFinished) and not self._cancelling:
            self._show_progress("first epoch \N{HORIZONTAL ELLIPSIS}")
        self._stamp_s = now_s
        if self.live in self.runs:
            self._read_run(self.runs[self.live].folder)

    def ended(self, error: Exception | None) -> None:
        """Show the end of the run, with the cause of an early one."""
        if self.thread is not None:
            self.thread.close()
        self.thread, self._cancelling, self._over = None, False, self.live
        self._cards.withdraw()
        self.still(False)
        self._show_progress("")
        if error is not None:
            self._cards.show_card(words.failure_card(error))
        self.show_buttons()
        self.look()

    def still(self, on: bool) -> None:
        """Show that the child process has stalled, or continues."""
        if on and self.thread is not None:
            self._cards.show_card(words.STILL)
        else:
            self._cards.clear((words.STILL.code,))

    def _read_run(self, folder: Path, *, choose: bool = False) -> None:
        def take(run: learning.TrainingRun) -> None:
            # The newest run is at the top.
            others = {uuid: one for uuid, one in self.runs.items() if uuid != run.uuid}
            first = run.uuid not in self.runs
            self.runs = {run.uuid: run, **others} if first else {**self.runs, run.uuid: run}
            self.choose()
            if choose:
                self._page.runs.choose([run.uuid])

        self._worker.submit(lambda: learning.read_training_run(folder), take, self._failed)

    # -- showing ----------------------------------------------------------------------------------

    def choose(self) -> None:
        """Show the training runs and the results of the chosen ones."""
        chosen = self._page.runs.chosen()
        marks = dict(zip(chosen, words.LETTERS, strict=False)) if len(chosen) > 1 else {}
        rows = [words.run_row(run, self.in_use, marks) for run in self.runs.values()]
        self._page.runs.show_runs(rows)
        self._show_chosen()
        self.show_buttons()

    def show_buttons(self) -> None:
        """Enable the buttons that are allowed now."""
        page, run = self._page, self._chosen_alone()
        idle = self.thread is None
        resumable = run is not None and run.can_resume
        page.form.show_buttons(
            TrainingButtons(
                start=idle and self._can_start(),
                cancel=not idle and not self._cancelling,
                resume=idle and resumable,
                why_not=self._why_not() if idle else "",
            )
        )
        use, card = self.in_use, None if run is None else run.card
        used = card is not None and use is not None and words.is_in_use(card, use)
        page.promote.setEnabled(card is not None and not used)
        one = tr("Choose one training to promote it.") if run is None and self.runs else ""
        page.promote.setToolTip(one or tr("Put the chosen model in use for its piece (Ctrl+P)"))
        page.roll_back.setEnabled(use is not None and use.before is not None)
        page.in_use.setText(words.model_in_use_text(use))
        alone = words.autonomy_text(use.probes if use else None)
        step = words.next_step(self._chosen(), use)
        page.step.setVisible(step is not None and bool(step.button))
        set_property(page.form.start, "role", "" if step and step.button else "primary")
        page.form.fit_to_theme()
        if step and step.button:
            page.step.setText(tr(step.button))
        page.step.setEnabled(idle)
        said = step.text if step else one
        page.autonomy.setText(said if step and step.button else f"{said}\n{alone}".strip())
        for line in (page.in_use, page.autonomy):
            line.setVisible(bool(line.text()))

    def _can_start(self) -> bool:
        return self.looked is not None and not self._why_not()

    def _why_not(self) -> str:
        return (self.looked.trouble or self.looked.overview.error) if self.looked else ""

    def _chosen(self) -> list[learning.TrainingRun]:
        return [self.runs[uuid] for uuid in self._page.runs.chosen() if uuid in self.runs]

    def _chosen_alone(self) -> learning.TrainingRun | None:
        chosen = self._chosen()
        return chosen[0] if len(chosen) == 1 else None

    def _show_chosen(self) -> None:
        page, chosen = self._page, self._chosen()
        epochs = max((self._epochs(run) for run in chosen), default=0)
        best = chosen[0].best_epoch if len(chosen) == 1 else 0
        for plot, name in (
            (page.loss, "validation_loss"), (page.iou, "iou"), (page.accuracy, "point_accuracy"),
        ):  # fmt: skip
            plot.show_lines(words.curve_lines(chosen, name), epochs, best)
        page.reliability.show_lines(words.reliability_lines(chosen))
        letters = words.LETTERS[: max(len(chosen), 1)] if len(chosen) > 1 else ("",)
        page.differences.show_columns(("what differs" if len(chosen) > 1 else "setting", *letters))
        page.differences.show_rows(words.difference_rows(chosen))
        page.figures.show_columns((FIGURES, *letters))
        page.figures.show_rows(words.figure_rows(chosen))
        self._show_samples()

    def _epochs(self, run: learning.TrainingRun) -> int:
        done = len(run.curves.get("iou", ()))
        planned = run.about.params.get("epochs", 0) if run.uuid == self.live else 0
        return max(done, int(planned)) if self.thread is not None else done

    def _show_samples(self) -> None:
        chosen, page = self._chosen(), self._page
        key = tuple((run.uuid, run.card is not None) for run in chosen)
        if key == self._sampled:
            return
        self._sampled = key
        self._shown += 1
        number = self._shown
        if len(chosen) != 1 or chosen[0].card is None:
            why = tr("{} trainings are chosen: choose one to see its samples.", len(chosen))
            page.samples.show_scenes((), why if chosen[1:] else "Choose a finished training.")
            return

        def show(scenes: list[SampleScene]) -> None:
            if number == self._shown:
                page.samples.show_scenes(scenes, "This training stored no samples.")

        self._worker.submit(
            lambda: sample_scenes(chosen[0]), show, lambda e: page.samples.show_scenes((), str(e))
        )

    def _show_progress(self, text: str) -> None:
        self._page.curves_panel.detail.setText(tr(text))

    def _take_use(self, in_use: ModelInUse | None) -> None:
        self.in_use = in_use
        self.choose()

    def _failed(self, error: Exception) -> None:
        self._page.show_busy(False)
        self._cards.show_card(words.failure_card(error))


def training_request(form: TrainingForm) -> learning.TrainingRequest:
    """Return the request of a form. Raises ``InputError``."""
    shared = TrainingSettings.model_fields.keys() & asdict(form).keys()
    settings = {name: getattr(form, name) for name in shared}
    settings["validation_share"] = form.held_out / 100
    labels = next(name for name in LABEL_CHOICES if name == form.labels)
    parsed = parse_settings(TrainingSettings, settings, "the form")
    return learning.TrainingRequest(Path(form.data), form.piece, parsed, labels)

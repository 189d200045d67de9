"""Dataset of the label workspace: opened, replaced, closed."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from touchdown.app.label.page import LabelPage
from touchdown.app.label.presenter import LabelPresenter
from touchdown.app.shell import MainThreadQueue, OpenedDataset, SaveWorker
from touchdown.backend.annotations import MergeReport, QualityReport, check_dataset_quality
from touchdown.backend.core import InputError, TouchdownError
from touchdown.backend.learning import ModelRegistry, models_below
from touchdown.backend.placement import score_labels
from touchdown.backend.runs import models_folder

TELL_EVERY = 20
IN_USE = "-"


class DatasetTasks:
    """Long tasks on the dataset, on a separate thread, so that saving goes on."""

    def __init__(
        self,
        page: LabelPage,
        presenter: LabelPresenter,
        opened: OpenedDataset,
        main_thread: MainThreadQueue,
    ) -> None:
        self._page, self._on, self._opened, self._main_thread = page, presenter, opened, main_thread
        self._jobs, self._ended = SaveWorker(main_thread, "label-jobs"), threading.Event()

    def score(self) -> None:
        """Let the model judge every episode. Fills four queues; changes no label."""
        if self._jobs.busy:
            self._page.say("This is being done already.")
            return
        self._page.say("Scoring the dataset …")
        opened, progress = self._opened, self._teller("Scoring")
        self._jobs.submit(
            lambda: score_labels(opened.dataset, opened.prelabel.model, progress),
            self._scored,
            self._failed,
        )

    def look_through(self, done: Callable[[QualityReport], None]) -> None:
        """Check the quality of all episodes."""
        if self._jobs.busy:
            self._page.say("Wait until the dataset is checked or scored.")
            return
        self._page.say("Looking through the dataset …")
        dataset, progress = self._opened.dataset, self._teller("Looking through")

        def looked(health: QualityReport) -> None:
            self._page.say("")
            done(health)

        self._jobs.submit(lambda: check_dataset_quality(dataset, progress), looked, self._failed)

    def choose_models(self) -> None:
        """Ask for the folder of the models that pre-label the piece of the present episode."""
        now = self._on.present
        if now is None:
            self._page.say("Show an episode of the piece first.", bad=True)
            return
        piece = now.item.entry.piece
        hint = f"Folder of the models that pre-label {piece}, or {IN_USE} for the one in use"
        self._page.ask_words(hint, "", lambda words: self._choose_models(piece, words))

    def _choose_models(self, piece: str, words: str) -> None:
        person, registry = self._on.session.person, ModelRegistry(models_folder())

        def choose() -> int:
            models = [] if words == IN_USE else models_below(Path(words).expanduser(), piece)
            if not models and words != IN_USE:
                raise InputError(f"There is no model of '{piece}'.", words, "Name another folder.")
            registry.choose_ensemble(piece, models, person)
            return len(models)

        def chosen(count: int) -> None:
            self._opened.prelabel.forget()
            self._on.read_anew(
                f"{count} models of {piece} pre-label together." if count
                else f"The model in use pre-labels {piece}."
            )  # fmt: skip

        self._jobs.submit(choose, chosen, self._failed)

    def merge(self) -> None:
        """Ask for the folder of another copy and merge its changes."""
        self._page.ask_words("Folder of the other copy", "", self._merge)

    def close(self) -> None:
        """Stop the running task; results so far are kept."""
        self._ended.set()
        self._jobs.close()

    def _teller(self, doing: str) -> Callable[[int, int], bool]:
        """Return a progress callback, which also cancels the task when the window closes."""

        def tell(done: int, count: int) -> bool:
            if done % TELL_EVERY == 0:
                text = f"{doing} the dataset: {done:,} of {count:,}"
                self._main_thread.put(lambda: self._page.say(text))
            return not self._ended.is_set()

        return tell

    def _scored(self, count: int) -> None:
        self._on.read_anew(f"{count} episodes were scored by the model.")

    def _merge(self, folder: str) -> None:
        person, dataset = self._on.session.person, self._opened.dataset
        self._page.say("Merging …")
        self._jobs.submit(
            lambda: dataset.merge(person, Path(folder).expanduser()), self._merged, self._failed
        )

    def _merged(self, done: MergeReport) -> None:
        conflicts = f", {len(done.conflicts)} in conflict" if done.conflicts else ""
        self._page.say(f"Merged {done.operations} actions and {done.episodes} episodes{conflicts}.")

    def _failed(self, error: Exception) -> None:
        self._page.say(str(error) if isinstance(error, TouchdownError) else repr(error), bad=True)

"""What concerns the whole dataset and takes a while: scoring it with the model, merging a copy."""

from __future__ import annotations

import threading
from pathlib import Path

from app.label.commits import Commits
from app.label.opening import Opened
from app.label.page import LabelPage
from app.label.post import Post
from app.label.presenter import LabelPresenter
from backend.catalogue.merge import Merged
from backend.core.faults import TouchdownError
from backend.placement.label_scores import score_labels

TELL_EVERY = 5


class WholeDataset:
    """Has a thread of its own, so that labels are saved meanwhile."""

    def __init__(
        self, page: LabelPage, presenter: LabelPresenter, opened: Opened, post: Post
    ) -> None:
        self._page, self._on, self._opened, self._post = page, presenter, opened, post
        self._jobs, self._ended = Commits(post, "label-jobs"), threading.Event()

    def score(self) -> None:
        """Let the model judge every episode: fills three queues, changes no label."""
        if self._jobs.busy:
            self._page.say("This is being done already.")
            return
        self._page.say("Scoring the dataset …")
        opened = self._opened
        self._jobs.submit(
            lambda: score_labels(opened.dataset, opened.prelabel.model, self._progress),
            self._scored,
            self._failed,
        )

    def merge(self) -> None:
        """Ask for the folder of another copy, and bring in what is new there."""
        self._page.ask_words("Folder of the other copy", "", self._merge)

    def close(self) -> None:
        """End what runs; what was found until then is kept."""
        self._ended.set()
        self._jobs.close()

    def _progress(self, done: int, count: int) -> bool:
        if done % TELL_EVERY == 0:
            self._post.put(lambda: self._page.say(f"Scoring the dataset: {done} of {count}"))
        return not self._ended.is_set()

    def _scored(self, count: int) -> None:
        self._on.read_with_news(f"{count} episodes were scored by the model.")

    def _merge(self, folder: str) -> None:
        person, dataset = self._on.sitting.person, self._opened.dataset
        self._page.say("Merging …")
        self._jobs.submit(
            lambda: dataset.merge(person, Path(folder).expanduser()), self._merged, self._failed
        )

    def _merged(self, done: Merged) -> None:
        conflicts = f", {len(done.conflicts)} in conflict" if done.conflicts else ""
        self._page.say(f"Merged {done.operations} actions and {done.episodes} episodes{conflicts}.")

    def _failed(self, error: Exception) -> None:
        self._page.say(str(error) if isinstance(error, TouchdownError) else repr(error), bad=True)

"""Fills the views beside the queue that take a moment to work out: agreement and log."""

from __future__ import annotations

from app.label.agreement import agreement_words
from app.label.commits import Commits
from app.label.presenter import LabelPresenter
from app.label.side import SideTabs
from app.label.words import operation_words
from backend.catalogue.values import Operation

MOST_LINES = 300
AGREEMENT, LOG = 1, 2


class SidePresenter:
    """Reads on the thread of the saves; shows only what is in front."""

    def __init__(self, side: SideTabs, presenter: LabelPresenter, commits: Commits) -> None:
        self._side, self._presenter, self._commits = side, presenter, commits

    def show(self, text: str) -> None:
        """Fill the view in front; ``text`` is what to look for in the log."""
        if self._side.tab == LOG:
            book = self._presenter.shown
            self._commits.submit(
                lambda: book.log(text=text, limit=MOST_LINES), self._show_log, self._failed
            )
        elif self._side.tab == AGREEMENT:
            dataset = self._presenter.dataset
            self._commits.submit(
                lambda: agreement_words(dataset), self._side.agreement.setText, self._failed
            )

    def _show_log(self, operations: list[Operation]) -> None:
        self._side.show_log([operation_words(operation) for operation in operations])

    def _failed(self, error: Exception) -> None:
        self._side.show_log([f"The log cannot be read: {error}"])

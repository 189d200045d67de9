"""The Review workspace as the frame sees it. It needs no bench."""

from __future__ import annotations

from app.review.page import ReviewPage
from app.review.presenter import ReviewPresenter
from app.workspace import Command, Desk, Workspace


class ReviewWorkspace(Workspace):
    """Recorded runs, their trials and probes."""

    name, title, key = "review", "Review", "Ctrl+5"
    page: ReviewPage

    def __init__(self, desk: Desk) -> None:
        self.page = ReviewPage(desk.theme, self._choose_probe)
        self.presenter = ReviewPresenter(self.page, desk.runs, desk.cards)
        self.commands = (Command("refresh", "Look for new runs", "Ctrl+R", self.presenter.refresh),)

    def enter(self) -> None:
        """Look for runs that came since."""
        self.presenter.refresh()

    def _choose_probe(self, index: int) -> None:
        self.presenter.choose_probe(index)

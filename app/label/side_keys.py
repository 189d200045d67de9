"""By keyboard alone: what stands beside the picture, such as versions, log and bulk changes."""

from __future__ import annotations

from collections.abc import Callable

from app.label.bulk import BulkPresenter
from app.label.bulk_form import KINDS
from app.label.decisions import Decisions
from app.label.page import LabelPage
from app.label.panels import AGREEMENT, LOG, SidePresenter
from app.label.presenter import LabelPresenter
from app.label.side import BULK, HISTORY
from app.label.words import history_rows

MOST = 9
"""So many answers have a digit."""


class SideKeys:
    """Brings a view to the front and asks what to do there, by digits and typed words."""

    def __init__(
        self,
        page: LabelPage,
        presenter: LabelPresenter,
        decisions: Decisions,
        side: SidePresenter,
        bulk: BulkPresenter,
    ) -> None:
        self._page, self._on, self._decisions = page, presenter, decisions
        self._side, self._bulk = side, bulk

    def versions(self) -> None:
        """Ask which of the newest versions to restore."""
        self._after(self._ask_version)

    def _ask_version(self) -> None:
        now = self._on.present
        if now is None or self._on.sitting.opines:
            self._page.say("No versions are shown here.", bad=True)
            return
        self._page.side.choose(HISTORY)
        rows = [row for row in history_rows(now.history, now.edit.base) if not row.head][:MOST]
        if not rows:
            self._page.say("There is no earlier version.")
            return
        ids = {f"{row.number}. {row.what}": row.rev_uuid for row in rows}
        choices = [(str(n), word) for n, word in enumerate(ids, start=1)]
        self._page.choice.ask(
            "Restore which version?", choices, lambda word: self._decisions.restore(ids[word])
        )

    def agreement(self) -> None:
        """Show the figures of agreement."""
        self._page.side.choose(AGREEMENT)
        self._side.show("")

    def log(self) -> None:
        """Show the log, ready to be searched: Enter or Esc leaves."""
        needle = self._page.side.needle
        self._page.side.choose(LOG)
        self._side.show(needle.text())
        needle.setFocus()
        needle.selectAll()

    def many(self) -> None:
        """Ask what to change in every label of the queue, and by how much."""
        choices = [(str(n), text) for n, (_, text, _) in enumerate(KINDS, start=1)]
        names = {text: name for name, text, _ in KINDS}
        self._after(
            lambda: self._page.choice.ask(
                "Change every label of this queue how?", choices,
                lambda word: self._begin(names[word]),
            )
        )  # fmt: skip

    def _begin(self, kind: str) -> None:
        form = self._page.bulk
        self._page.side.choose(BULK)
        form.kind.setCurrentIndex(form.kind.findData(kind))
        if form.value.isEnabled():
            form.value.setFocus()
            form.value.selectAll()
        else:
            self._bulk.preview_and_ask()

    def _after(self, ask: Callable[[], None]) -> None:
        """Ask after the saves that are under way, unless one has failed."""
        self._on.do(ask)

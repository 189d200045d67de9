"""Bulk changes of labels."""

from __future__ import annotations

from collections import Counter

from touchdown.app.label.decisions import LabelDecisions
from touchdown.app.label.page import LabelPage
from touchdown.app.label.presenter import LabelPresenter
from touchdown.app.label.side import BULK, HISTORY, KINDS, BulkForm, SideTabs, agreement_figures
from touchdown.app.label.text import history_rows, operation_text
from touchdown.app.shell import SaveWorker, parse_displacement
from touchdown.backend.annotations import (
    BulkChange,
    BulkPreview,
    MoveGeometry,
    RotateFrame,
    SetState,
    ShiftOrigin,
)
from touchdown.backend.geometry import PieceLibrary
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.forms import ChoiceBar

MOST_LINES = 300
AGREEMENT, LOG = 1, 2


class SideTabsPresenter:
    """Fills the visible side tab, reading on the thread of the saves."""

    def __init__(self, side: SideTabs, presenter: LabelPresenter, worker: SaveWorker) -> None:
        self._side, self._presenter, self._worker = side, presenter, worker

    def show(self, text: str) -> None:
        """Fill the visible tab; ``text`` filters the log."""
        if self._side.tab == LOG:
            book = self._presenter.shown
            self._worker.submit(
                lambda: book.log(text=text, limit=MOST_LINES),
                lambda found: self._side.show_log([operation_text(one) for one in found]),
                self._failed,
            )
        elif self._side.tab == AGREEMENT:
            dataset = self._presenter.dataset
            self._worker.submit(
                lambda: agreement_figures(dataset), self._side.show_agreement, self._failed
            )

    def _failed(self, error: Exception) -> None:
        self._side.show_log([tr("The log cannot be read: {}", error)])


YES = (("1", "Change them"),)


class BulkPresenter:
    """Keeps the preview of a bulk change. Only the previewed change can be applied."""

    def __init__(
        self, form: BulkForm, presenter: LabelPresenter, catalogue: PieceLibrary, choice: ChoiceBar
    ) -> None:
        self._form, self._on, self._catalogue, self._choice = form, presenter, catalogue, choice
        self._preview: BulkPreview | None = None

    def preview(self, *, ask: bool = False) -> None:
        """Compute the changes to the labels of the shown queue.

        With ``ask``, for use by keyboard, ask whether to apply them.
        """
        self._preview = None
        self._form.apply.setEnabled(False)
        kind, text = str(self._form.kind.currentData()), self._form.value.text().strip()
        try:
            change = self._change(kind, text)
        except ValueError as error:
            self._form.found.setText(str(error))
            return
        book, person, shown = self._on.book, self._on.session.person, self._on.shown
        # Bulk changes must not touch control items.
        order = [uuid for uuid in self._on.walk.selected if not shown.hides(uuid)]

        async def compute() -> None:
            found = await self._on.saving.save(lambda: book.preview(person, order, change))
            self._preview = found
            self._form.found.setText(preview_text(found))
            self._form.apply.setEnabled(bool(found.rows))
            if ask and found.rows:
                text = tr("{} will change.", count_noun(len(found.rows), "label"))
                self._choice.ask(text, YES, lambda _: self.apply())

        self._on.flushed(compute)

    def apply(self) -> None:
        """Apply the previewed change; refused if a label changed meanwhile."""
        wanted = self._preview
        if wanted is not None:
            self._form.apply.setEnabled(False)
            book, person = self._on.book, self._on.session.person

            async def apply() -> None:
                count = await self._on.saving.save(lambda: book.bulk(person, wanted))
                self._preview = None
                self._form.found.setText(
                    tr("{} changed. U takes it back in one step.", count_noun(count, "label"))
                )
                await self._on.read_queue()

            self._on.flushed(apply)

    def _change(self, kind: str, text: str) -> BulkChange:
        if kind == "shift":
            x_mm, y_mm, _ = parse_displacement(text)
            return ShiftOrigin(round(1e3 * x_mm), round(1e3 * y_mm))
        if kind == "rotate":
            try:
                return RotateFrame(round(1e3 * float(text)))
            except (ValueError, OverflowError):
                raise ValueError("Type an angle in degrees, such as -1.5.") from None
        if kind == "geometry":
            return self._present_geometry()
        if kind == "accept":
            return SetState("accept")
        if kind == "approve":
            return SetState("approve")
        if not text:
            raise ValueError("A rejection needs a reason.")
        return SetState("reject", text)

    def _present_geometry(self) -> MoveGeometry:
        now = self._on.present
        if now is None:
            raise ValueError("Show an episode of the pair first.")
        entry = now.item.entry
        piece, bottom = (self._catalogue.piece(name) for name in (entry.piece, entry.bottom))
        return MoveGeometry(
            now.edit.base.geometry, self._on.dataset.geometry.store_pair(piece, bottom)
        )


def preview_text(found: BulkPreview) -> str:
    """Return the number of changes, and why some labels are excluded."""
    lines = [tr("{} will change.", count_noun(len(found.rows), "label"))]
    for reason, count in Counter(reason for _, reason in found.refused).most_common(3):
        lines.append(tr("{} will stay. Reason: {}", count_noun(count, "label"), tr(reason)))
    return "\n".join(lines)


MOST = 9  # answers with a digit


class SideTabKeys:
    """Opens side tabs and asks for actions by keyboard."""

    def __init__(
        self,
        page: LabelPage,
        presenter: LabelPresenter,
        decisions: LabelDecisions,
        side: SideTabsPresenter,
        bulk: BulkPresenter,
    ) -> None:
        self._page, self._on, self._decisions = page, presenter, decisions
        self._side, self._bulk = side, bulk

    def versions(self) -> None:
        """Ask which of the newest versions to restore."""
        self._on.do(self._ask_version)

    def _ask_version(self) -> None:
        now = self._on.present
        if now is None or self._on.session.opines:
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
        """Show the agreement figures."""
        self._page.side.choose(AGREEMENT)
        self._side.show("")

    def log(self) -> None:
        """Show the log and focus its search field."""
        needle = self._page.side.needle
        self._page.side.choose(LOG)
        self._side.show(needle.text())
        needle.setFocus()
        needle.selectAll()

    def many(self) -> None:
        """Ask for a bulk change of the queue and its value."""
        choices = [(str(n), text) for n, (_, text, _) in enumerate(KINDS, start=1)]
        names = {text: name for name, text, _ in KINDS}
        walk, asks = self._on.walk, tr("Change every label of this queue how?")
        if walk.selected is not walk.order:
            asks = tr("Change the {:,} selected labels how?", len(walk.selected))
        self._on.do(
            lambda: self._page.choice.ask(asks, choices, lambda word: self._begin(names[word]))
        )

    def _begin(self, kind: str) -> None:
        form = self._page.bulk
        self._page.side.choose(BULK)
        form.kind.setCurrentIndex(form.kind.findData(kind))
        if form.value.isEnabled():
            form.value.setFocus()
            form.value.selectAll()
        else:
            self._bulk.preview(ask=True)

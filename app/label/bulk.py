"""One change to many labels: first what it would do, then the same and nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from app.label.bulk_form import BulkForm
from app.label.edit import parse
from app.label.presenter import LabelPresenter
from backend.catalogue.bulk import Change, MoveGeometry, Preview, RotateFrame, SetState, ShiftOrigin
from backend.objects.catalogue import Catalogue
from widgets.choice_bar import ChoiceBar

YES = (("1", "Change them"),)


class BulkPresenter:
    """Holds the preview; what is applied is what was previewed, or nothing."""

    def __init__(
        self, form: BulkForm, presenter: LabelPresenter, catalogue: Catalogue, choice: ChoiceBar
    ) -> None:
        self._form, self._on, self._catalogue, self._choice = form, presenter, catalogue, choice
        self._preview: Preview | None = None

    def preview(self) -> None:
        """Work out what would change in the queue that is shown."""
        self._begin(self._show)

    def preview_and_ask(self) -> None:
        """Do so, and ask whether to do it: for whoever has no mouse."""
        self._begin(self._show_and_ask)

    def _begin(self, done: Callable[[Preview], None]) -> None:
        self._preview = None
        self._form.apply.setEnabled(False)
        kind, text = str(self._form.kind.currentData()), self._form.value.text().strip()
        try:
            change = self._change(kind, text)
        except ValueError as error:
            self._form.found.setText(str(error))
            return
        book, person, order = self._on.book, self._on.sitting.person, self._mine()
        self._on.flushed(
            lambda: self._on.saving.save(lambda: book.preview(person, order, change), done)
        )

    def _mine(self) -> list[str]:
        """Return the queue without the gold in it, which no bulk change may touch."""
        return [uuid for uuid in self._on.walk.order if not self._on.shown.hides(uuid)]

    def apply(self) -> None:
        """Do what was previewed; refused if a label changed since."""
        wanted = self._preview
        if wanted is not None:
            self._form.apply.setEnabled(False)
            book, person = self._on.book, self._on.sitting.person
            self._on.flushed(
                lambda: self._on.saving.save(lambda: book.bulk(person, wanted), self._applied)
            )

    def _show(self, found: Preview) -> None:
        self._preview = found
        self._form.found.setText(preview_words(found))
        self._form.apply.setEnabled(bool(found.rows))

    def _show_and_ask(self, found: Preview) -> None:
        self._show(found)
        if found.rows:
            count = _labels(len(found.rows))
            self._choice.ask(f"{count} will change.", YES, lambda _: self.apply())

    def _applied(self, count: int) -> None:
        self._preview = None
        self._form.found.setText(f"{_labels(count)} changed. U takes it back in one step.")
        self._on.read_queue()

    def _change(self, kind: str, text: str) -> Change:
        if kind == "shift":
            x_mm, y_mm, _ = parse(text)
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


def preview_words(found: Preview) -> str:
    """Return what a change would do, and why it leaves some labels alone."""
    lines = [f"{_labels(len(found.rows))} will change."]
    for reason, count in Counter(reason for _, reason in found.refused).most_common(3):
        lines.append(f"{_labels(count)} will not: {reason}")
    return "\n".join(lines)


def _labels(count: int) -> str:
    return "1 label" if count == 1 else f"{count} labels"

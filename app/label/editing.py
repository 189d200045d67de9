"""Edits of the episode in front: nudged, dragged, typed or taken, and saved as one revision."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from PySide6.QtCore import QTimer

from app.label.edit import Edit, parse
from app.label.page import LabelPage
from app.label.saving import Intent, Saving
from app.label.sigma import ask_sigma
from app.label.sitting import Present, Sitting
from backend.catalogue.gold_book import GoldBook
from backend.catalogue.values import Revision
from widgets.offset_scene import Point

NUDGES_MS = 500


class Front(Protocol):
    """What an edit needs of whoever shows the episode in front."""

    present: Present | None

    def do(self, intent: Intent) -> None:
        """Do something after the saves that are under way."""
        ...

    def show_edit(self) -> None:
        """Show where the face is now."""
        ...

    def reload(self) -> None:
        """Show what the dataset says of the episode now."""
        ...


class Editing:
    """Changes the edit in front; saves it half a second after the last nudge, or when asked."""

    def __init__(
        self, front: Front, page: LabelPage, book: GoldBook, sitting: Sitting, saving: Saving
    ) -> None:
        self._front, self._page, self._book = front, page, book
        self._sitting, self._saving = sitting, saving
        self._nudging = QTimer(page)
        self._nudging.setSingleShot(True)
        self._nudging.setInterval(NUDGES_MS)
        self._nudging.timeout.connect(self.nudged)

    @property
    def waits(self) -> bool:
        """Whether an edit waits for the end of the nudges."""
        return self._nudging.isActive()

    def give_up(self) -> None:
        """Go back to what holds."""
        now = self._front.present
        if now is not None:
            self._nudging.stop()
            now.edit = Edit.of(now.edit.base)
            self._front.show_edit()

    # -- changes ----------------------------------------------------------------------------------

    def nudge(self, dx_um: int, dy_um: int) -> None:
        """Move the face by whole µm; nudges within half a second are one revision."""
        self._front.do(lambda: self._change(lambda edit: edit.nudged(dx_um, dy_um)))

    def nudged(self) -> None:
        """Save what was nudged; no question comes between typing or another question."""
        unsure, asked = self._sitting.sigma_mm is None, self._page.choice
        asks_sigma = asked.isVisible() and bool(asked.marked)
        if unsure and asks_sigma:
            # What is nudged while sigma is asked is saved with the answer.
            self._nudging.stop()
        elif asks_sigma or (unsure and (self._page.typing or asked.isVisible())):
            self._nudging.start()
        else:
            self._front.do(self.save)

    def place(self, at_mm: Point) -> None:
        """Move the face to a place (while it is dragged)."""
        self._front.do(lambda: self._change(lambda edit: edit.placed(*at_mm)))

    def drop(self) -> None:
        """Save what was dragged."""
        self._front.do(self.save)

    def typed(self, text: str) -> None:
        """Set what was typed."""
        try:
            x, y, sigma = parse(text)
        except ValueError as error:
            self._page.say(str(error), bad=True)
            return
        self._page.leave_entry()

        def change(edit: Edit) -> Edit:
            placed = edit.placed(x, y)
            return placed if sigma is None else placed.trusted(sigma)

        if sigma is not None:
            self._sitting.sigma_mm = sigma
        self._front.do(lambda: self._change(change))
        self._front.do(self.save)

    def take_model(self) -> None:
        """Take the model's displacement as a draft with the model as its source."""
        now = self._front.present
        model = None if now is None else now.item.model
        if model is None or self._sitting.hides:
            self._page.say("There is no model in sight.", bad=True)
            return
        fit, source = model.fit, model.source
        self._front.do(
            lambda: self._change(lambda edit: edit.estimated(*fit.offset_mm, fit.sigma_mm, source))
        )
        self._front.do(self.save)

    def _change(self, change: Callable[[Edit], Edit]) -> None:
        now = self._front.present
        if now is None:
            return
        now.edit = change(now.edit)
        self._front.show_edit()
        waits = now.edit.changed and not self._sitting.opines
        self._nudging.start() if waits else self._nudging.stop()

    # -- saves ------------------------------------------------------------------------------------

    def save(self, then: Intent | None = None) -> None:
        """Save the edit, if there is anything to save, then go on."""
        self._nudging.stop()
        now, go_on = self._front.present, then or _nothing
        if now is None or not now.edit.changed or self._sitting.opines:
            go_on()
            return
        self.trusted(lambda: self._set(go_on))

    def _set(self, then: Intent) -> None:
        now, person = self._front.present, self._sitting.person
        if now is None:
            return
        uuid, edit = now.item.entry.uuid, now.edit

        def saved(_: Revision) -> None:
            self._front.reload()
            then()

        self._saving.save(
            lambda: self._book.of(uuid).set(person, uuid, edit.label, source=edit.source), saved
        )

    # -- how sure ---------------------------------------------------------------------------------

    def trusted(self, then: Intent) -> None:
        """Go on once the person has said how sure they are of what they set."""
        now = self._front.present
        if now is None or not now.edit.changed or now.edit.label.sigma_um is not None:
            then()
        elif self._sitting.sigma_mm is not None:
            now.edit = now.edit.trusted(self._sitting.sigma_mm)
            then()
        else:
            self._ask_sigma(lambda: self.trusted(then))

    def say_sigma(self) -> None:
        """Ask how sure the person is because they want to say so; save what is nudged meanwhile."""
        self._ask_sigma(lambda: self._front.do(self.save))

    def _ask_sigma(self, then: Intent) -> None:
        """Ask how sure the person is; asked once a sitting, changed by a key."""

        def take(sigma_mm: float) -> None:
            self._sitting.sigma_mm = sigma_mm
            then()

        ask_sigma(self._page, self._sitting.sigma_mm, take)


def _nothing() -> None:
    """Do nothing more."""

"""Editing of one label by keys and mouse."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from PySide6.QtCore import QTimer

from touchdown.app.label.page import LabelPage
from touchdown.app.label.session import USUAL_MM, AnnotationSession, PresentEpisode
from touchdown.app.shell import LabelDraft, SaveAction, SaveQueue, parse_displacement
from touchdown.backend.annotations import ControlItemLabels
from touchdown.widgets.base import tr
from touchdown.widgets.views import Point

OFFERED_MM = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0)
ASSUMED = tr("Saved with sigma {:.2f} mm. Press S to say how sure you are.", USUAL_MM)


def ask_uncertainty(page: LabelPage, known_mm: float, take: Callable[[float], None]) -> None:
    """Ask for an uncertainty in mm, with the present one marked; ``take`` receives the answer.

    Digits do not answer the question: they start the entry of a displacement.
    """
    words = {_word(mm): mm for mm in sorted({*OFFERED_MM, known_mm})}
    page.choice.offer(
        "How sure are you of what you set (sigma)?",
        list(words),
        list(words).index(_word(known_mm)),
        lambda word: take(words[word]),
        page.open_entry,
    )


def _word(sigma_mm: float) -> str:
    exact = f"{sigma_mm:g}"
    return f"{sigma_mm:.2f} mm" if len(exact) <= 4 else f"{exact} mm"


NUDGES_MS = 300


class EpisodeView(Protocol):
    """The view of the present episode, as used by label editing."""

    present: PresentEpisode | None

    def do(self, action: SaveAction) -> None:
        """Run an action after the saves in progress."""

    def show_edit(self) -> None:
        """Show the edited label."""

    def reload(self) -> None:
        """Show the stored label of the episode."""


class LabelEditing:
    """Changes the label of the present episode. Saves 0.3 s after the last nudge."""

    def __init__(
        self,
        front: EpisodeView,
        page: LabelPage,
        book: ControlItemLabels,
        session: AnnotationSession,
        saving: SaveQueue,
    ) -> None:
        self._front, self._page, self._book = front, page, book
        self._session, self._saving = session, saving
        self._nudging = QTimer(page, singleShot=True, interval=NUDGES_MS)
        self._nudging.timeout.connect(self.drop)

    @property
    def waits(self) -> bool:
        """True while a nudged label is not saved yet."""
        return self._nudging.isActive()

    def give_up(self) -> None:
        """Return to the stored label."""
        now = self._front.present
        if now is not None:
            self._nudging.stop()
            now.edit = LabelDraft.of(now.edit.base)
            self._front.show_edit()

    # -- changes ----------------------------------------------------------------------------------

    def nudge(self, dx_um: int, dy_um: int) -> None:
        """Move the face by whole µm. Nudges within 0.3 s make one revision."""
        self._front.do(lambda: self._change(lambda edit: edit.nudged(dx_um, dy_um)))

    def place(self, at_mm: Point) -> None:
        """Move the face to a position while it is dragged."""
        self._front.do(lambda: self._change(lambda edit: edit.placed(*at_mm)))

    def drop(self) -> None:
        """Save the dragged or nudged position."""
        self._front.do(self.save)

    def typed(self, text: str) -> None:
        """Set the typed displacement."""
        try:
            x, y, sigma = parse_displacement(text)
        except ValueError as error:
            self._page.say(str(error), bad=True)
            return
        self._page.leave_entry()

        def change(edit: LabelDraft) -> LabelDraft:
            placed = edit.placed(x, y)
            return placed if sigma is None else placed.trusted(sigma)

        if sigma is not None:
            self._session.sigma_mm = sigma
        self._front.do(lambda: self._change(change))
        self._front.do(self.save)

    def take_model(self) -> None:
        """Set the model's displacement as a draft with the model as its source."""
        now = self._front.present
        model = None if now is None else now.item.model
        if model is None or self._session.hides:
            self._page.say("There is no model in sight.", bad=True)
            return
        fit, source = model.fit, model.source
        self._front.do(
            lambda: self._change(lambda edit: edit.estimated(*fit.offset_mm, fit.sigma_mm, source))
        )
        self._front.do(self.save)

    def _change(self, change: Callable[[LabelDraft], LabelDraft]) -> None:
        now = self._front.present
        if now is None:
            return
        now.edit = change(now.edit)
        self._front.show_edit()
        waits = now.edit.changed and not self._session.opines
        self._nudging.start() if waits else self._nudging.stop()

    # -- saves ------------------------------------------------------------------------------------

    async def save(self) -> None:
        """Save the edit in front, if it was changed."""
        self._nudging.stop()
        now = self._front.present
        if now is None or not now.edit.changed or self._session.opines:
            return
        self.add_sigma()
        uuid, edit, person = now.item.entry.uuid, now.edit, self._session.person
        await self._saving.save(
            lambda: self._book.of(uuid).set(person, uuid, edit.label, source=edit.source)
        )
        self._front.reload()
        self.tell_assumed(edit)

    def add_sigma(self) -> None:
        """Give a changed edit the uncertainty of the person, stated or assumed."""
        now = self._front.present
        if now is not None and now.edit.changed and now.edit.label.sigma_um is None:
            now.edit = now.edit.trusted(self._session.trusted_mm)

    def tell_assumed(self, saved: LabelDraft) -> None:
        """Tell that the uncertainty of a saved edit was assumed, until the person states it."""
        assumed = self._session.sigma_mm is None and saved.source == "human"
        if assumed and saved.changed and not self._page.message.text():
            self._page.say(ASSUMED)

    def ask_sigma(self) -> None:
        """Ask for the person's uncertainty; it also holds for the present draft of the person."""

        def take(sigma_mm: float) -> None:
            self._session.sigma_mm = sigma_mm
            now = self._front.present
            if now is not None:
                base = now.edit.base
                own = base.state == "draft" and base.person == self._session.person
                if now.edit.source == "human" and (own or now.edit.changed):
                    now.edit = now.edit.trusted(sigma_mm)
            self._front.do(self.save)

        ask_uncertainty(
            self._page, self._session.trusted_mm, lambda mm: self._front.do(lambda: take(mm))
        )


PAUSE_S = 60.0


class ViewingTimer:
    """Adds up the time between inputs; gaps longer than a minute are not counted."""

    def __init__(self, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        self._last_s, self._seen_s = now_s(), 0.0

    def restart(self) -> None:
        """Start timing another episode."""
        self._last_s, self._seen_s = self._now_s(), 0.0

    def alive(self) -> None:
        """Record a key press or a click."""
        now_s = self._now_s()
        if now_s - self._last_s <= PAUSE_S:
            self._seen_s += now_s - self._last_s
        self._last_s = now_s

    def seen_ms(self) -> int:
        """Return the time spent on this episode."""
        self.alive()
        return round(1e3 * self._seen_s)

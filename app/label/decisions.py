"""Review decisions on a label."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

from touchdown.app.label.page import REVIEWING, LabelPage
from touchdown.app.label.presenter import LabelPresenter
from touchdown.backend.annotations import REJECT_REASONS, Operation, Verdict
from touchdown.widgets.base import count_noun, tr

NO_DISPLACEMENT = "No displacement yet: type x,y or nudge; PgDown skips, D rejects."
VERDICTS: tuple[tuple[str, str], ...] = (("S", "stable"), ("U", "unstable"), ("?", "unsure"))


class LabelDecisions:
    """Actions that end in one operation on the dataset."""

    def __init__(self, page: LabelPage, presenter: LabelPresenter) -> None:
        self._page, self._on = page, presenter

    def enter(self) -> None:
        """Accept (approve, while reviewing) and go on. Repeats a save that failed."""
        if self._on.saving.failure:
            self._on.saving.try_again()
        else:
            self._on.do(self._accept)

    async def _accept(self) -> None:
        now, session = self._on.present, self._on.session
        if now is None:
            # There is no decision on an episode that cannot be read.
            if self._on.walk.uuid is not None:
                self._on.go_on()
            return
        if session.opines:
            await self._answer_blind()
            return
        if session.queue in REVIEWING and now.edit.base.state != "draft" and not now.edit.changed:
            labels, uuid, looked = self._on.book, now.item.entry.uuid, self._on.looked()
            await self._on.saving.save(lambda: labels.approve(session.person, uuid, context=looked))
            self._on.go_on()
            return
        if now.edit.base.state in ("submitted", "approved") and not now.edit.changed:
            # There is nothing to accept: another person reviews it.
            self._on.go_on()
            return
        model = now.item.model
        if not now.edit.label.is_set and model is not None and not session.hides:
            fit = model.fit
            now.edit = now.edit.estimated(*fit.offset_mm, fit.sigma_mm, model.source)
        if not now.edit.label.is_set:
            self._on.refuse(NO_DISPLACEMENT)
            return
        self._on.editing.add_sigma()
        book, person = self._on.shown, session.person
        uuid, edit, looked = now.item.entry.uuid, now.edit, self._on.looked()
        source = edit.source if edit.changed else None
        await self._on.saving.save(
            lambda: book.of(uuid).accept(person, uuid, edit.label, source=source, context=looked)
        )
        self._on.go_on()
        self._on.editing.tell_assumed(edit)

    def carry(self) -> None:
        """Accept, and correct the other probes of the grip in the same way."""
        self._on.do(self._carry)

    async def _carry(self) -> None:
        now, session, book = self._on.present, self._on.session, self._on.book
        if now is None or session.opines or session.queue in REVIEWING:
            self._page.say("A correction is carried to the grip only while labelling.", bad=True)
            return
        uuid, person = now.item.entry.uuid, session.person
        await self._accept()
        head = self._on.shown.of(uuid).head(uuid)  # also of a control item
        if head.state not in ("submitted", "approved"):
            return
        found = self._on.dataset.carried(person, head)
        rows = found.rows
        if not rows:
            self._page.say("The grip has no other draft by the arm.")
            return
        await self._on.saving.save(lambda: book.bulk(person, found))
        x_mm, y_mm = rows[0].after.label.offset_mm - rows[0].before.label.offset_mm
        said = tr("{} of the grip moved by {:+.2f}, {:+.2f} mm and accepted. U takes it back.",
                  count_noun(len(rows), "other probe"), x_mm, y_mm)  # fmt: skip
        if any(self._on.walk.find(row.episode) >= 0 for row in rows):
            self._on.read_with_news(said)
        else:
            self._on.show_at(self._on.walk.at, said)

    async def _answer_blind(self) -> None:
        now = self._on.present
        if now is None or not now.edit.label.is_set:
            self._on.refuse("Set the displacement as you see it: x,y or the arrows.")
            return
        self._on.editing.add_sigma()
        book, person = self._on.book, self._on.session.person
        uuid, label, verdict = now.item.entry.uuid, now.edit.label, now.verdict
        looked = self._on.looked()
        await self._on.saving.save(
            lambda: book.opinion(person, uuid, label, verdict=verdict, context=looked)
        )
        self._on.walk.answered.add(uuid)
        self._on.go_on()

    def reject(self) -> None:
        """Ask for the reason by one digit, then reject and go on."""
        choices = [(str(n), word) for n, word in enumerate(REJECT_REASONS, start=1)]
        self._ask("Reject because of", choices, self._reject_because)

    def _reject_because(self, word: str) -> None:
        if word == REJECT_REASONS[-1]:
            self._page.ask_words("Reason", "", self._reject)
        else:
            self._reject(word)

    def _reject(self, reason: str) -> None:
        self._with_present(
            lambda person, uuid: self._on.shown.of(uuid).reject(
                person, uuid, reason, context=self._on.looked()
            ),
            go_on=True,
        )

    def flag(self) -> None:
        """Set or remove the flag."""
        now = self._on.present
        if now is not None:
            wanted = not self._on.walk.entries[now.item.entry.uuid].flagged
            self._with_present(lambda person, uuid: self._on.book.flag(person, uuid, wanted))

    def verdict(self) -> None:
        """Ask whether the piece would stand; the displacement keeps its source."""
        self._ask("Would it stand?", VERDICTS, self._say_verdict)

    def _say_verdict(self, word: str) -> None:
        verdict, now = cast("Verdict", word), self._on.present
        if now is not None and self._on.session.opines:
            now.verdict = verdict
            self._on.show_edit()
        elif now is not None:
            label = now.edit.base.label
            shown = self._on.shown
            self._with_present(
                lambda person, uuid: shown.of(uuid).set(person, uuid, label, verdict=verdict)
            )

    def take_over(self) -> None:
        """Take over another person's draft."""
        self._with_present(lambda person, uuid: self._on.shown.of(uuid).take_over(person, uuid))

    def restore(self, rev_uuid: str) -> None:
        """Restore an old version as a new one."""
        self._with_present(
            lambda person, uuid: self._on.shown.of(uuid).restore_revision(person, uuid, rev_uuid)
        )

    def delete(self) -> None:
        """Ask for the reason, then hide the episode; undo restores it."""
        shown = self._on.shown
        self._page.ask_words(
            "Delete the episode because",
            "",
            lambda reason: self._with_present(
                lambda person, uuid: shown.of(uuid).delete(person, uuid, reason), go_on=True
            ),
        )

    def resolve(self) -> None:
        """Ask which version of a conflict is valid."""
        now = self._on.present
        if now is None:
            return
        leaves = self._on.book.conflicting(now.item.entry.uuid)
        if len(leaves) < 2:
            self._page.say("There is no conflict here.", bad=True)
            return
        words = {f"{leaf.person}, {leaf.state}, {k}": leaf for k, leaf in enumerate(leaves, 1)}
        choices = [(str(n), word) for n, word in enumerate(words, start=1)]

        def take(word: str) -> None:
            rev_uuid = words[word].rev_uuid
            self._with_present(lambda person, uuid: self._on.book.resolve(person, uuid, rev_uuid))

        self._ask("Which label holds?", choices[:9], take)

    def undo(self) -> None:
        """Undo the person's last action."""
        self._reversed(self._on.book.undo, "Undone.", "Undone on {}.")

    def redo(self) -> None:
        """Redo the last undone action."""
        self._reversed(self._on.book.redo, "Done again.", "Done again on {}.")

    def _reversed(self, work: Callable[[str], Operation | None], one: str, more: str) -> None:
        person = self._on.session.person

        async def reverse() -> None:
            found = await self._on.saving.save(lambda: work(person))
            if found is None:
                self._page.say("There is nothing to take back.")
            else:
                episodes = count_noun(len(found.episodes), "episode")
                self._show(found.episodes, tr(one if len(found.episodes) == 1 else more, episodes))

        self._on.flushed(reverse)

    def _show(self, touched: list[str], said: str) -> None:
        for uuid in touched:
            if uuid in self._on.walk.entries:
                self._on.walk.take(self._on.entry(uuid))
        here = self._on.present.item.entry.uuid if self._on.present is not None else ""
        places = [at for uuid in touched if (at := self._on.walk.find(uuid)) >= 0]
        if not here:
            self._on.read_with_news(said)
        elif here in touched or not places:
            self._on.reload()
            self._page.say(said)
        else:
            self._on.show_at(places[0], said)

    def _with_present(self, work: Callable[[str, str], Any], *, go_on: bool = False) -> None:
        """Save the edit, then run ``work`` with the person and the episode."""

        async def save() -> None:
            now, person = self._on.present, self._on.session.person
            if now is not None:
                uuid = now.item.entry.uuid
                await self._on.saving.save(lambda: work(person, uuid))
                self._on.go_on() if go_on else self._on.reload()

        self._on.flushed(save)

    def _ask(
        self, title: str, choices: list[tuple[str, str]] | tuple[tuple[str, str], ...],
        answer: Callable[[str], None],
    ) -> None:  # fmt: skip
        if not self._on.saving.failure:
            self._on.saving.after(lambda: self._page.choice.ask(title, choices, answer))

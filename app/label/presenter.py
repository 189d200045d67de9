"""Presenter of the label half: keys to labels, one saved revision for each edit.

Nothing is held back: an edit is saved half a second after the last nudge, and before anything else
is done. What cannot be saved stays in sight and blocks the way on.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from PySide6.QtCore import QTimer

from app.label import show
from app.label.commits import Commits
from app.label.edit import Edit, parse
from app.label.evidence import badges_of
from app.label.item import LabelItem, Prelabel, Sheets, reader
from app.label.looking import LookClock
from app.label.page import LabelPage
from app.label.post import Post
from app.label.prefetch import Prefetch
from app.label.saving import Intent, Saving
from app.label.sigma import ask_sigma
from app.label.walk import Queue, Walk, read_queue
from app.label.words import clock, history_rows
from backend.catalogue.dataset import Dataset
from backend.catalogue.values import Looked, Revision
from widgets.offset_scene import Point

NUDGES_MS = 500
EMPTY = {
    "unlabelled": "Nothing to label. Collect episodes first: touchdown collect.",
    "review": "Nothing waits for your review.",
    **dict.fromkeys(
        ("disagreement", "uncertainty", "duplicates"),
        "Nothing was scored yet: Ctrl+M lets the model score the dataset.",
    ),
}


@dataclass(slots=True)
class Sitting:
    """Who labels, and how. ``sigma_mm``: what the person last said of their own displacements."""

    person: str = ""
    queue: str = "unlabelled"
    seed: int = 0
    sigma_mm: float | None = None
    blind: bool = False
    hidden: bool = False

    @property
    def opines(self) -> bool:
        """Whether answers are opinions for the figures of agreement: no label changes."""
        return self.queue == "gold" or (self.blind and self.queue == "audit")

    @property
    def hides(self) -> bool:
        """Whether model and other sources are out of sight."""
        return self.blind or self.hidden or self.opines


@dataclass(slots=True)
class Present:
    """The episode in front."""

    item: LabelItem
    edit: Edit
    history: list[Revision] = field(default_factory=list)


class LabelPresenter:
    """Joins one dataset to the page. ``close`` it: it owns a thread."""

    def __init__(
        self,
        page: LabelPage,
        dataset: Dataset,
        prelabel: Prelabel,
        commits: Commits,
        post: Post,
        sitting: Sitting,
    ) -> None:
        self._page, self.dataset, self.book = page, dataset, dataset.labels
        self.sitting = sitting
        self.present: Present | None = None
        self.saving = Saving(commits, self.refuse, self._show_saving)
        self._sheets: Sheets | None = None
        read = reader(dataset, prelabel, lambda: self._sheets)
        self._prefetch = Prefetch(read, post, self._arrived)
        self.walk = Walk(page.list, self._prefetch)
        self.clock = LookClock()
        self._news = ""
        self._nudging = QTimer(page)
        self._nudging.setSingleShot(True)
        self._nudging.setInterval(NUDGES_MS)
        self._nudging.timeout.connect(self._nudged)

    @property
    def nudging(self) -> bool:
        """Whether an edit waits for the end of the nudges."""
        return self._nudging.isActive()

    def close(self) -> None:
        """End the reading ahead; an edit that waits is saved first."""
        if self._nudging.isActive():
            self._nudging.stop()
            self._save_edit()
        self._prefetch.close()

    # -- the queue --------------------------------------------------------------------------------

    def read_queue(self, *, stay: bool = True) -> None:
        """Read the chosen queue anew; ``stay``: the present episode stays in front if it can."""
        s, here = self.sitting, (self.walk.uuid or "") if stay else ""
        self.saving.save(
            lambda: read_queue(self.dataset, s.queue, s.person, s.seed),
            lambda queue: self._take_queue(queue, here),
        )

    def read_with_news(self, text: str) -> None:
        """Read the queue anew because of ``text``, which is said beside it."""
        self._news = text
        self.flushed(self.read_queue)

    def choose_queue(self, name: str) -> None:
        """Change to another queue, and begin with its first."""
        self.sitting.queue = name
        self.flushed(lambda: self.read_queue(stay=False))

    def _take_queue(self, queue: Queue, stay: str) -> None:
        self.walk.begin(*queue, stay)
        self._show_count()
        self._show_present()

    def go_to(self, at: int) -> None:
        """Bring another episode of the queue to the front."""
        self.flushed(lambda: self._go(at))

    def move(self, by: int) -> None:
        """Go on (1) or back (-1) without a decision; going on over an undecided one skips it."""
        if by > 0 and self.present is not None and self._undecided():
            uuid, person = self.present.item.entry.uuid, self.sitting.person
            self.flushed(
                lambda: self.saving.save(
                    lambda: self.book.skip(person, uuid), lambda _: self._go(self.walk.at + by)
                )
            )
        else:
            self.flushed(lambda: self._go(self.walk.at + by))

    def _undecided(self) -> bool:
        return self.present is not None and self.present.edit.base.state in ("unlabelled", "draft")

    def go_on(self) -> None:
        """Go to the next episode after a decision."""
        self._go(self.walk.at + 1)

    def show_at(self, at: int) -> None:
        """Show another place of the queue; there is no edit to save."""
        self._go(at)

    def _go(self, at: int) -> None:
        if self.walk.move_to(at):
            self._show_present()
        else:
            end = "The end of the queue" if at > 0 else "The beginning of the queue"
            self._page.say(f"{end}: Ctrl+R reads it anew.")

    def _arrived(self, uuid: str) -> None:
        if uuid == self.walk.uuid and (
            self.present is None or self.present.item.entry.uuid != uuid
        ):
            self._show_present()
            self.saving.go_on()

    def _show_present(self) -> None:
        """Show the present episode; while it is being read the former picture stays."""
        ready = self.walk.ready()
        self.saving.hold(ready is None)
        if ready is None:
            return
        self.clock.restart()
        self._sheets = self._page.sheets()
        self._page.say(self._news)
        self._news = ""
        if isinstance(ready, Exception):
            self.present = None
            self._page.view.show_nothing("None is in front.")
            self._page.film.show_reel({}, (0.0, 2.0), 0.0)
            self._page.shots.show_shots(())
            self._page.verdict.setText("")
            if self.walk.uuid is None:
                self._page.say(EMPTY.get(self.sitting.queue, "This queue is empty."))
            else:
                self._page.say(f"This episode cannot be read: {ready}", bad=True)
            self._show_saving()
            return
        uuid = ready.entry.uuid
        self.present = Present(ready, self._begin(uuid), self.book.history(uuid))
        show.show_item(self._page, ready)
        self._show_label()

    def _begin(self, uuid: str) -> Edit:
        head = self.book.head(uuid)
        return Edit.blank(head) if self.sitting.opines else Edit.of(head)

    # -- what is shown of the label ---------------------------------------------------------------

    def _show_label(self) -> None:
        """Show head, history and row of the present episode."""
        now = self.present
        if now is None:
            return
        self.show_edit()
        told = [] if self.sitting.opines else history_rows(now.history, now.edit.base)
        self._page.side.history.show_rows(told)
        self.walk.note(now.item.entry.uuid, self.badges())

    def show_edit(self) -> None:
        """Show where the face is now, saved or not."""
        now = self.present
        if now is not None:
            hides = self.sitting.hides
            show.show_edit(self._page, now.item, now.edit, now.history, hidden=hides)
            self._show_saving()

    def badges(self) -> tuple[str, ...]:
        """Return the badge of the present label, if other evidence differs notably."""
        now = self.present
        if now is None or self.sitting.hides:
            return ()
        return badges_of(now.edit, now.item)

    def _show_saving(self) -> None:
        page, now, trouble = self._page, self.present, self.saving.trouble
        page.banner.show_trouble(trouble.what if trouble is not None else "")
        page.view.editable = now is not None and trouble is None
        if now is None:
            page.strip.show_label("", (), "")
            return
        if trouble is not None or now.edit.changed:
            saved = "not saved yet" if self.sitting.opines else "unsaved"
        else:
            saved = f"saved {clock(now.edit.base.at_ns)}, rev {len(now.history)}"
        badges = self.badges()
        flags = ("flag",) if self.walk.entries[now.item.entry.uuid].flagged else ()
        verdict = (f"says {now.edit.base.verdict}",) if now.edit.base.verdict else ()
        page.strip.show_label(now.edit.base.state, (*badges, *flags, *verdict), saved,
                              warns=bool(badges))  # fmt: skip

    def _show_count(self) -> None:
        count = len(self.walk.order)
        self._page.queue_panel.detail.setText("1 episode" if count == 1 else f"{count} episodes")

    def refuse(self, reason: str) -> None:
        """Say why something was not done; the edit goes back to what holds."""
        if self.present is not None:
            self._nudging.stop()
            self.present.edit = Edit.of(self.present.edit.base)
            self.show_edit()
        self._page.say(reason, bad=True)

    # -- edits ------------------------------------------------------------------------------------

    def do(self, intent: Intent) -> None:
        """Do something after the saves that are under way; nothing while one has failed."""
        self.clock.alive()
        if self.saving.trouble is not None:
            self._page.say("Save or discard first.", bad=True)
        else:
            self.saving.after(intent)

    def flushed(self, intent: Intent) -> None:
        """Do something after the present edit was saved."""
        self.do(lambda: self._save_edit(intent))

    def nudge(self, dx_um: int, dy_um: int) -> None:
        """Move the face by whole µm; nudges within half a second are one revision."""
        self.do(lambda: self._change(lambda edit: edit.nudged(dx_um, dy_um)))

    def _nudged(self) -> None:
        """Save what was nudged; no question comes between while something is being typed."""
        if self._page.typing and self.sitting.sigma_mm is None:
            self._nudging.start()
        else:
            self.do(self._save_edit)

    def place(self, at_mm: Point) -> None:
        """Move the face to a place (while it is dragged)."""
        self.do(lambda: self._change(lambda edit: edit.placed(*at_mm)))

    def drop(self) -> None:
        """Save what was dragged."""
        self.do(self._save_edit)

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
            self.sitting.sigma_mm = sigma
        self.do(lambda: self._change(change))
        self.do(self._save_edit)

    def take_model(self) -> None:
        """Take the model's displacement as a draft with the model as its source."""
        now = self.present
        if now is None or now.item.model is None or self.sitting.hides:
            self._page.say("There is no model in sight.", bad=True)
            return
        self.do(lambda: self._change(_as_model_says(now.item)))
        self.do(self._save_edit)

    def _change(self, change: Callable[[Edit], Edit]) -> None:
        now = self.present
        if now is None:
            return
        now.edit = change(now.edit)
        self.show_edit()
        waits = now.edit.changed and not self.sitting.opines
        self._nudging.start() if waits else self._nudging.stop()

    def _save_edit(self, then: Intent | None = None) -> None:
        self._nudging.stop()
        now, then = self.present, then or _nothing
        if now is None or not now.edit.changed or self.sitting.opines:
            then()
            return
        self.trusted(lambda: self._set(then))

    def _set(self, then: Intent) -> None:
        now, person = self.present, self.sitting.person
        if now is None:
            return
        uuid, edit = now.item.entry.uuid, now.edit

        def saved(_: Revision) -> None:
            self.reload()
            then()

        self.saving.save(lambda: self.book.set(person, uuid, edit.label, source=edit.source), saved)

    def trusted(self, then: Intent) -> None:
        """Go on once the person has said how sure they are of what they set."""
        now = self.present
        if now is None or not now.edit.changed or now.edit.label.sigma_um is not None:
            then()
        elif self.sitting.sigma_mm is not None:
            now.edit = now.edit.trusted(self.sitting.sigma_mm)
            then()
        else:
            self.ask_sigma(lambda: self.trusted(then))

    def ask_sigma(self, then: Intent) -> None:
        """Ask how sure the person is; asked once a sitting, changed by a key."""

        def take(sigma_mm: float) -> None:
            self.sitting.sigma_mm = sigma_mm
            then()

        ask_sigma(self._page, self.sitting.sigma_mm, take)

    def reload(self) -> None:
        """Show what the dataset says of the present episode now."""
        now = self.present
        if now is not None:
            uuid = now.item.entry.uuid
            now.edit, now.history = self._begin(uuid), self.book.history(uuid)
            self.walk.take(self.dataset.entry(uuid))
            self._show_label()

    def looked(self) -> Looked:
        """Return how the person came to the answer."""
        return Looked(self.clock.seen_ms(), self.sitting.hides)


def _as_model_says(item: LabelItem) -> Callable[[Edit], Edit]:
    def change(edit: Edit) -> Edit:
        model = item.model
        if model is None:
            return edit
        return edit.estimated(*model.fit.offset_mm, model.fit.sigma_mm, model.source)

    return change


def _nothing() -> None:
    """Do nothing more."""

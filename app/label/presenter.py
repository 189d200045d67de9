"""Presenter of the label workspace."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

from touchdown.app import shell
from touchdown.app.label.editing import LabelEditing, ViewingTimer
from touchdown.app.label.page import (
    EMPTY_QUEUE,
    EMPTY_QUEUES,
    LOADING,
    NO_PROBES,
    REVIEWING,
    UNREADABLE,
    EmptyState,
    LabelPage,
)
from touchdown.app.label.session import (
    AnnotationSession,
    FindingQueue,
    Prefetcher,
    PresentEpisode,
    QueueCursor,
    QueueEntries,
    read_queue,
)
from touchdown.app.label.text import (
    FINDING,
    RETRAIN_EVERY,
    EnterAct,
    basis_text,
    evidence_badges,
    evidence_ghosts,
    history_rows,
    local_time_text,
    model_evidence_text,
    next_step_text,
    scene_evidence_text,
    sources_differ,
)
from touchdown.backend.annotations import (
    AnswerContext,
    ControlItemLabels,
    Dataset,
    EpisodeEntry,
    QualityReport,
    Revision,
)
from touchdown.backend.episodes import QualityIssue
from touchdown.backend.placement import resting_contact
from touchdown.widgets.base import count_noun, tr
from touchdown.widgets.views import OffsetScene, verdict_text


def next_work(dataset: Dataset, session: AnnotationSession) -> tuple[str, int]:
    """Return the next queue of the person and its size; "" and the approved labels if none."""
    for name in ("returned", "review", "unlabelled"):
        if size := len(dataset.queue(name, session.person)):
            return name, size
    return "", dataset.counts().get("approved", 0)


def show_item(page: LabelPage, item: shell.LabelItem) -> None:
    """Show the recorded data of an episode."""
    page.show_something()
    first, last = item.span_s
    at_s = min(max(shell.CURSOR_S, first), last)
    page.film.take_reel(item.reel, (max(first, 0.0), last))
    for plot in (page.forces, page.moments, page.phase):
        plot.show_trace(item.trace)
    page.show_cursor(at_s)
    entry = item.entry
    page.view_panel.detail.setText(entry.uuid[-8:])
    page.view_panel.detail.setToolTip(tr("{} on {}", entry.piece, entry.bottom))


def show_edit(
    page: LabelPage, item: shell.LabelItem, edit: shell.LabelDraft, history: Sequence[Revision],
    session: AnnotationSession,
) -> None:  # fmt: skip
    """Show the edited label and its consequences."""
    hidden, act = session.hides, _enter_act(edit, session)
    scene = offset_scene(item, edit, history, hidden=hidden)
    page.view.show_scene(scene)
    page.verdict.setText(verdict_text(scene))
    model = None if hidden or item.model is None else item.model.fit
    differ = None if hidden or edit.source == "human" else sources_differ(edit, item)
    page.basis.setText(basis_text(edit, model, act, differ))
    page.model_line.setText(model_evidence_text(edit, item, hidden=hidden))
    page.scene_line.setText(scene_evidence_text(edit, item, hidden=hidden))
    outlines = item.face, item.bottom
    page.shots.show_shots(shell.scene_shots(item.scene, edit, outlines, hidden=hidden))


def _enter_act(edit: shell.LabelDraft, session: AnnotationSession) -> EnterAct:
    """Return what Enter does with the label, "" if it stays as it is."""
    if session.opines:
        return ""
    if edit.changed or edit.base.state == "draft":
        return "accept"
    if session.queue in REVIEWING:
        return "approve"
    return "" if edit.base.state in ("submitted", "approved") else "accept"


def offset_scene(
    item: shell.LabelItem, edit: shell.LabelDraft, history: Sequence[Revision], *, hidden: bool
) -> OffsetScene:
    """Return the scene of an edit; ``hidden`` leaves out the model and other sources."""
    ghosts = () if hidden else evidence_ghosts(item, history)
    offset = edit.offset_mm
    if offset is None:
        return OffsetScene(item.bottom, item.face, ghosts=ghosts)
    pair = item.pair
    f = resting_contact(pair.points_mm, pair.centre_mm, pair.bottom, offset, edit.yaw_rad)
    return OffsetScene(
        item.bottom, item.face, offset, edit.yaw_rad, f.points_mm, f.touching, f.hull_mm,
        f.centre_mm, f.margin_mm, f.support, f.too_close, edit.sigma_mm, ghosts,
    )  # fmt: skip


class LabelPresenter:
    """Connects one dataset to the label page. Owns a thread: call ``close``."""

    def __init__(
        self,
        page: LabelPage,
        opened: shell.OpenedDataset,
        worker: shell.SaveWorker,
        session: AnnotationSession,
    ) -> None:
        self._page, self.dataset, self.book = page, opened.dataset, opened.dataset.labels
        # Labels as the person sees them: control items look like the rest.
        self.shown = ControlItemLabels(self.book)
        self.session = session
        self.present: PresentEpisode | None = None
        self.saving = shell.SaveQueue(worker, self.refuse, self._show_saving)
        self.editing = LabelEditing(self, page, self.shown, session, self.saving)
        read = shell.item_reader(opened.dataset, opened.prelabel)
        self._prefetch = Prefetcher(read, worker, self._arrived)
        nothing = QueueEntries(opened.dataset, (), 0)
        self.walk = QueueCursor(page.list, self._prefetch, nothing)
        page.list.selection_changed.connect(self._show_count)
        self.clock = ViewingTimer()
        self._news = ""
        self._badges: tuple[str, ...] = ()
        # Gets the size of a queue that is done, the next queue of the person, and its size.
        self.ended: Callable[[int, str, int], None] = lambda *_: None

    def close(self) -> None:
        """Save a pending edit and end the prefetching."""
        if self.editing.waits:
            self.saving.start(self.editing.save())
        self._prefetch.close()

    # -- the queue --------------------------------------------------------------------------------

    async def read_queue(self, *, stay: bool = True) -> None:
        """Read the chosen queue again. With ``stay`` the present episode stays if it can."""
        session, here = replace(self.session), (self.walk.uuid or "") if stay else ""
        order, entries, gold = await self.saving.save(lambda: read_queue(self.dataset, session))
        self._cover_rows()
        self._page.show_filter(session.wanted, saved=session.queue in session.saved)
        self.shown.begin(self.session.person, gold)
        entries.update({uuid: self.shown.entry(entries[uuid]) for uuid in gold})
        self.walk.begin(order, entries, here)
        self._show_present()

    def refresh(self) -> None:
        """Read the queue again, without saving the present edit."""
        self.saving.start(self.read_queue())

    def read_with_news(self, text: str) -> None:
        """Read the queue again and show ``text`` as the reason."""
        self._news = text
        self.flushed(self.read_queue)

    def read_anew(self, text: str) -> None:
        """Read all episodes again after a change of models."""

        async def again() -> None:
            self.present, self._news = None, text
            self._prefetch.forget()
            await self.read_queue()

        self.flushed(again)

    def choose_queue(self, name: str) -> None:
        """Change to another queue and show its first episode."""
        self.session.queue = name
        self.flushed(lambda: self.read_queue(stay=False))

    def open_chosen(self, chosen: FindingQueue) -> None:
        """Open the queue of a finding."""
        self.session.chosen = chosen
        self._page.show_queue(FINDING, chosen.title)
        self.choose_queue(FINDING)

    def go_to(self, at: int) -> None:
        """Show another episode of the queue."""
        self.flushed(lambda: self._go(at))

    def go_to_number(self, text: str) -> None:
        """Show the episode with a typed number, counted from 1."""
        if text.isdecimal() and 1 <= int(text) <= len(self.walk.order):
            self.go_to(int(text) - 1)
        else:
            self._page.say(tr("The queue has no number {}.", text), bad=True)

    def move(self, by: int) -> None:
        """Go forward (1) or back (-1) without a decision.

        Going forward skips an undecided episode.
        """
        now, person = self.present, self.session.person
        undecided = now is not None and now.edit.base.state in ("unlabelled", "draft")

        async def move() -> None:
            if by > 0 and now is not None and undecided:
                uuid = now.item.entry.uuid
                await self.saving.save(lambda: self.shown.of(uuid).skip(person, uuid))
            self._go(self.walk.at + by)

        self.flushed(move)

    def go_on(self) -> None:
        """Show the next episode after a decision."""
        now = self.present
        if now is not None and isinstance(self.walk.ahead(), shell.LabelItem):
            # The label is not shown again, so only its row is updated.
            self._take(now)
            self.walk.note(now.item.entry.uuid, self._badges_of(now))
        else:
            self.reload()
        if self.walk.at + 1 == len(self.walk.order) and not self.session.opines:
            self.saving.after(self._end)
        else:
            if self.session.queue == "training" and (self.walk.at + 1) % RETRAIN_EVERY == 0:
                self.ended(self.walk.at + 1, "", RETRAIN_EVERY)
            self._go(self.walk.at + 1)

    async def _end(self) -> None:
        """Tell what is left at the end of the queue; show that nothing is."""
        session, at, done = replace(self.session), self.walk.uuid, len(self.walk.order)
        left, _, _ = await self.saving.save(lambda: read_queue(self.dataset, session))
        if not left:
            self._news = "The end of the queue: nothing is left."
            await self.read_queue(stay=False)
            self.ended(done, *await self.saving.save(lambda: next_work(self.dataset, session)))
        elif self.walk.uuid == at:
            count = count_noun(len(left), "episode")
            self._page.say(tr("The end of the queue: {} left. Ctrl+R reads it again.", count))

    def show_at(self, at: int, said: str) -> None:
        """Show another place of the queue with a message. There must be no unsaved edit."""
        self._news = said
        self._go(at)

    def _go(self, at: int) -> None:
        if self.walk.move_to(at):
            self._show_present()
        else:
            end = "The end of the queue: Ctrl+R reads it again."
            self._page.say(end if at > 0 else "The beginning of the queue: Ctrl+R reads it again.")

    def _arrived(self, uuid: str) -> None:
        if uuid == self.walk.uuid and (
            self.present is None or self.present.item.entry.uuid != uuid
        ):
            self._show_present()
            self.saving.drain()

    def _show_present(self) -> None:
        """Show the present episode; the previous one stays visible while it is being read."""
        ready = self.walk.ready()
        self.saving.hold(ready is None)
        if ready is None:
            if self.present is None:
                self._page.show_nothing(LOADING)
            return
        self._show_count()
        self.clock.restart()
        if isinstance(ready, Exception):
            self.present = None
            empty = self.walk.uuid is None
            self._page.say(self._news if empty else str(ready), bad=not empty)
            self._news = ""
            self._page.show_nothing(self._nothing() if empty else UNREADABLE)
            self._show_saving()
            return
        uuid = ready.entry.uuid
        self.present = PresentEpisode(ready, self._begin(uuid), self.shown.of(uuid).history(uuid))
        self._page.say(self._news or self._said_of(self.present))
        self._news = ""
        show_item(self._page, ready)
        self._show_label()

    def _nothing(self) -> EmptyState:
        """Return why the queue is empty."""
        if not self.walk.entries.total:
            return NO_PROBES
        queue = self.session.queue if self.session.wanted is None else "all"
        return EMPTY_QUEUES.get(queue, EMPTY_QUEUE)

    def _said_of(self, now: PresentEpisode) -> str:
        """Return why the episode is in this queue, where it needs an action."""
        s = self.session
        if s.queue == FINDING and s.chosen is not None:
            return s.chosen.said.get(now.item.entry.uuid, "")
        return next_step_text(now.edit.base, reviewing=s.queue == "review", opines=s.opines)

    def _begin(self, uuid: str) -> shell.LabelDraft:
        head = self.shown.of(uuid).head(uuid)
        return shell.LabelDraft.blank(head) if self.session.opines else shell.LabelDraft.of(head)

    # -- what is shown of the label ---------------------------------------------------------------

    def _show_label(self) -> None:
        now = self.present
        if now is None:
            return
        self.show_edit()
        told = [] if self.session.opines else history_rows(now.history, now.edit.base)
        self._page.side.history.show_rows(told)
        self.walk.note(now.item.entry.uuid, self._badges)

    def show_edit(self) -> None:
        """Show the label in edit, saved or not."""
        now = self.present
        if now is not None:
            self._badges = self._badges_of(now)
            self._cover_rows()
            show_edit(self._page, now.item, now.edit, now.history, self.session)
            self._show_saving()

    def _cover_rows(self) -> None:
        self.walk.cover(blind=self.session.opines, hides=self.session.hides)

    def _badges_of(self, now: PresentEpisode) -> tuple[str, ...]:
        return () if self.session.hides else evidence_badges(now.edit, now.item)

    def _show_saving(self) -> None:
        page, now, failure = self._page, self.present, self.saving.failure
        if waiting := self.saving.waiting:
            page.banner.show_trouble(_waiting_words(waiting), waits=True)
        else:
            # The label itself is saved then; only its second copy is missing.
            lags = self.book.journal_trouble or self.dataset.backup_trouble
            page.banner.show_trouble(failure or lags, waits=not failure, saved=not failure)
        page.view.editable = now is not None and not failure
        if now is None:
            page.strip.show_label("", (), "")
            return
        if self.session.opines:
            said = (tr("says {}", tr(now.verdict)),) if now.verdict else ()
            answered = now.item.entry.uuid in self.walk.answered
            saved = "answered blind" if answered else "blind, not answered yet"
            page.strip.show_label("unlabelled", said, tr("unsaved" if failure else saved))
            return
        if waiting or failure or now.edit.changed:
            saved = tr("unsaved")
        else:
            saved = tr("saved {}, rev {}", local_time_text(now.edit.base.at_ns), len(now.history))
        badges = self._badges
        flags = (tr("flag"),) if self.walk.entries[now.item.entry.uuid].flagged else ()
        verdict = (tr("says {}", tr(now.edit.base.verdict)),) if now.edit.base.verdict else ()
        page.strip.show_label(now.edit.base.state, (*badges, *flags, *verdict), saved,
                              warns=bool(badges))  # fmt: skip

    def _show_count(self) -> None:
        count = len(self.walk.order)
        place = tr("{:,} of {:,}", self.walk.at + 1, count) if count else tr("empty")
        if self.walk.selected is not self.walk.order:
            place += f", {tr('{:,} selected', len(self.walk.selected))}"
        self._page.queue_panel.detail.setText(place)

    def refuse(self, reason: str) -> None:
        """Show why an action was refused; the edit returns to the stored label."""
        self.editing.give_up()
        self._page.say(reason, bad=True)

    # -- edits ------------------------------------------------------------------------------------

    def do(self, action: shell.SaveAction) -> None:
        """Run an action after the saves in progress. Refused while a save has failed."""
        self.clock.alive()
        if self.saving.failure:
            self._page.say("Save or discard first.", bad=True)
        else:
            self.saving.after(action)

    def flushed(self, action: shell.SaveAction) -> None:
        """Save the present edit, then run an action."""

        async def save_and_run() -> None:
            await self.editing.save()
            follow = action()
            if follow is not None:
                await follow

        self.do(save_and_run)

    def reload(self) -> None:
        """Show the stored label of the present episode."""
        now = self.present
        if now is not None:
            asked = self._said_of(now)
            self._take(now)
            self._show_label()
            if asked and self._page.message.text() == asked:
                self._page.say(self._said_of(now))

    def _take(self, now: PresentEpisode) -> None:
        uuid = now.item.entry.uuid
        now.edit, now.history = self._begin(uuid), self.shown.of(uuid).history(uuid)
        self.walk.entries.renew(self.entry(uuid))

    def entry(self, uuid: str) -> EpisodeEntry:
        """Return the index entry of an episode as the person may see it."""
        return self.shown.entry(self.dataset.entry(uuid))

    def looked(self) -> AnswerContext:
        """Return the context of the person's answer."""
        return AnswerContext(self.clock.seen_ms(), self.session.hides)


def _waiting_words(count: int) -> str:
    waits = "another program is writing to the dataset. {} will be done as soon as it has finished."
    return tr(waits, count_noun(count, "waiting action"))


DIGITS = 9


@dataclass(frozen=True, slots=True)
class FindingGroup:
    """All findings of one kind: text by episode, and the first text."""

    name: str
    said: dict[str, str]
    first: str

    @property
    def title(self) -> str:
        """Kind and number of episodes."""
        return f"{tr(self.name)}: {count_noun(len(self.said), 'episode')}"


class HealthPresenter:
    """Keeps the result of the last dataset check."""

    def __init__(self, page: LabelPage, presenter: LabelPresenter) -> None:
        self._page, self._on = page, presenter
        self.kinds: list[FindingGroup] = []

    def show(self, health: QualityReport) -> None:
        """Show the findings, most important kinds first."""
        self.kinds = group_findings(health.findings)
        self._page.health.show_findings(
            health_text(health, len(self.kinds), datetime.now()),
            [f"{kind.title}\n{kind.first}" for kind in self.kinds],
        )

    def choose(self, row: int) -> None:
        """Open the episodes of a finding as a queue."""
        if 0 <= row < len(self.kinds):
            kind = self.kinds[row]
            self._on.open_chosen(FindingQueue(kind.title, kind.said))

    def ask(self) -> None:
        """Ask for a finding by one digit."""
        if not self.kinds:
            self._page.say("There are no findings: Ctrl+H looks through the dataset.")
            return
        names = [kind.name for kind in self.kinds[:DIGITS]]
        choices = [(str(n), name) for n, name in enumerate(names, start=1)]
        self._page.choice.ask("Which finding?", choices, lambda t: self.choose(names.index(t)))


def group_findings(findings: Sequence[QualityIssue]) -> list[FindingGroup]:
    """Group the findings by kind, in order of first occurrence."""
    said: dict[str, dict[str, str]] = {}
    first: dict[str, str] = {}
    for finding in findings:
        first.setdefault(finding.kind, finding.text)
        for uuid in finding.episodes:
            said.setdefault(finding.kind, {}).setdefault(uuid, finding.text)
    return [FindingGroup(name.capitalize(), texts, first[name]) for name, texts in said.items()]


def health_text(health: QualityReport, kinds: int, at: datetime) -> str:
    """Return how many episodes were checked and the number of findings."""
    checked = count_noun(health.examined, "episode")
    if health.examined < health.count:
        checked = tr("{:,} of {}", health.examined, count_noun(health.count, "episode"))
    found = "no problems were found" if not kinds else "1 kind of finding" if kinds == 1 else ""
    found = tr(found or "{} kinds of findings", kinds)
    return tr("Checked {} at {:%H:%M}: {}.", checked, at, found)

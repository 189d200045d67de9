"""The workspace "Collect & Label" as the frame sees it; labelling needs no bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from app.label.bulk import BulkPresenter
from app.label.commands import commands_of
from app.label.commits import Commits
from app.label.decisions import Decisions
from app.label.halves import Halves
from app.label.health import HealthPresenter
from app.label.opening import Opened, opener
from app.label.page import LabelIntents, LabelPage
from app.label.panels import SidePresenter
from app.label.post import Post
from app.label.presenter import LabelPresenter
from app.label.side import HEALTH
from app.label.side_keys import SideKeys
from app.label.sitting import Sitting
from app.label.whole import WholeDataset
from app.label.words import FINDING, QUEUES
from app.workspace import Desk, Memory, Workspace
from backend.catalogue.review import check_person
from backend.core.faults import InputError, TouchdownError
from backend.runs.store import data_folder
from widgets.fault_cards import CardText


def default_folder() -> Path:
    """Return where episodes are kept unless told otherwise."""
    return data_folder() / "dataset"


class LabelWorkspace(Workspace):
    """Opens the dataset when it is first entered, so that other workspaces do not wait for it."""

    name, title, key = "collect", "Collect", "Ctrl+2"
    page: Halves

    def __init__(self, desk: Desk) -> None:
        self._desk, self.folder = desk, default_folder()
        self.sitting = Sitting()
        self.opened: Callable[[Opened], None] = _nobody
        """Told when the dataset is open."""
        self.person_changed: Callable[[str], None] = _nobody
        self.commits: Commits | None = None
        self.presenter: LabelPresenter | None = None
        self.decisions: Decisions | None = None
        self.side: SidePresenter | None = None
        self.bulk: BulkPresenter | None = None
        self.whole: WholeDataset | None = None
        self.health: HealthPresenter | None = None
        self.side_keys: SideKeys | None = None
        self._opened: Opened | None = None
        self.commands = commands_of(self, desk)
        self.held_keys = tuple((key, "Type a displacement x,y in mm") for key in "0123456789-.")

    def build_in(self, page: Halves) -> None:
        """Make the half, and put it into the page of both."""
        self.page = page
        self.label_page = LabelPage(self._desk.theme, self._intents())
        self.page.add("label", "Label", self.label_page)
        self.post = Post(self.page)

    # -- life -------------------------------------------------------------------------------------

    def enter(self) -> None:
        """Ask who labels, open the dataset if it is not open yet, read the queue anew."""
        self.label_page.setFocus()
        if not self.sitting.person:
            self.ask_person()
        elif self.presenter is None:
            self.open()
        else:
            self.presenter.read_queue()

    def leave(self) -> None:
        """Stop the film; what was moved and not saved yet is saved."""
        self.label_page.film.stop()
        self.label_page.choice.hide()
        if self.presenter is not None:
            self.presenter.flushed(_nothing)

    def close(self) -> None:
        """Save what waits, end the threads, let others write."""
        if self.whole is not None:
            self.whole.close()
        if self.presenter is not None:
            self.presenter.close()
        if self.commits is not None:
            self.commits.close()
            self.commits = None
        self.post.close()
        if self._opened is not None:
            self._opened.dataset.close()
            self._opened = None

    def memory(self) -> Memory:
        """Return who labelled last, what, and how sure they were."""
        s = self.sitting
        queue = "unlabelled" if s.queue == FINDING else s.queue
        return {"person": s.person, "queue": queue, "sigma_mm": s.sigma_mm, "blind": s.blind}

    def recall(self, memory: Memory) -> Sequence[str]:
        """Take what was remembered; return what makes no sense."""
        dropped = []
        person, queue = memory.get("person", ""), memory.get("queue", "unlabelled")
        sigma_mm, blind = memory.get("sigma_mm"), memory.get("blind", False)
        if isinstance(person, str) and (not person or _is_name(person)):
            self.sitting.person = person
        else:
            dropped.append("person")
        if isinstance(queue, str) and queue in dict(QUEUES):
            self.sitting.queue = queue
        else:
            dropped.append("queue")
        if sigma_mm is None or (isinstance(sigma_mm, float) and 0 < sigma_mm <= 20):
            self.sitting.sigma_mm = sigma_mm
        else:
            dropped.append("sigma_mm")
        if isinstance(blind, bool):
            self.sitting.blind = blind
        else:
            dropped.append("blind")
        self._show_sitting()
        return dropped

    def fit_to_theme(self) -> None:
        """Take the row height of the theme."""
        self.label_page.list.fit_to_theme()

    def open(self) -> None:
        """Open the dataset, once somebody is named; opening twice does no harm."""
        if self.presenter is not None or not self.sitting.person:
            return
        if self.commits is None:
            self.commits = Commits(self.post)
        elif self.commits.busy:
            return
        self.label_page.say("Opening the dataset …")
        self.commits.submit(opener(self.folder, self.sitting.person), self._take, self._failed)

    def _take(self, opened: Opened) -> None:
        assert self.commits is not None
        self._opened = opened
        self.presenter = LabelPresenter(
            self.label_page, opened.dataset, opened.prelabel, self.commits, self.post, self.sitting
        )
        self.decisions = Decisions(self.label_page, self.presenter)
        self.side = SidePresenter(self.label_page.side, self.presenter, self.commits)
        self.bulk = BulkPresenter(
            self.label_page.bulk, self.presenter, opened.catalogue, self.label_page.choice
        )
        self.side_keys = SideKeys(
            self.label_page, self.presenter, self.decisions, self.side, self.bulk
        )
        self.whole = WholeDataset(self.label_page, self.presenter, opened, self.post)
        self.health = HealthPresenter(self.label_page, self.label_page.health, self.presenter)
        self.label_page.say("")
        for notice in (*opened.dataset.notices, opened.read_only):
            if notice:
                self._desk.cards.show_card(
                    CardText("DATASET", notice, "", "", reset=False, notice=True)
                )
        self.presenter.read_queue()
        self.opened(opened)

    def _failed(self, error: Exception) -> None:
        fix = error.fix if isinstance(error, InputError) else "Look at the folder."
        what = error.what if isinstance(error, InputError) else str(error)
        self.label_page.say("No dataset is open.", bad=True)
        self._desk.cards.show_card(
            CardText("DATASET", what, f"In {self.folder}.", fix, reset=False)
        )

    # -- who --------------------------------------------------------------------------------------

    def ask_person(self) -> None:
        """Ask who labels."""
        if not self.sitting.person:
            self.label_page.show_nobody()
        self.label_page.ask_words("Your name", self.sitting.person, self.be)

    def be(self, name: str) -> None:
        """Go on as ``name``: the first one opens the dataset."""
        try:
            person = check_person(name)
        except TouchdownError as error:
            self.label_page.say(str(error), bad=True)
            return
        self.label_page.close_lines()
        if self.presenter is None:
            self._be(person)
            self.open()
        else:
            self.presenter.flushed(lambda: self._switch(person))

    def _switch(self, person: str) -> None:
        self._be(person)
        if self.presenter is not None:
            self.presenter.read_queue(stay=False)

    def _be(self, person: str) -> None:
        if person != self.sitting.person:
            # Another person is differently sure of what they set.
            self.sitting.sigma_mm = None
        self.sitting.person = person
        self._show_sitting()
        self._desk.remember()

    def _show_sitting(self) -> None:
        sitting, page = self.sitting, self.label_page
        page.person.setText(sitting.person or "nobody")
        page.person.setAccessibleName(f"Person: {page.person.text()}")
        page.show_queue(sitting.queue)
        self.person_changed(sitting.person)

    # -- keys -------------------------------------------------------------------------------------

    def _intents(self) -> LabelIntents:
        return LabelIntents(
            choose_row=lambda at: self.on(lambda p: p.go_to(at)),
            choose_queue=self._choose_queue,
            move=lambda at_mm: self.on(lambda p: p.editing.place(at_mm)),
            drop=lambda: self.on(lambda p: p.editing.drop()),
            seek=lambda t_s: self.label_page.show_cursor(t_s),
            restore=lambda rev: self.decide(lambda d: d.restore(rev)),
            typed=lambda text: self.on(lambda p: p.editing.typed(text)),
            key=self._type,
            again=lambda: self.decide(Decisions.enter),
            discard=self.discard,
            search=lambda text: self._search(text),
            person=self.ask_person,
            command=self._run,
            tab=lambda _: self._search(""),
            preview=lambda: self.many(BulkPresenter.preview),
            apply=lambda: self.many(BulkPresenter.apply),
            entered=lambda: self.many(BulkPresenter.preview_and_ask),
            look=self.look_through,
            finding=lambda row: self.healthy(lambda h: h.choose(row)),
        )

    def on(self, act: Callable[[LabelPresenter], None]) -> None:
        """Have the presenter do something, once the dataset is open."""
        if self.presenter is not None:
            act(self.presenter)

    def decide(self, act: Callable[[Decisions], None]) -> None:
        """Have the decisions do something, once the dataset is open."""
        if self.decisions is not None:
            act(self.decisions)

    def all(self, act: Callable[[WholeDataset], None]) -> None:
        """Do something to the whole dataset, once it is open."""
        if self.whole is not None:
            act(self.whole)

    def healthy(self, act: Callable[[HealthPresenter], None]) -> None:
        """Do something to the findings, once the dataset is open."""
        if self.health is not None:
            act(self.health)

    def many(self, act: Callable[[BulkPresenter], None]) -> None:
        """Do something to many labels, once the dataset is open."""
        if self.bulk is not None:
            act(self.bulk)

    def beside(self, act: Callable[[SideKeys], None]) -> None:
        """Do something beside the picture, once the dataset is open."""
        if self.side_keys is not None:
            act(self.side_keys)

    def ask_number(self) -> None:
        """Ask for a place of the queue, and go there."""
        self.on(lambda p: self.label_page.ask_words(
            f"Number in the queue, 1 to {len(p.walk.order):,}", "", p.go_to_number
        ))  # fmt: skip

    def _type(self, text: str) -> None:
        """Answer the question that is open with a digit, else begin a displacement with it."""
        page = self.label_page
        if text == " ":
            page.film.play_or_pause()
            return
        self.on(lambda p: p.do(
            lambda: page.choice.take(text) if page.choice.isVisible() else page.open_entry(text)
        ))  # fmt: skip

    def look_through(self) -> None:
        """Look for what is out of order in the dataset."""
        whole, health = self.whole, self.health
        if whole is not None and health is not None:
            self.label_page.side.choose(HEALTH)
            whole.look_through(health.show)

    def discard(self) -> None:
        """Give up what could not be saved."""
        if self.presenter is not None and self.presenter.saving.trouble is not None:
            self.presenter.saving.discard()
            self.presenter.reload()

    def _search(self, text: str) -> None:
        if self.side is not None:
            self.side.show(text)

    def _run(self, name: str) -> None:
        """Run a command by its name; ``collect`` is the other half."""
        if name == "collect":
            self.page.show_half("collect")
            return
        self.label_page.setFocus()
        next(command for command in self.commands if command.name == name).run()

    def hide(self) -> None:
        """Hide or show the model and other sources."""
        self.sitting.hidden = not self.sitting.hidden
        self.on(LabelPresenter.show_edit)

    def toggle_blind(self) -> None:
        """Turn blind mode on or off; what is answered blind begins without a displacement."""

        def turn() -> None:
            opined = self.sitting.opines
            self.sitting.blind = not self.sitting.blind
            words = f"Blind mode is {'on' if self.sitting.blind else 'off'}."
            if self.sitting.opines is not opined:
                self.on(lambda p: p.read_with_news(words))
            else:
                self.on(LabelPresenter.reload)
                self.label_page.say(words)

        if self.presenter is None:
            turn()
        else:
            self.presenter.flushed(turn)

    def _choose_queue(self, name: str) -> None:
        self.on(lambda p: p.choose_queue(name))
        self._desk.remember()

    def list_queues(self) -> None:
        """Open the list of the queues: arrows and Enter choose."""
        self.label_page.queue.setFocus()
        self.label_page.queue.showPopup()


def _is_name(person: str) -> bool:
    try:
        return check_person(person) == person
    except TouchdownError:
        return False


def _nobody(_what: object) -> None:
    """Do nothing: nobody waits for this."""


def _nothing() -> None:
    """Do nothing more."""

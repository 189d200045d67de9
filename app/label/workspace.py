"""The workspace "Collect & Label" as the frame sees it; labelling needs no bench."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from app.label.bulk import BulkPresenter
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
from app.label.sitting import Sitting
from app.label.whole import WholeDataset
from app.label.words import FINDING, QUEUES
from app.workspace import Command, Desk, Memory, Workspace
from backend.catalogue.review import check_person
from backend.core.faults import InputError, TouchdownError
from backend.runs.store import data_folder
from widgets.fault_cards import CardText

STEPS_UM = (("", 100), ("Shift+", 1000), ("Alt+", 10))
ARROWS = (("Left", -1, 0), ("Right", 1, 0), ("Up", 0, 1), ("Down", 0, -1))


def default_folder() -> Path:
    """Return where episodes are kept unless told otherwise."""
    return data_folder() / "dataset"


class LabelWorkspace(Workspace):
    """Opens the dataset when it is first entered, so that other workspaces do not wait for it."""

    name, title, key = "collect", "Collect", "Ctrl+2"
    page: Halves

    def __init__(self, desk: Desk, page: Halves) -> None:
        self._desk, self.folder = desk, default_folder()
        self.sitting = Sitting()
        self.label_page = LabelPage(desk.theme, self._intents())
        self.page = page
        self.opened: Callable[[Opened], None] = _nobody
        """Told when the dataset is open."""
        self.person_changed: Callable[[str], None] = _nobody
        self.page.add("label", "Label", self.label_page)
        self.post = Post(self.page)
        self.commits: Commits | None = None
        self.presenter: LabelPresenter | None = None
        self.decisions: Decisions | None = None
        self.side: SidePresenter | None = None
        self.bulk: BulkPresenter | None = None
        self.whole: WholeDataset | None = None
        self.health: HealthPresenter | None = None
        self._opened: Opened | None = None
        self.commands = self._commands()
        self.held_keys = tuple((key, "Type a displacement x,y in mm") for key in "0123456789-.")

    # -- life -------------------------------------------------------------------------------------

    def enter(self) -> None:
        """Ask who labels, open the dataset if it is not open yet, read the queue anew."""
        self.label_page.setFocus()
        if not self.sitting.person:
            self._ask_person()
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
        self.bulk = BulkPresenter(self.label_page.bulk, self.presenter, opened.catalogue)
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

    def _ask_person(self) -> None:
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
            choose_row=lambda at: self._on(lambda p: p.go_to(at)),
            choose_queue=self._choose_queue,
            move=lambda at_mm: self._on(lambda p: p.editing.place(at_mm)),
            drop=lambda: self._on(lambda p: p.editing.drop()),
            seek=lambda t_s: self.label_page.show_cursor(t_s),
            restore=lambda rev: self._decide(lambda d: d.restore(rev)),
            typed=lambda text: self._on(lambda p: p.editing.typed(text)),
            key=self._type,
            again=lambda: self._decide(Decisions.enter),
            discard=self._discard,
            search=lambda text: self._search(text),
            person=self._ask_person,
            tab=lambda _: self._search(""),
            preview=lambda: self._bulk(BulkPresenter.preview),
            apply=lambda: self._bulk(BulkPresenter.apply),
            look=self._look_through,
            finding=lambda row: self._healthy(lambda h: h.choose(row)),
        )

    def _commands(self) -> tuple[Command, ...]:
        decide, film = self._decide, self.label_page.film
        nudges = tuple(
            Command(
                f"nudge-{name.lower()}-{step}",
                f"Move the face {step / 1000:g} mm {name.lower()}",
                f"{prefix}{name}",
                self._nudger(dx * step, dy * step),
                repeats=True,
            )
            for prefix, step in STEPS_UM
            for name, dx, dy in ARROWS
        )
        return (
            Command("accept", "Accept (approve, while reviewing) and next", "Return",
                    lambda: decide(Decisions.enter)),
            *nudges,
            Command("previous", "Previous, without a decision", "PgUp",
                    lambda: self._on(lambda p: p.move(-1))),
            Command("next", "Next, without a decision: skip", "PgDown",
                    lambda: self._on(lambda p: p.move(1))),
            Command("reject", "Reject, then 1 to 9 for the reason", "D",
                    lambda: decide(Decisions.reject)),
            Command("flag", "Flag, or take the flag off", "X", lambda: decide(Decisions.flag)),
            Command("undo", "Undo my last action", "Ctrl+Z", lambda: decide(Decisions.undo)),
            Command("redo", "Redo", "Ctrl+Shift+Z", lambda: decide(Decisions.redo)),
            Command("undo-plain", "Undo my last action", "U", lambda: decide(Decisions.undo)),
            Command("redo-plain", "Redo", "Shift+U", lambda: decide(Decisions.redo)),
            Command("play", "Play the film from the cursor, or pause (Space)", "",
                    film.play_or_pause),
            Command("frame-back", "One frame back", "[", lambda: film.step(-1), repeats=True),
            Command("frame-on", "One frame forward", "]", lambda: film.step(1), repeats=True),
            Command("hide", "Hide or show the model and other sources", "H", self._hide),
            Command("model", "Take the model's displacement", "M",
                    lambda: self._on(lambda p: p.editing.take_model())),
            Command("sigma", "Say how sure you are of what you set", "S",
                    lambda: self._on(lambda p: p.editing.ask_sigma(_nothing))),
            Command("verdict", "Your verdict, then S, U or ?", "V",
                    lambda: decide(Decisions.verdict)),
            Command("take-over", "Take over another's draft", "T",
                    lambda: decide(Decisions.take_over)),
            Command("resolve", "Resolve a conflict", "C", lambda: decide(Decisions.resolve)),
            Command("delete", "Delete the episode, with a reason", "Delete",
                    lambda: decide(Decisions.delete)),
            *self._commands_of_the_whole(),
            Command("discard", "Discard what could not be saved", "Esc", self._discard),
            Command("sheet", "Key sheet", "?", self._desk.keys),
        )  # fmt: skip

    def _commands_of_the_whole(self) -> tuple[Command, ...]:
        """Return what concerns the sitting or the dataset, not the episode in front."""
        return (
            Command("blind", "Blind mode: no model, no other sources", "Ctrl+B", self._blind),
            Command("person", "Change the person", "Ctrl+U", self._ask_person),
            Command("queue", "Choose the queue", "Ctrl+J", self._next_queue),
            Command("reread", "Read the queue anew", "Ctrl+R",
                    lambda: self._on(lambda p: p.flushed(p.read_queue))),
            Command("score", "Let the model score the dataset: fills four queues", "Ctrl+M",
                    lambda: self._all(WholeDataset.score)),
            Command("health", "Look through the dataset for what is out of order", "Ctrl+H",
                    self._look_through),
            Command("findings", "Choose a finding, by its digit", "F",
                    lambda: self._healthy(HealthPresenter.ask)),
            Command("models", "Choose the models that pre-label: one, or several together", "",
                    lambda: self._all(WholeDataset.choose_models)),
            Command("merge", "Merge another copy of this dataset", "",
                    lambda: self._all(WholeDataset.merge)),
        )  # fmt: skip

    def _nudger(self, dx_um: int, dy_um: int) -> Callable[[], None]:
        return lambda: self._on(lambda p: p.editing.nudge(dx_um, dy_um))

    def _on(self, act: Callable[[LabelPresenter], None]) -> None:
        if self.presenter is not None:
            act(self.presenter)

    def _decide(self, act: Callable[[Decisions], None]) -> None:
        if self.decisions is not None:
            act(self.decisions)

    def _all(self, act: Callable[[WholeDataset], None]) -> None:
        if self.whole is not None:
            act(self.whole)

    def _healthy(self, act: Callable[[HealthPresenter], None]) -> None:
        if self.health is not None:
            act(self.health)

    def _look_through(self) -> None:
        whole, health = self.whole, self.health
        if whole is not None and health is not None:
            self.label_page.side.choose(HEALTH)
            whole.look_through(health.show)

    def _bulk(self, act: Callable[[BulkPresenter], None]) -> None:
        if self.bulk is not None:
            act(self.bulk)

    def _type(self, text: str) -> None:
        """Answer the question that is open with a digit, else begin a displacement with it."""
        page = self.label_page
        if text == " ":
            page.film.play_or_pause()
            return
        self._on(lambda p: p.do(
            lambda: page.choice.take(text) if page.choice.isVisible() else page.open_entry(text)
        ))  # fmt: skip

    def _discard(self) -> None:
        if self.presenter is not None and self.presenter.saving.trouble is not None:
            self.presenter.saving.discard()
            self.presenter.reload()

    def _search(self, text: str) -> None:
        if self.side is not None:
            self.side.show(text)

    def _hide(self) -> None:
        self.sitting.hidden = not self.sitting.hidden
        self._on(LabelPresenter.show_edit)

    def _blind(self) -> None:
        self.sitting.blind = not self.sitting.blind
        self.label_page.say("Blind mode is on." if self.sitting.blind else "Blind mode is off.")
        self._on(LabelPresenter.show_edit)

    def _choose_queue(self, name: str) -> None:
        self._on(lambda p: p.choose_queue(name))
        self._desk.remember()

    def _next_queue(self) -> None:
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

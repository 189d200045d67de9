"""Collect workspace with its labelling half."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace

from touchdown.app.collect.origin import origin_note
from touchdown.app.collect.page import CollectPage
from touchdown.app.collect.presenter import CollectPresenter
from touchdown.app.collect.requests import remembered_table, remembered_target_form
from touchdown.app.label import HalvesPage, LabelWorkspace
from touchdown.app.shell import (
    LivePresenter,
    LiveViews,
    Memory,
    OpenedDataset,
    SaveWorker,
    WindowCommand,
    Workspace,
    WorkspaceContext,
    portable_key,
)
from touchdown.backend.annotations import DESCRIPTION, Dataset
from touchdown.backend.bench import Session
from touchdown.backend.core import EpisodeDecision, Event
from touchdown.backend.geometry import load_pieces
from touchdown.widgets.forms import TargetForm


def join_half_commands(
    front: Callable[[], str],
    titles: Mapping[str, str],
    commands: Mapping[str, Sequence[WindowCommand]],
) -> tuple[WindowCommand, ...]:
    """Return all commands; a key that several halves use becomes one row that names them all.

    ``front`` tells the half in front; ``titles`` and ``commands`` by name of the half. A command of
    a half behind does nothing.
    """
    rows: dict[str, WindowCommand] = {}
    acts: dict[str, dict[str, Callable[[], None]]] = {}
    for half, given in commands.items():
        for command in given:
            key = portable_key(command.key) or f"{half}.{command.name}"
            text = f"{titles[half]}: {command.text}"
            known = rows.get(key)
            if known is None:
                rows[key] = replace(command, text=text, run=_run_in_front(front, acts, key))
            else:
                both = f"{known.text}; {text}"
                rows[key] = replace(known, text=both, repeats=known.repeats and command.repeats)
            acts.setdefault(key, {})[half] = command.run
    return tuple(rows.values())


def _run_in_front(
    front: Callable[[], str], acts: Mapping[str, Mapping[str, Callable[[], None]]], key: str
) -> Callable[[], None]:
    def run() -> None:
        act = acts[key].get(front())
        if act is not None:
            act()

    return run


COLLECT, LABEL = "collect", "label"
TITLES = {COLLECT: "Collect", LABEL: "Label"}
LABEL_WORDS = "Enter accepts the label and goes on, arrows move it, D rejects; F1 shows all keys."
"""The keys of the half that has no button for them."""


class CollectWorkspace(Workspace):
    """Collecting needs a bench, labelling does not; both work on the dataset that Label opens."""

    name, title, key = "collect", "Collect & Label", "Ctrl+2"
    page: HalvesPage

    def __init__(self, desk: WorkspaceContext) -> None:
        self._desk = desk
        self.label = LabelWorkspace(desk)
        self.live: LivePresenter | None = None
        self._bench: Session | None = None
        self._told_keys = False
        self._looked_at: Dataset | None = None
        """The dataset as it is looked at before anybody is named; nothing is written to it."""
        self.label.opened = self._take_dataset
        self.label.person_changed = self._show_person
        halves = {COLLECT: self._commands(), LABEL: self.label.commands}
        self.commands = (
            *join_half_commands(lambda: self.page.front, TITLES, halves),
            WindowCommand("half", "The other half: collect, or label", "F2", self._show_other_half),
            WindowCommand("half-collect", "Collect half", "Ctrl+Shift+C",
                    lambda: self.page.show_half(COLLECT)),
            WindowCommand("half-label", "Label half", "Ctrl+Shift+L",
                    lambda: self.page.show_half(LABEL)),
        )  # fmt: skip
        self.held_keys = self.label.held_keys

    def build(self) -> Iterator[None]:
        """Make both halves, and the thread that reads for them."""
        self.page = self.pieces = HalvesPage()
        self.collect_page = CollectPage(self._desk.theme)
        yield
        yield from self.collect_page.build()
        self.page.add(COLLECT, TITLES[COLLECT], self.collect_page)
        yield
        self.label.build_in(self.page)
        yield
        self.reader = SaveWorker(self.label.post, "collect-reader")
        catalogue = load_pieces()
        self.presenter = CollectPresenter(
            self.collect_page, self._desk.cards, self.reader, catalogue
        )
        self._wire()
        self.collect_page.target.show_catalogue(
            [(name, catalogue.piece(name).title) for name in catalogue.tops],
            [(name, catalogue.piece(name).title) for name in catalogue.bottoms],
        )
        self.page.tell(self._half_came)

    # -- life -------------------------------------------------------------------------------------

    def attach(self, bench: Session) -> None:
        """Show this bench."""
        self._bench, page = bench, self.collect_page
        self.live = LivePresenter(
            bench, LiveViews(page.tactile, page.captions, page.force, page.moment)
        )
        self.presenter.attach(bench)
        self.parts = (
            self.live.draw_left, self.live.draw_right, self.live.draw_wrench,
            self.live.draw_headers, self.presenter.draw, self.presenter.draw_maps,
        )  # fmt: skip

    def take(self, fact: Event) -> None:
        """Follow the runs."""
        self.presenter.take(fact)

    def show_waiting(self, word: str, why: str) -> None:
        """Say why there is no bench yet."""
        self.collect_page.show_waiting(why)

    def enter(self) -> None:
        """Open the dataset if somebody is named; label what came in meanwhile."""
        self._half_came(self.page.front)

    def leave(self) -> None:
        """Save what is being labelled; a campaign goes on unseen."""
        self.label.leave()
        self._hush_keys()

    def fit_to_theme(self) -> None:
        """Take the sizes of the theme."""
        self.collect_page.fit_to_theme()
        self.label.fit_to_theme()

    def memory(self) -> Memory:
        """Return what both halves remember."""
        note = self.presenter.origin.note
        return {
            **self.label.memory(),
            "half": self.page.front,
            "target": asdict(self.collect_page.target.form()),
            "signal": self.collect_page.signal.currentIndex(),
            "list": asdict(self.collect_page.table.arrangement),
            "origin": None if note is None else note.memory(),
        }

    def recall(self, memory: Memory) -> Sequence[str]:
        """Take what was remembered; return what makes no sense."""
        dropped = list(self.label.recall(memory))
        target, half = memory.get("target", {}), memory.get("half", COLLECT)
        if isinstance(target, Mapping):
            form, wrong = remembered_target_form(target)
            dropped += wrong
        else:
            form = TargetForm()
            dropped.append("target")
        self.collect_page.target.show_form(form)
        signal = memory.get("signal", 0)
        if type(signal) is int and 0 <= signal < self.collect_page.signal.count():
            self.collect_page.signal.setCurrentIndex(signal)
        else:
            dropped.append("signal")
        try:
            self.collect_page.table.arrange(remembered_table(memory.get("list")))
        except ValueError:
            dropped.append("list")
        try:
            self.presenter.origin.show_note(origin_note(memory.get("origin")))
        except ValueError:
            dropped.append("origin")
        if half in TITLES:
            self.page.bring(str(half))
        else:
            dropped.append("half")
        return dropped

    def close(self) -> None:
        """End the bench first: what it still records belongs into the dataset that closes here."""
        if self._bench is not None:
            self._bench.close()
            self._bench.dataset = None
        self._stop_looking()
        self.reader.close()
        self.label.close()

    # -- the dataset ------------------------------------------------------------------------------

    def _take_dataset(self, opened: OpenedDataset) -> None:
        self.presenter.take_dataset(opened.dataset, read=self.page.front == COLLECT)
        self._stop_looking()

    def _look(self) -> None:
        """Show what the dataset holds while nobody is named yet who could write to it."""
        folder = self.label.folder
        self.presenter.choose_pair()
        if self.presenter.dataset is None and (folder / DESCRIPTION).is_file():
            self.reader.submit(
                lambda: Dataset.open(folder, create=False, write=False),
                self._looking,
                _ignore_unseen,
            )

    def _looking(self, dataset: Dataset) -> None:
        if self.presenter.dataset is None:
            self._looked_at = dataset
            self.presenter.take_dataset(dataset, read=self.page.front == COLLECT)
        else:
            self.reader.submit(dataset.close, _ignore_unseen, _ignore_unseen)

    def _stop_looking(self) -> None:
        dataset, self._looked_at = self._looked_at, None
        if dataset is not None:
            # After the reads that are under way: they are on the same thread.
            self.reader.submit(dataset.close, _ignore_unseen, _ignore_unseen)

    def _show_person(self, name: str) -> None:
        self.presenter.person = name
        self.collect_page.target.person.setText(name)

    def _half_came(self, name: str) -> None:
        if name == LABEL:
            self.label.enter()
            self._desk.say(LABEL_WORDS)
            self._told_keys = True
            return
        self.label.leave()
        self._hush_keys()
        self.collect_page.setFocus()
        self.label.open()
        self._look()
        self.presenter.probes.restyle()

    def _hush_keys(self) -> None:
        """Take the keys of Label out of the foot: they mean something else elsewhere."""
        if self._told_keys:
            self._told_keys = False
            self._desk.say("")

    def _show_other_half(self) -> None:
        self.page.show_half(COLLECT if self.page.front == LABEL else LABEL)

    def _be(self, name: str) -> None:
        if name.strip() and name != self.presenter.person:
            self.label.be(name)

    # -- orders -----------------------------------------------------------------------------------

    def _wire(self) -> None:
        page, presenter = self.collect_page, self.presenter
        page.target.start_requested.connect(presenter.start)
        page.target.resume_requested.connect(presenter.go_on)
        page.target.pause_requested.connect(presenter.pause_or_resume)
        page.target.end_requested.connect(presenter.end)
        page.target.person_entered.connect(self._be)
        page.target.residual_requested.connect(presenter.take_origin)
        page.target.origin_requested.connect(presenter.set_origin_here)
        page.target.lift_requested.connect(presenter.lift)
        page.target.pair_chosen.connect(presenter.choose_pair)
        page.decided.connect(self._decide)
        page.dot_chosen.connect(presenter.probes.choose_dot)
        page.row_chosen.connect(presenter.probes.choose)
        page.filter_changed.connect(presenter.probes.restyle)

    def _decide(self, name: str) -> None:
        decisions: dict[str, EpisodeDecision] = {
            "keep": "keep", "discard": "discard", "flag": "flag", "redo": "redo", "skip": "skip",
        }  # fmt: skip
        self.presenter.decide(decisions[name])

    def _commands(self) -> tuple[WindowCommand, ...]:
        return (
            self._act("start", "Start, or keep and next", "F5", lambda p: p.start()),
            self._act("go-on", "Continue the last campaign", "Shift+F5", lambda p: p.go_on()),
            self._act("pause", "Pause or resume", "P", lambda p: p.pause_or_resume()),
            self._act("keep", "Keep the probe", "Return", lambda p: p.decide("keep")),
            self._act("discard-probe", "Discard the probe", "Backspace",
                      lambda p: p.decide("discard")),
            self._act("flag-probe", "Flag the probe", "X", lambda p: p.decide("flag")),
            self._act("again", "Redo the probe", "R", lambda p: p.decide("redo")),
            self._act("leave-out", "Skip: leave its place out", "S", lambda p: p.decide("skip")),
            WindowCommand("person", "Say who collects", "Ctrl+U",
                    lambda: self.collect_page.target.ask_person()),
            WindowCommand("columns", "Choose the columns of the episodes", "",
                    lambda: self.collect_page.table.choose_columns()),
            WindowCommand("sort", "Sort the episodes by the next column", "",
                    lambda: self.collect_page.table.sort_by_next()),
            WindowCommand("fit", "Fit the force and moment ranges", "Ctrl+F",
                    lambda: self.collect_page.fit()),
        )  # fmt: skip

    def _act(
        self, name: str, text: str, key: str, act: Callable[[CollectPresenter], None]
    ) -> WindowCommand:
        return WindowCommand(name, text, key, lambda: act(self.presenter))


def _ignore_unseen(_: object) -> None:
    """Do nothing: whoever opens the dataset to write to it is told what is wrong with it."""

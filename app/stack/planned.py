"""Runs in a row: a list of planned runs, started one after the other."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

from PySide6.QtCore import QSignalBlocker, QTimer

from touchdown.app.shell import (
    BenchSheet,
    ask_path,
    carry_out,
    is_run_active,
    restore_form,
    tower_text,
)
from touchdown.app.stack.page import StackPage
from touchdown.app.stack.presenter import stack_request
from touchdown.backend import core
from touchdown.backend.bench import Session
from touchdown.backend.config import read_toml
from touchdown.backend.runs import StackRequest
from touchdown.widgets.base import KeylessList, count_noun, hbox, label, push_button, tr, vbox
from touchdown.widgets.forms import STRATEGIES, RunForm, RunPanel
from touchdown.widgets.shell import CardQuestion, FaultCards

LOOK_MS = 100  # a row looks this often whether its run has ended
FIX = "Each run is a table [[run]] with keys such as piece, bottom, seed and trials."


@dataclass(frozen=True, slots=True)
class PlannedRun(RunForm):
    """One run of the list; ``result`` is empty until it ended."""

    result: str = ""

    def text(self, number: int, state: str) -> str:
        """Return the run as two lines of a list."""
        tower = tower_text(*filter(None, (self.piece, self.bottom, self.under)))
        strategy = tr(dict(STRATEGIES).get(self.strategy, self.strategy))
        what = tr("{}, seed {}, {}", count_noun(self.trials, "trial"), self.seed, strategy)
        return f"{number}. {tower}: {self.result or state}\n{what}"


def read_planned_runs(path: Path, panel: RunPanel) -> list[PlannedRun]:
    """Return the runs of a TOML file. Keys that are missing are those of the form on ``panel``.

    Raises ``InputError`` for entries that this form cannot hold.
    """
    try:
        tables = list(json.loads(json.dumps(read_toml(path)["run"], default=str)))
    except (ValueError, KeyError, TypeError) as error:
        raise core.InputError(tr("No [[run]] can be read: {}.", error), str(path), FIX) from error
    usual, runs = panel.form(), list[PlannedRun]()
    for number, table in enumerate(tables, start=1):
        values = table if isinstance(table, dict) else {str(table): ""}
        run, wrong = restore_form(PlannedRun(**asdict(usual)), values)
        wrong += sorted(set(values) - set(asdict(run)))
        with QSignalBlocker(panel):
            panel.show_form(run)
            held = asdict(panel.form())
            panel.show_form(usual)
        wrong += [name for name, value in held.items() if value != getattr(run, name)]
        if wrong:
            what = tr("Run {} has wrong entries: {}.", number, ", ".join(wrong))
            raise core.InputError(what, str(path), FIX)
        runs.append(replace(run, result=""))
    return runs


class PlannedRunsSheet(BenchSheet):
    """Keeps the list and starts its runs; on devices a person starts each of them.

    ``begin`` starts a run like the button of the page, with all its questions; ``remember`` stores
    the list; ``offer`` shows what a row gave.
    """

    def __init__(
        self, bench: Session, page: StackPage, cards: FaultCards,
        begin: Callable[[StackRequest], bool], remember: Callable[[], object],
        offer: Callable[[str], None],
    ) -> None:  # fmt: skip
        super().__init__(page.window(), "Runs in a row")
        self._bench, self._page, self._cards, self._begin = bench, page, cards, begin
        self._remember, self._offer = remember, offer
        self.runs: list[PlannedRun] = []
        self.on = False  # further runs follow
        self._now: PlannedRun | None = None
        self._ended: core.RunFinished | None = None
        self._outcomes: list[core.Outcome] = []
        self._asked: CardQuestion | None = None
        self._timer = QTimer(self, interval=LOOK_MS)
        self._timer.timeout.connect(self.look)
        self.list = KeylessList("Planned runs", "Add the run of the form, or read a file.")
        self.said = label("", "muted", wrap=True)
        names = f"{tr('Planned runs')} (*.toml)"
        ask_file = partial(ask_path, self, "Planned runs", self.add_file, names=names)
        orders: dict[str, tuple[str, Callable[[], None]]] = {
            "Add the form": ("Add the run of the form on the page", self.add_form),
            "From a file": ("Add the runs of a TOML file, a table [[run]] each", ask_file),
            "Up": ("Move the selected run up", partial(self._move, -1)),
            "Down": ("Move the selected run down", partial(self._move, 1)),
            "Remove": ("Remove the selected run", self._remove),
            "Start": ("Start the next run; the others follow", self.start),
            "Hold": ("Start no further run", self.hold),
        }
        self.buttons = {name: push_button(name, tip) for name, (tip, _) in orders.items()}
        for name, (_, act) in orders.items():
            self.buttons[name].clicked.connect(lambda _=False, act=act: act())
        *column, start, hold = self.buttons.values()
        start.setProperty("role", "primary")
        rows = hbox((self.list, 1), vbox(*column, 1), spacing=12)
        self.arrange((rows, 1), self.said, foot=(start, hold), spacing=10)
        self.resize_to_em(38, 22)
        self.list.currentRowChanged.connect(self._show_buttons)
        self._show_buttons()

    def add_form(self) -> None:
        """Add the run of the form."""
        self.change([*self.runs, PlannedRun(**asdict(self._page.run.form()))], len(self.runs))

    def add_file(self, path: Path) -> None:
        """Add the runs of a file; show a card if one of them is wrong."""
        panel, runs, more = self._page.run, self.runs, list[PlannedRun]()
        if carry_out(lambda: more.extend(read_planned_runs(path, panel)), self._cards):
            self.change(runs + more, len(runs))

    def _move(self, by: int) -> None:
        at, runs = self.list.currentRow(), list(self.runs)
        runs.insert(at + by, runs.pop(at))
        self.change(runs, at + by)

    def _remove(self) -> None:
        at = self.list.currentRow()
        self.change([*self.runs[:at], *self.runs[at + 1 :]], at)

    def change(self, runs: list[PlannedRun], at: int) -> None:
        """Replace the list and store it at once; ``at`` is the selected run."""
        self.runs = runs
        self._remember()
        self.list.clear()
        for number, run in enumerate(runs, start=1):
            state = tr("running" if run is self._now else "planned")
            self.list.addItem(run.text(number, state))
        self.list.setCurrentRow(min(at, len(runs) - 1))
        self._show_buttons()

    def _show_buttons(self, _row: int = 0) -> None:
        at, last = self.list.currentRow(), len(self.runs) - 1
        possible = {
            "Up": at > 0, "Down": 0 <= at < last, "Hold": self.on,
            "Remove": at >= 0 and self.runs[at] is not self._now,
            "Start": bool(self.runs) and self._now is None,
        }  # fmt: skip
        for name, on in possible.items():
            self.buttons[name].setEnabled(on)

    def _say(self, text: str) -> None:
        self.said.setText(tr(text))
        self.change(self.runs, max(self.list.currentRow(), 0))

    def start(self) -> None:
        """Start the next run; the others follow. A finished list starts again."""
        if not self.runs or is_run_active(self._bench):
            return
        if all(run.result for run in self.runs):
            self.runs = [replace(run, result="") for run in self.runs]
        if self._asked is not None and self._cards.asks is self._asked:
            self._cards.withdraw()
        run = next(run for run in self.runs if not run.result)
        self._outcomes, self._ended = [], None
        self.on = self._begin(stack_request(run))
        self._now = run if self.on else None
        self._timer.start()
        self._say("" if self.on else "The run was refused: the row is held.")

    def hold(self, why: str = "The row is held.") -> None:
        """Start no further run."""
        self.on = False
        self._say(why)

    def take(self, event: core.Event) -> None:
        """Follow the present run."""
        if isinstance(event, core.TrialFinished):
            self._outcomes.append(event.outcome)
        elif isinstance(event, core.RunFinished) and event.run_id == self._bench.run_id:
            self._ended = event

    def look(self) -> None:
        """Go on once the run has ended and the bench is idle; end the row after a stop."""
        if self._now is not None and self._ended is not None and not is_run_active(self._bench):
            self._go_on(self._now, self._ended.ending)
        elif self.on and self._now is None and self._bench.interlock.latched:
            self.hold("STOP ended the row.")
        if not self.on and self._now is None:
            self._timer.stop()

    def _go_on(self, run: PlannedRun, ending: str) -> None:
        placed = self._outcomes.count(core.Outcome.PLACED)
        result = tr("{} of {} placed", placed, count_noun(len(self._outcomes), "trial"))
        if ending != "finished":
            self.on, result = False, f"{result}, {tr(ending)}"
        self.runs = [replace(r, result=result) if r is run else r for r in self.runs]
        self._now = None
        left = [run for run in self.runs if not run.result]
        runs = count_noun(len(self.runs), "planned run")
        done = tr("{} of {} done", len(self.runs) - len(left), runs)
        if not self.on or not left:
            self.hold(f"{done}.")
            self._offer(tr("{}; the last one: {}.", done, result))
        elif not self._bench.simulated:
            waits = "{}. {} on {} waits: start it when all is ready."
            text = tr(waits, done, left[0].piece, left[0].bottom)
            self._asked = CardQuestion(text, (("Hold the row", self.hold), ("Start", self.start)))
            self._cards.ask(self._asked)
            self._say(text)
        else:
            self.start()

"""Render every workspace and important state as PNG for inspection (``make screens``).

The window runs on the stand-in bench and a small generated dataset. No data of this computer are
used.
"""

import argparse
import collections
import json
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

from PySide6.QtCore import QBuffer, QDeadlineTimer, QEventLoop
from PySide6.QtGui import QPainter
from PySide6.QtWidgets import QApplication

from tests import screen_check, screen_panels, screen_states
from tests.app.stand_in import StandInBench
from tests.picture_files import PictureFiles, run_reporting
from touchdown.app.application import TouchdownApp
from touchdown.app.shell.errors import ErrorBox
from touchdown.backend.annotations import AnswerContext, Dataset, Label
from touchdown.backend.bench import SimulatedBenchChoice, simulated_session
from touchdown.backend.config import SimulationSettings
from touchdown.backend.core import (
    ActionChosen,
    CampaignBegan,
    Event,
    PatchEstimated,
    PhaseEntered,
    RunFinished,
    RunStarted,
    Said,
    TrialFinished,
)
from touchdown.backend.learning import load_card
from touchdown.backend.placement import shipped_model
from touchdown.backend.runs import (
    CollectRequest,
    RecordingOptions,
    RunState,
    SceneChoice,
    StackRequest,
)
from touchdown.widgets.base import count_noun
from touchdown.widgets.forms import RunForm
from touchdown.widgets.shell.fault_cards import CardQuestion, CardText

SIZES = ((1280, 720), (1600, 940))
THEMES = ("dark", "light", "contrast")
# Of the recorded run and campaign. On bench-v2 the first trial of this seed is placed, and in the
# second the piece falls.
SEED, TRIALS, PROBES, CAMPAIGN_SEED = 3, 2, 8, 1
AIR_S = 10.0  # clears the traces of earlier presses
LIFTED_MM = 3.0  # height of the face between the probes of a run
Told = TypeVar("Told", bound=Event)


def main(argv: list[str]) -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.screens", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("output/screens"))
    parser.add_argument("--themes", nargs="*", default=list(THEMES), choices=THEMES)
    parser.add_argument("--sizes", nargs="*", default=[f"{w}x{h}" for w, h in SIZES])
    parser.add_argument("--scale", default="1", help="device pixels per pixel: 1, 1.25, 1.5, 2")
    parser.add_argument("--only", nargs="*", default=[""], help="states whose name begins so")
    parser.add_argument("--check", action="store_true", help="check all sizes and scales instead")
    parser.add_argument("--pseudo", action="store_true",
                        help="use accented texts, 30 %% longer; list others")  # fmt: skip
    parser.add_argument("--texts", type=Path, metavar="FILE.ts",
                        help="write the texts of the window for Qt Linguist instead")  # fmt: skip
    args = parser.parse_args(argv)
    if args.texts is not None:
        screen_check.write_texts(args.texts)
        return 0
    return run_reporting(lambda: _render_in_a_folder(args))


def _render_in_a_folder(args: argparse.Namespace) -> int:
    sizes = [f"{theme}-{size}" for theme in args.themes for size in args.sizes]
    files = {name: PictureFiles(args.out / name) for name in sizes}
    os.environ["QT_SCALE_FACTOR"] = args.scale
    with tempfile.TemporaryDirectory() as folder:
        for name in ("TOUCHDOWN_DATA", "TOUCHDOWN_CONFIG"):
            os.environ[name] = folder
        if os.environ["QT_QPA_PLATFORM"] == "offscreen":
            _use_large_screen(Path(folder) / "screen.json")
        return (_check if args.check else _render)(args, Path(folder), files)


def _use_large_screen(file: Path) -> None:
    """Simulate a desktop screen; that of the offscreen platform is 800 px wide."""
    screen = {"name": "desk", "x": 0, "y": 0, "width": 1920, "height": 1200,
              "logicalDpi": 96, "dpr": 1}  # fmt: skip
    file.write_text(json.dumps({"screens": [screen]}), encoding="utf-8")
    os.environ["QT_QPA_PLATFORM"] = f"offscreen:configfile={file}"


def _make_application(args: argparse.Namespace) -> QApplication:
    """Return the application, with the pseudo-locale if asked for."""
    application = QApplication([])
    if args.pseudo:
        application.installTranslator(screen_check.PseudoTranslator(application))
    return application


def _list_untranslated(found: dict[str, str]) -> bool:
    """Print texts that stayed English in the pseudo-locale; return True if there are any."""
    for text, name in sorted(found.items()):
        sys.stdout.write(f"not translated: {' '.join(text.split())} ({name})\n")
    return bool(found)


def _render(args: argparse.Namespace, folder: Path, files: dict[str, PictureFiles]) -> int:
    application, plain = _make_application(args), dict[str, str]()
    recorded = RecordedBench(folder)
    screen_panels.train_models(folder / "packs")
    count = 0
    for theme in args.themes:
        for size in args.sizes:
            width, height = (int(part) for part in size.split("x"))
            stage = Stage(application, folder / f"{theme}-{size}", theme, recorded)
            stage.main.window.resize(width, height)
            for name in stage.states():
                if name.startswith(tuple(args.only)):
                    stage.settle()
                    files[f"{theme}-{size}"].keep(f"{name}.png", stage.grab())
                    files[f"{theme}-{size}"].put()
                    count += 1
                    if args.pseudo:
                        plain |= screen_check.untranslated(name)
            stage.close()
    sys.stdout.write(f"{count} pictures in {args.out}\n")
    return int(_list_untranslated(plain))


def _check(args: argparse.Namespace, folder: Path, _files: dict[str, PictureFiles]) -> int:
    """Print the failures of each theme and state at each size and scale, and their count.

    One line names a failure, the number of views that show it, and the first of them.
    """
    application, views, plain = _make_application(args), 0, dict[str, str]()
    recorded = RecordedBench(folder)
    screen_panels.train_models(folder / "packs")
    found = collections.defaultdict[str, list[str]](list)
    for theme in args.themes:
        stage = Stage(application, folder / theme, theme, recorded)
        for state in stage.states():
            # Larger and smaller text is an axis of its own.
            if state.startswith("text-") or not state.startswith(tuple(args.only)):
                continue
            if args.pseudo:
                plain |= screen_check.untranslated(state)
            for name, size, whole in screen_check.logical_sizes():
                for line in screen_check.view_failures(stage.main.window, size, whole=whole):
                    found[re.sub(r"\d+(x\d+)? (of \d+ )?px", "px", line)].append(
                        f"{theme} {name} {state}: {line}"
                    )
                views += 1
            stage.main.window.resize(*screen_check.STARTS)
            stage.settle()
        stage.close()
    for _, places in sorted(found.items()):
        sys.stdout.write(f"{places[0]} ({count_noun(len(places), 'view')})\n")
    sys.stdout.write(f"{count_noun(len(found), 'failure')} in {views} views\n")
    return int(_list_untranslated(plain) or bool(found))


class RecordedBench:
    """A stacking run and a campaign of the simulated bench, which the stand-in bench repeats."""

    def __init__(self, folder: Path) -> None:
        self._begin("bench-v2", RecordingOptions(folder / "recorded"))
        self._events: list[Event] = []
        self.contact_z_mm = float("nan")
        self.session.events.subscribe(self._take)
        self._run(StackRequest(seed=SEED, trials=TRIALS))
        (self.run_folder,) = (folder / "recorded").iterdir()
        self.stacking = tuple(self._events)
        self.session.close()
        self._begin("mixed", None)
        with Dataset.open(folder / "dataset", person="setup") as dataset:
            self.session.dataset = dataset
            self._run(
                CollectRequest(seed=CAMPAIGN_SEED, count=PROBES, person="setup", probes_per_grip=4)
            )
            self.session.dataset = None
            for number, entry in enumerate(dataset.episodes()):
                label = dataset.labels.head(entry.uuid).label
                for person, by_um in (("Ann", 180), ("Bo", -120)):
                    x_um, y_um = label.x_um + by_um * (number % 3), label.y_um - by_um
                    said = Label(x_um, y_um, 0, 300)
                    context = AnswerContext(5200 + 90 * number)
                    dataset.labels.opinion(person, entry.uuid, said, context=context)
        self.session.close()

    def _begin(self, preset: str, keep: RecordingOptions | None) -> None:
        choice = SimulatedBenchChoice(given=SimulationSettings(preset=preset))
        self.session = simulated_session(choice, keep=keep)
        self.session.prepare(SceneChoice())

    def _take(self, event: Event) -> None:
        self._events.append(event)
        lifts = isinstance(event, PhaseEntered) and event.phase == "lift"
        if lifts and math.isnan(self.contact_z_mm):
            self.contact_z_mm = self.session.devices["arm"].pose(float("inf")).z_mm

    def _run(self, request: StackRequest | CollectRequest) -> None:
        self.session.start(request)
        self.session.engine.tick()
        while self.session.status().state is not RunState.IDLE:
            self.session.advance()
            self.session.engine.tick()


class Repeated:
    """The recorded stacking run, told by the stand-in bench at its own time."""

    def __init__(self, bench: StandInBench, recorded: RecordedBench) -> None:
        self._bench, self._coming = bench, collections.deque(recorded.stacking)
        bench.clear_mm = LIFTED_MM

    def until(self, kind: type[Told], **values: object) -> Told:
        """Tell all events up to the next one of ``kind`` with these values; return it."""
        while True:
            event = self._coming.popleft()
            self._bench.events.publish(replace(event, t_s=self._bench.clock_s()))
            if isinstance(event, PhaseEntered):
                patches = (one for one in self._coming if isinstance(one, PatchEstimated))
                self._bench.at_mm = next((one.offset_mm for one in patches), self._bench.at_mm)
            if isinstance(event, kind) and all(getattr(event, k) == v for k, v in values.items()):
                return event


class Stage:
    """One window and the sequence of its states."""

    def __init__(
        self, application: QApplication, folder: Path, theme: str, recorded: RecordedBench
    ) -> None:
        folder.mkdir()
        self.folder, self.recorded = folder, recorded
        self._application, self.bench = application, StandInBench()
        self.bench.model = load_card(shipped_model("pot"))
        self.bench.contact_z_mm, self.bench.clear_mm = recorded.contact_z_mm, screen_panels.CLEAR_MM
        self.main = TouchdownApp(application, ErrorBox(), folder / "window.json", folder / "runs")
        self.main.look.show(theme, 1.0)
        self.main.window.show()

    def repeated(self) -> Repeated:
        return Repeated(self.bench, self.recorded)

    def settle(self) -> None:
        for _ in range(20):
            self.main.pump.tick()
            QApplication.processEvents()
        commits = self.main.workspaces["collect"].label.worker
        until = QDeadlineTimer(3000)
        while commits is not None and commits.busy and not until.hasExpired():
            QApplication.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
            self.main.pump.tick()

    def until(self, there: Callable[[], bool]) -> None:
        """Run pump and event loop until ``there`` returns True, 2 min at most."""
        until = QDeadlineTimer(120_000)
        while not there() and not until.hasExpired():
            QApplication.processEvents(QEventLoop.ProcessEventsFlag.WaitForMoreEvents, 20)
            self.main.pump.tick()
        self.settle()

    def grab(self) -> bytes:
        window = self.main.window
        picture = window.grab()
        painter = QPainter(picture)
        for top in QApplication.topLevelWidgets():
            if top is not window and top.isVisible():
                corner = top.mapToGlobal(top.rect().topLeft())
                painter.drawPixmap(corner - window.mapToGlobal(window.rect().topLeft()), top.grab())
        painter.end()
        png = QBuffer()
        picture.save(png, "PNG")  # type: ignore[call-overload]
        return bytes(png.data().data())

    def close(self) -> None:
        self.main.quit_at_once()
        self.main.close()
        self.main.window.deleteLater()
        self.main.deleteLater()

    def states(self) -> Iterator[str]:
        yield from self._without_a_bench()
        self.main.attach(self.bench)
        # Judge the age of data by the bench clock: rendering takes long.
        live = [getattr(ws, "live", None) for ws in self.main.workspaces.values()]
        hand = self.main.workspaces["operate"].hand
        for follower in (self.main._chips, hand, *filter(None, live)):
            follower._now_s = self.bench.clock_s
        yield from self._operate()
        yield from screen_panels.by_hand(self)
        yield from screen_states.of_the_pill(self)
        yield from self._collect_and_label()
        yield from self._train_and_review()
        yield from screen_panels.reviewed(self, self.folder / "runs")
        yield from screen_panels.trained(self, self.folder.parent / "packs")
        yield from self._stack()
        yield from screen_states.of_a_run(self)
        yield from screen_panels.attended(self)
        yield from self._faults()
        yield from screen_states.of_faults(self)
        yield from screen_panels.pauses(self)
        yield from self._dialogs()
        yield from screen_panels.sheets(self, self.folder)
        yield from self._large_text()

    def _without_a_bench(self) -> Iterator[str]:
        for name in ("connecting-operate", "connecting-stack"):
            self.main.go(name.removeprefix("connecting-"))
            yield name
        self.main._connect_failed(RuntimeError("the model of the pot is missing"))
        yield "no-bench"
        self.main.cards.clear(self.main.cards.codes)

    def _operate(self) -> Iterator[str]:
        main, page = self.main, self.main.workspaces["operate"].page
        self.bench.hand = screen_panels.Hand(self.bench)
        main.go("operate")
        self.live(0.0)
        yield "operate-air"
        self.live(1.0)
        for look in range(page.looks.count()):
            page.looks.setCurrentIndex(look)
            yield f"operate-contact-look-{look}"
        page.looks.setCurrentIndex(0)
        self.bench._now_us += 1_200_000
        yield "operate-stale"
        self.live(1.0)

    def _collect_and_label(self) -> Iterator[str]:
        main, collect = self.main, self.main.workspaces["collect"]
        main.go("collect")
        self.live(0.0)
        yield "collect-nobody"
        collect.label.be("Ann")
        self.settle()
        yield "collect"
        bench = self.bench
        bench.events.publish(RunStarted(bench.clock_s(), "run", "pot", "circle15", "collect", 0, 20,
                                        True, "{}", activity="collect"))  # fmt: skip
        bench.events.publish(CampaignBegan(bench.clock_s(), "campaign", "series", "", 0, 20))
        bench.set_state(RunState.RUNNING, trial=1, trials=20, probe=1, phase="press")
        self.live(1.0)
        yield "collect-running"
        bench.events.publish(RunFinished(bench.clock_s(), "run", "cancelled",
                                         "cancelled by the operator"))  # fmt: skip
        bench.set_state(RunState.IDLE, trial=0, trials=0, probe=0, phase="")
        self.live(0.0)
        main.say("")  # nobody has cancelled a run in the states that follow
        collect.page.show_half("label")
        self.until(lambda: collect.label.presenter.present is not None)
        yield "label"
        yield from screen_panels.beside_the_queue(self)
        collect.page.show_half("collect")
        yield from screen_panels.imported(self)

    def _train_and_review(self) -> Iterator[str]:
        for page in ("train", "review"):
            self.main.go(page)
            yield page

    def _stack(self) -> Iterator[str]:
        main, bench, run = self.main, self.bench, self.repeated()
        main.go("stack")
        form, panel = RunForm(seed=SEED, trials=TRIALS), main.workspaces["stack"].page.run
        panel.show_form(form)
        bench.press = 0.0
        bench.turn(AIR_S)
        self.live(0.0)
        yield "stack-ready"
        run.until(PhaseEntered, phase="press")
        bench.set_state(RunState.RUNNING, trial=1, trials=TRIALS, probe=1, phase="press")
        self.live(1.0)
        yield "stack-first-press"
        waits = run.until(ActionChosen, probe=2).action
        run.until(Said)
        self.live(0.0)
        bench.set_state(RunState.RUNNING, awaiting=waits, probe=2, phase="lift")
        panel.show_form(replace(form, mode="approve"))  # "auto" asks before no shift
        self.live(0.0)
        yield "stack-your-turn"
        panel.show_form(form)
        probes = run.until(TrialFinished).probes
        bench.set_state(RunState.RUNNING, awaiting=None, phase="rise", probe=probes)
        self.live(0.0)
        yield "stack-placed"
        run.until(RunFinished)
        bench.set_state(RunState.IDLE, trial=0, probe=0, phase="")
        yield "stack-fell"
        main.actions.action("stack.compare").trigger()
        yield "stack-comparison"
        main.workspaces["stack"].comparison.sheet.close()

    def _faults(self) -> Iterator[str]:
        main, bench = self.main, self.bench
        for what in (
            "A folder was torn; its complete chunks were copied.",
            "The disk is nearly full.",
        ):
            main.cards.show_card(CardText("DATASET", what, "", "", reset=False, notice=True))
        yield "notices"
        main.cards.clear(main.cards.codes)
        bench.tell_fault()
        yield "fault"
        main.stop()
        yield "stopped-and-fault"
        main.cards.card("STOPPED").more.click()
        yield "cards-unfolded"
        main.cards.fold()
        yield "cards-folded"
        main.reset()
        answers = (("Keep holding", list), ("Open and let it go", list))
        main.cards.ask(CardQuestion("A piece is held. Opening lets it go.", answers))
        yield "question"
        main.cards.withdraw()

    def _dialogs(self) -> Iterator[str]:
        main, bar = self.main, self.main.bar
        for action, sheet in (("palette", "palette"), ("keys", "sheet")):
            main.actions.action(action).trigger()
            yield f"dialog-{action}"
            getattr(main.dialogs, sheet).close()
        bar.chips["force_torque"].clicked.emit()
        yield "dialog-inspector"
        main.inspect.sheet.close()
        main.layouts.toggle_lock()
        main.actions.action("layouts").trigger()
        yield "layouts-unlocked"
        main.layout_menu.menu.close()
        main.layouts.turn_panel("stack", "Force and moment")
        yield "stack-without-traces"
        main.layouts.reset("stack")
        main.layouts.toggle_lock()
        main.say("")
        main.actions.action("save-layout").trigger()
        yield "dialog-name"
        main.layout_menu.asker.close()
        main.tour.begin()
        for stop in (0, 3, 7):
            while main.tour.at < stop:
                main.tour.turn(1)
            self.settle()
            main.tour.fit()
            yield f"tour-{stop}"
        main.stop()
        self.settle()
        yield "tour-and-stopped"
        main.reset()
        main.tour.end()

    def _large_text(self) -> Iterator[str]:
        main = self.main
        for percent in (200, 80):
            main.look.show(main.look.choice, percent / 100)
            for page in main.workspaces:
                main.go(page)
                self.live(1.0)
                yield f"text-{percent}-{page}"
            yield from screen_panels.in_large_text(self, percent)
        main.look.show(main.look.choice, 1.0)

    def live(self, press: float) -> None:
        """Advance two seconds at this share of the press."""
        self.bench.press = press
        for _ in range(10):
            self.bench.turn(0.2)
            self.main.pump.tick()
        self.settle()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

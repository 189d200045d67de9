"""The application: window, bench and workspaces of one run of the program."""

from __future__ import annotations

import contextlib
import ctypes
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

from PySide6.QtCore import QObject
from PySide6.QtGui import QIcon
from PySide6.QtWidgets import QApplication

from touchdown.app import shell
from touchdown.app.connect import BenchDialogs
from touchdown.app.tour import Tour, tour_stops
from touchdown.app.workspaces import FIRST, Workspaces
from touchdown.backend import core
from touchdown.backend.bench import Session
from touchdown.backend.calibration import CalibrationName
from touchdown.backend.config import is_lab_file, load_lab
from touchdown.widgets.base import EventPump, load_resources, tr
from touchdown.widgets.shell import STOPPED, CardQuestion, CardText, FaultCards, PillState, TopBar

NOTHING_CONNECTED = "Nothing is connected; recorded runs can still be reviewed."
TRY_AGAIN = "Correct this and try again (Ctrl+L), or open another bench file (Ctrl+Shift+B)."


def bench_failed_card(error: Exception, file: Path | None, again: Callable[[], None]) -> CardText:
    """Return the card of a bench of ``file`` that could not be built; ``again`` builds it."""
    cause = shell.error_card("CONNECT", error)
    named = file is None or str(file) in cause.consequence
    texts = "" if named else tr("Bench file: {}.", file), cause.consequence, tr(NOTHING_CONNECTED)
    return replace(
        cause,
        what=tr("The bench could not be prepared: {}", cause.what),
        consequence=" ".join(filter(None, texts)),
        next_step=f"{cause.next_step} {tr(TRY_AGAIN)}".strip(),
        details="".join(traceback.format_exception(error)),
        offer=("Try again", again),
    )


def call_glibc(name: str, *values: int) -> None:
    """Call a function of glibc by name; do nothing where there is another library."""
    with contextlib.suppress(OSError, AttributeError):
        getattr(ctypes.CDLL(None), name)(*values)


MOST_PARTS = 8  # maximum number of parts in which a page is drawn


class TouchdownApp(QObject):
    """Owns window, workspaces and pump. The bench is built on a thread and attached later."""

    bench: Session | None = None
    # Bench file with which the program starts again, once the window is closed.
    next_bench: Path | None = None
    _asked_unsaved = False
    # Set with the bench.
    panels: BenchDialogs
    inspect: shell.DeviceInspectorPresenter
    _chips: shell.DeviceChipsPresenter
    _servo: shell.ServoSwitch
    _holds: Callable[[], bool] | None = None
    _make: Callable[[], Session] | None = None
    _bench_file: Path | None = None

    def __init__(
        self,
        application: QApplication,
        box: shell.ErrorBox,
        settings_file: Path,
        runs: Path,
        notifier: core.CommandNotifier | None = None,
    ) -> None:
        super().__init__()
        self._application, self._box, self._settings_file = application, box, settings_file
        settings, warning = shell.load_settings(settings_file)
        self._geometry = settings.geometry
        load_resources()
        application.setWindowIcon(QIcon("icons:touchdown.svg"))
        self.look = shell.Appearance(application, settings.theme, settings.scale, self)
        self.theme = self.look.theme
        self.cards = FaultCards(self.reset)
        self.bar = TopBar(self.theme, self.stop)
        self._speed = shell.SpeedOverride(self.bar, self.say)
        context = shell.WorkspaceContext(
            self.theme, self.cards, runs, self.say, self.go, self._show_keys, self.remember,
            lambda text, step, act: self.window.next_step.ask(text, "Dismiss", step, act),
        )  # fmt: skip
        self.workspaces = Workspaces(context, settings.pages, self._place, self._warn)
        self.window = shell.MainWindow(self.theme, self.bar, self.cards, self.workspaces.all)
        self.window.may_close = self._may_close
        self.calls = shell.PersonCalls(self.window, settings.calls, notifier)
        self._closing = shell.CloseConfirmation(self.cards, self.stop, self.window.close)
        self._loader, self._mailbox = shell.SaveWorker(self, "connect"), core.EventQueue()
        self.actions = shell.ActionRegistry(
            self.window, shell.key_bindings(self._commands(), self.workspaces.all), settings.keys
        )
        self.dialogs = shell.CommandDialogs(self.window, self.actions, self.go, self.remember)
        self.layouts = shell.LayoutsPresenter(
            settings_file.with_name("layouts.json"),
            self.say,
            partial(self._disk_refused, "saving the layouts"),
        )
        self.layout_menu = shell.LayoutMenu(
            self.window, self.layouts, lambda: self.window.front, self.actions.action("layout")
        )
        self.toured, self.tour_due = settings.toured, False
        stops = partial(tour_stops, self.window, self.bar, self.workspaces)
        self.tour = Tour(self.theme, self.window, self.cards, stops, self.go, self._tour_ended)
        for name, button in self.window.rail.items():
            action = self.actions.action(name)
            button.setToolTip(f"{action.text()} ({action.shortcut().toString()})")
            button.clicked.connect(action.trigger)
        warning = f"{warning} {shell.ignored_words(self.actions.refused)}".strip()
        self._warn(warning, self.layouts.load(tuple(self.workspaces)))
        front = settings.front if settings.front in self.workspaces else FIRST
        # Building a page takes twice as long with a style sheet.
        self.workspaces[front]
        self.look.refit = self._refit
        self.look.dress(self.window)
        self.pump = EventPump(self, self._pull, hold=self._hushed, hidden=self._unseen)
        self.pump.calm = self._calm
        self._add_parts()
        self._stop_key = shell.StopKeyFilter(
            self, self.stop, lambda: self.bench is not None and shell.may_be_moving(self.bench)
        )
        application.installEventFilter(self._stop_key)
        self._show_connecting()
        self.go(front)

    # -- life -------------------------------------------------------------------------------------

    def connect_bench(self, make: Callable[[], Session], file: Path | None = None) -> None:
        """Build the bench of ``file`` on a separate thread; the window stays responsive."""
        self._make, self._bench_file = make, file
        self._show_connecting()
        if not self._loader.busy:
            self._loader.submit(make, self.attach, self._connect_failed)

    def attach(self, bench: Session) -> None:
        """Connect the window to a bench."""
        self.bench = bench
        bench.events.subscribe(self._mailbox)
        self._chips = shell.DeviceChipsPresenter(bench, self.bar)
        self.inspect = shell.DeviceInspectorPresenter(bench, self.bar, self.window)
        self.workspaces.attach(bench)
        self.window.show_bench(shell.bench_caption(bench))
        self.panels = BenchDialogs(bench, self.theme, self.window, self.cards, self.open_bench)
        self.panels.open_connect()
        self._speed.attach(bench)
        self._servo = shell.ServoSwitch(bench, self.bar, self.cards)
        bench.open()
        # No tour if the user has gone to another page meanwhile.
        fresh = self.tour_due and not self.toured and self.window.front == FIRST
        if fresh and bench.simulated:
            # Stored first, so that a crash during the tour does not repeat it.
            self.toured = True
            self.remember()
            self.tour.begin()

    def start(self) -> None:
        """Show the window and start the pump."""
        if self._geometry is not None:
            self.window.setGeometry(*self._geometry)
        self._pull_back()
        self.window.show()
        self.pump.start()
        self.workspaces.make_ahead(self, self._hushed)

    def close(self) -> None:
        """Save the settings and close the bench. May be called twice."""
        self.pump.stop()
        self._loader.close(0.0)
        self._application.removeEventFilter(self._stop_key)
        self.remember()
        self.layouts.remember()
        bench, self.bench = self.bench, None
        self.workspaces.close()
        if bench is not None:
            bench.close()

    def remember(self) -> bool:
        """Write the present settings; show a card and return False if the disk refuses."""
        area = self.window.normalGeometry()
        settings = shell.WindowSettings(
            theme=self.look.choice,
            scale=self.theme.scale,
            geometry=(area.x(), area.y(), area.width(), area.height()),
            front=self.window.front,
            keys=self.actions.changed,
            toured=self.toured,
            calls=self.calls.on,
            pages=self.workspaces.memory(),
        )
        try:
            shell.save_settings(self._settings_file, settings)
        except OSError as error:
            self._disk_refused("saving the window settings", error)
            return False
        return True

    def _disk_refused(self, doing: str, error: OSError) -> None:
        self._box.exception(OSError, error, None, doing)

    def warn_unwritable(self, folder: Path) -> None:
        """Tell that nothing can be kept in the data folder."""
        self.cards.show_card(
            CardText(
                "DATA-FOLDER",
                tr("The data folder {} cannot be written.", folder),
                "Runs, labels and the log of this session are not kept.",
                "Make room or make it writable, or start again with TOUCHDOWN_DATA set to another "
                "folder.",
                reset=False,
            )
        )

    def quit_at_once(self, status: int = 0) -> None:
        """Close without a question (for screenshots and measurements)."""
        self._closing.allowed = True
        self.window.close()
        self._application.exit(status)

    @property
    def pace(self) -> float:
        """Bench seconds per wall second; 0 without a bench."""
        return self.bench.pace if self.bench is not None else 0.0

    def _place(self, ws: shell.Workspace) -> Iterator[None]:
        if ws.lazy_pages is not None:
            ws.lazy_pages.take_out()
        self.window.add_page(ws.name, ws.page)
        if ws.lazy_pages is not None:
            yield from ws.lazy_pages.put_back()
        self._warn(self.layouts.add(ws.name, ws.columns))

    def _warn(self, *notices: str) -> None:
        for text in filter(None, notices):
            self.cards.show_card(CardText("SETTINGS", text, "", "", reset=False, notice=True))

    # -- orders -----------------------------------------------------------------------------------

    def stop(self) -> None:
        """Stop by software. Returns at once; allowed in every state."""
        if self.bench is not None:
            self.bench.stop()
            shell.log.info("STOP by the operator")
            lift = partial(shell.lift_hand, self.bench, self.cards)
            self.cards.show_card(shell.stopped_card(lift))
            self.cards.show_offer(STOPPED, shell.is_pressing(self.bench))

    def reset(self) -> None:
        """Clear the stop latch and the cards."""
        if self.bench is not None:
            self.bench.reset()
        self.cards.clear()

    def say(self, text: str, holds: Callable[[], bool] | None = None) -> None:
        """Show a sentence in the footer. With ``holds``, only while it returns True."""
        self._holds = holds
        self.window.show_message(text)

    def go(self, name: str) -> None:
        """Bring a workspace to the front and enable its keys."""
        front, coming = self.window.front, self.workspaces[name]
        if front and front != name:
            self.workspaces[front].leave()
        self.window.show_page(name)
        self.actions.enter(name)
        coming.enter()

    def _commands(self) -> list[shell.WindowCommand]:
        pages = [
            shell.WindowCommand(
                ws.name, tr("{} workspace", tr(ws.title)), ws.key, partial(self.go, ws.name)
            )
            for ws in self.workspaces.all
        ]
        return [
            *pages,
            shell.WindowCommand("connect", "Connect the bench", "Ctrl+L", self._connect_again),
            shell.WindowCommand("bench", "Open a bench file", "Ctrl+Shift+B", self._choose_bench),
            shell.WindowCommand("limits", "Limits of motion and force", "", self._show_limits),
            shell.WindowCommand("calibrate", "Calibrate: payload, board, tool, wrist, cameras",
                                "Ctrl+Shift+K", self._show_calibrations),
            shell.WindowCommand("check-day", "Daily check", "",
                                lambda: self._show_calibrations("day")),
            shell.WindowCommand("layout", "Reset the layout", "Ctrl+0", self._reset_layout),
            shell.WindowCommand("layouts", "Layouts of this workspace", "Ctrl+Alt+L",
                                lambda: self.layout_menu.show(self.window.rail["layouts"])),
            shell.WindowCommand("lock", "Lock or unlock the layout", "",
                                lambda: self.layouts.toggle_lock()),
            shell.WindowCommand("save-layout", "Save the layout under a name", "",
                                lambda: self.layout_menu.ask_name()),
            shell.WindowCommand("theme", "Next theme: dark, light, high contrast, as the system",
                                "Ctrl+T", self._next_theme),
            shell.WindowCommand("larger", "Larger text", "Ctrl++", self.look.larger),
            shell.WindowCommand("smaller", "Smaller text", "Ctrl+-", self.look.smaller),
            shell.WindowCommand("next-step", "Carry out the next step that is offered", "Ctrl+.",
                                lambda: self.window.next_step.yes.click()),
            shell.WindowCommand("keys", "Key sheet", "F1", self._show_keys),
            shell.WindowCommand("palette", "Find a command", "Ctrl+K",
                                lambda: self.dialogs.show_palette()),
            shell.WindowCommand("calls", "Sound and desktop notification: on or off", "",
                                self._toggle_calls),
            *self._speed.commands,
            shell.WindowCommand("fullscreen", "Full screen", "F11", self._full_screen),
            shell.WindowCommand("tour", "Tour of the window", "Ctrl+F1", lambda: self.tour.begin()),
            shell.WindowCommand("quit", "Quit", "Ctrl+Q", lambda: self.window.close()),
        ]  # fmt: skip

    def open_bench(self, file: Path) -> None:
        """Ask to start again with a bench file, unless the file or the present bench prevents it.

        A running program does not exchange its bench: no device, thread or view of it may remain.
        """
        if self._can_restart(file):
            text = tr("Restart the program with {}? The present bench is disconnected.", file.name)
            again = partial(self._start_again, file)
            self.cards.ask(CardQuestion(text, (("Stay", lambda: None), ("Restart", again))))

    def _start_again(self, file: Path) -> None:
        # The file may have changed since the question.
        if self._can_restart(file) and self._saved("Restart", partial(self._start_again, file)):
            self.next_bench = file
            self.window.close()

    def _may_close(self) -> bool:
        return self._closing.may_close(self.bench) and (
            self._closing.allowed or self._saved("Close", self.window.close)
        )

    def _saved(self, answer: str, go_on: Callable[[], object]) -> bool:
        """Save the settings; if the disk refuses, ask once to go on without them."""
        if self._asked_unsaved or self.remember():
            return True
        self._asked_unsaved = True
        text = "The window settings cannot be saved. Go on without them?"
        self.cards.ask(CardQuestion(text, (("Stay", lambda: None), (answer, go_on))))
        return False

    def _can_restart(self, file: Path) -> bool:
        # Imported here, as the window appears before the simulated bench is loaded.
        from touchdown.backend.bench import SimulatedBenchChoice

        def check() -> None:
            self._closing.check_unused(self.bench)
            load_lab(file) if is_lab_file(file) else SimulatedBenchChoice(file=file).settings()

        self.cards.clear(["BENCH-FILE"])
        return shell.carry_out(check, self.cards, "BENCH-FILE")

    def _choose_bench(self) -> None:
        shell.ask_path(self.window, "Bench file", self.open_bench, names="TOML (*.toml)")

    def _show_limits(self) -> None:
        if self.bench is not None:
            self.panels.limits.open()

    def _show_calibrations(self, what: CalibrationName | None = None) -> None:
        if self.bench is not None:
            self.panels.calibrate.open(what)

    def _connect_again(self) -> None:
        if self.bench is None:
            if self._make is not None:
                self.connect_bench(self._make, self._bench_file)
        elif not self.panels.open_connect():
            self.say("The simulated bench needs no connection. Ctrl+Shift+B opens a bench file.")

    def _reset_layout(self) -> None:
        self.window.showNormal()
        self.window.resize(shell.USUAL)
        self._pull_back()
        self.layouts.reset(self.window.front)
        self.workspaces[self.window.front].reset_layout()

    def _pull_back(self) -> None:
        screens = [screen.availableGeometry() for screen in QApplication.screens()]
        self.window.setGeometry(shell.move_on_screen(self.window.geometry(), screens))

    def _next_theme(self) -> None:
        self.look.next_theme()
        self.say(tr("Theme: {}.", self.look.words()))

    def _toggle_calls(self) -> None:
        self.calls.on = not self.calls.on
        self.say(tr("Sound and desktop notification: {}.", tr("on" if self.calls.on else "off")))
        self.remember()

    def _tour_ended(self) -> None:
        self.toured = True
        self.remember()

    def _refit(self) -> None:
        self.window.fit_to_theme()
        self.workspaces.fit_to_theme()
        self.tour.fit()

    def _show_keys(self) -> None:
        self.dialogs.show_keys()

    def _full_screen(self) -> None:
        full = self.window.isFullScreen()
        self.window.showNormal() if full else self.window.showFullScreen()

    # -- the pump ---------------------------------------------------------------------------------

    def _add_parts(self) -> None:
        """Add one call of the pump for each part that a page may have."""

        def draw(turn: int) -> None:
            parts = self.workspaces[self.window.front].parts
            if turn < len(parts):
                parts[turn]()

        for turn in range(MOST_PARTS):
            self.pump.add(partial(draw, turn))
        self.pump.add(self._draw_frame)

    def _hushed(self) -> bool:
        return self.bench is not None and self.bench.repaint_hold.on

    def _unseen(self) -> bool:
        minimised = self.window.isMinimized()
        if self.bench is not None:
            self.bench.watched = not minimised
        return minimised

    def _calm(self) -> bool:
        live = self.workspaces[self.window.front].live
        return live is not None and live.calm()

    def _pull(self) -> bool:
        failure = self._box.take()
        if failure is not None:
            self.cards.show_card(failure)
            return True
        event = self._mailbox.take()
        if event is None:
            return False
        self._take(event)
        return True

    def _take(self, event: core.Event) -> None:
        if isinstance(event, core.RunStarted):
            self.window.next_step.withdraw()
        self.workspaces.take(event)
        self.panels.calibrate.take(event)
        shell.log_event(event)
        self.calls.take(event)
        shell.show_event(event, self.bench, self.cards, self.say)
        if isinstance(event, core.RunFinished):
            call_glibc("malloc_trim", 0)  # up to 100 MB that nothing uses after a run

    def _show_connecting(self) -> None:
        self.bar.pill.show_state(PillState("CONNECTING", "ring", "blue", "preparing the bench"))
        self.workspaces.show_waiting("Connecting", "The bench is being prepared.")

    def _connect_failed(self, error: Exception) -> None:
        self.bar.pill.show_state(PillState("NO DEVICES", "ring", "grey"))
        self.workspaces.show_waiting("No bench", "Nothing is connected.")
        self.cards.show_card(bench_failed_card(error, self._bench_file, self._connect_again))

    def _draw_frame(self) -> None:
        if self.bench is None:
            return
        if self._chips.draw():
            self._servo.draw()
            if self._holds is not None and not self._holds():
                self.say("")
            self.inspect.draw()
            self.panels.draw()
            self._closing.draw(self.bench)
            self.cards.show_offer(STOPPED, shell.is_pressing(self.bench))
            pace = tr("{:.2f}\N{MULTIPLICATION SIGN} real time", self.pace) if self.pace else ""
            self.window.show_right(pace)
        self.bar.pill.show_state(shell.pill_state(self.bench))

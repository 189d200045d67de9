"""Builds the window round a bench, connects it in the background, and ends in order."""

from __future__ import annotations

import threading
from collections.abc import Callable
from datetime import datetime
from pathlib import Path

from PySide6.QtCore import QObject
from PySide6.QtGui import QIcon
from PySide6.QtWidgets import QApplication

from app.actions import Actions, key_rows
from app.cards import card_of
from app.error_hooks import ErrorBox
from app.inspect import InspectPresenter
from app.link import Link
from app.live import LivePresenter
from app.main_window import MainWindow
from app.pill import pill_of
from app.review import ReviewPresenter
from app.review_page import ReviewPage
from app.settings import WindowSettings, load_settings, save_settings
from app.side import SidePresenter
from app.stack import StackPresenter
from app.stack_page import StackIntents, StackPage
from app.stop_key import StopKey
from backend.core.facts import Fact, FaultRaised, FaultsReset, RunFinished, RunStarted, Said
from backend.core.faults import TouchdownError
from backend.core.hub import Mailbox
from widgets.decision_panel import NOTHING_YET
from widgets.fault_cards import CardText, FaultCards, Question
from widgets.key_sheet import KeySheet
from widgets.pump import Pump
from widgets.state_pill import PillState
from widgets.theme import THEMES, Theme, ThemeName, load_resources
from widgets.top_bar import TopBar


class TouchdownApp(QObject):
    """Owns window, presenters and pump. The bench arrives later, from a thread."""

    def __init__(
        self, application: QApplication, box: ErrorBox, settings_file: Path, runs: Path
    ) -> None:
        super().__init__()
        self._application, self._box, self._settings_file = application, box, settings_file
        self._settings, warning = load_settings(settings_file)
        load_resources()
        self.theme = Theme()
        self.theme.apply(application, self._settings.theme, self._settings.scale)
        application.setWindowIcon(QIcon("icons:touchdown.svg"))
        self.cards = FaultCards(self.reset)
        self.bar = TopBar(self.theme, self.stop)
        intents = StackIntents(self._start, self._pause, self._cancel, self._approve,
                               self._decline, self._choose)  # fmt: skip
        self.page = StackPage(self.theme, intents)
        self.page.run.show_form(self._settings.form)
        self.review_page = ReviewPage(self.theme, self._choose_reviewed)
        self.window = MainWindow(
            self.theme, self.bar, self.cards, {"stack": self.page, "review": self.review_page}
        )
        self.window.may_close = self._may_close
        self._link: Link | None = None
        self._arriving: list[Link | Exception] = []
        self._mailbox = Mailbox()
        self.live: LivePresenter | None = None
        self.stack: StackPresenter | None = None
        self._side: SidePresenter | None = None
        self.inspect: InspectPresenter | None = None
        self.review = ReviewPresenter(self.review_page, runs, self.cards)
        self.actions = Actions(self.window, self._slots())
        self._wire_rail()
        self.pump = Pump(self, self._pull)
        for draw in (self._draw_left, self._draw_right, self._draw_wrench, self._draw_rest):
            self.pump.add(draw)
        self._stop_key = StopKey(self, self.stop, self._moving)
        application.installEventFilter(self._stop_key)
        self._closing_allowed = False
        self._sheet: KeySheet | None = None
        self.bar.pill.show_state(PillState("CONNECTING", "ring", "blue", "preparing the bench"))
        self.page.show_waiting("Connecting", "The bench is being prepared.")
        if warning:
            self.cards.show_card(CardText("SETTINGS", warning, "", "", reset=False))

    # -- life -------------------------------------------------------------------------------------

    def connect_bench(self, make: Callable[[], Link]) -> None:
        """Build the bench on a thread of its own; the window stays alive meanwhile."""

        def build() -> None:
            arrived: Link | Exception = RuntimeError("an error that nobody expected")
            try:
                arrived = make()
            except (TouchdownError, OSError, ValueError, ImportError, RuntimeError) as error:
                arrived = error
            finally:
                # Whatever happened, the window stops saying "connecting".
                self._arriving.append(arrived)

        threading.Thread(target=build, name="connect", daemon=True).start()

    def attach(self, link: Link) -> None:
        """Take a bench that is ready and show it."""
        self._link = link
        link.hub.subscribe(self._mailbox)
        self.live = LivePresenter(link, self.page, self.bar)
        self.stack = StackPresenter(link, self.page, self.cards)
        self._side = SidePresenter(link, self.page.side, self.page.side_panel)
        self.inspect = InspectPresenter(link, self.bar, self.window)
        shown = link.catalogue
        self.page.run.show_catalogue(
            [(name, shown.piece(name).title) for name in shown.tops],
            [(name, shown.piece(name).title) for name in shown.bottoms],
        )
        self.page.run.show_form(self._settings.form)
        self.page.decision.show_text(NOTHING_YET)
        self.window.show_simulated(link.simulated)
        self.bar.show_hardware_stop("none (simulated)" if link.simulated else "unknown")
        link.open()

    def start(self) -> None:
        """Show the window and begin to pump."""
        if self._settings.geometry is not None:
            self.window.setGeometry(*self._settings.geometry)
        _pull_back(self.window)
        self.window.show()
        self.pump.start()

    def close(self) -> None:
        """Remember the window, end the bench; safe to call twice."""
        self.pump.stop()
        self._application.removeEventFilter(self._stop_key)
        area = self.window.normalGeometry()
        geometry = (area.x(), area.y(), area.width(), area.height())
        # Without a bench the form was never filled in: keep what was remembered.
        form = self._settings.form if self.stack is None else self.page.run.form()
        settings = WindowSettings(self.theme.tokens.name, self.theme.scale, geometry, form)
        try:
            save_settings(self._settings_file, settings)
        except OSError as error:
            self._box.exception(OSError, error, None, "saving the window settings")
        link, self._link = self._link, None
        if link is not None:
            link.close()

    def quit_at_once(self, status: int = 0) -> None:
        """Close without a question (for pictures and measurements)."""
        self._closing_allowed = True
        self.window.close()
        self._application.exit(status)

    @property
    def pace(self) -> float:
        """Bench seconds per wall second; 0 without a bench."""
        return self._link.pace if self._link is not None else 0.0

    def _may_close(self) -> bool:
        if self._closing_allowed or self.stack is None or not self.stack.busy():
            return True
        self.cards.ask(
            Question(
                "A run is active and a piece may be held. Stop and close?",
                (("Keep running", _stay), ("Stop and close", self._stop_and_close)),
            )
        )
        return False

    def _stop_and_close(self) -> None:
        self.stop()
        self._closing_allowed = True
        self.window.close()

    # -- orders -----------------------------------------------------------------------------------

    def stop(self) -> None:
        """Software stop: returns at once, legal in every state."""
        if self._link is not None:
            self._link.stop()
            self.cards.show_card(
                CardText(
                    "STOPPED",
                    "Stopped by the operator.",
                    "The run ends and new motion is refused; the grip is kept.",
                    "Look at the bench, then press Reset.",
                    at=_clock(),
                )
            )

    def reset(self) -> None:
        """Clear the latch and the cards."""
        if self._link is not None:
            self._link.reset()
        self.cards.clear()

    def _moving(self) -> bool:
        return self.stack is not None and self.stack.moving()

    def _start(self) -> None:
        if self.stack is not None:
            self.stack.start()

    def _pause(self) -> None:
        if self.stack is not None:
            self.stack.pause_or_resume()

    def _cancel(self) -> None:
        if self.stack is not None:
            self.stack.cancel()

    def _approve(self) -> None:
        if self.stack is not None:
            self.stack.approve()

    def _decline(self) -> None:
        if self.stack is not None:
            self.stack.decline()

    def _choose(self, index: int) -> None:
        if self.stack is not None:
            self.stack.choose(index)

    def _choose_reviewed(self, index: int) -> None:
        self.review.choose_probe(index)

    def _slots(self) -> dict[str, Callable[[], None]]:
        return {
            "start": self._start, "step": self._approve, "approve": self._approve,
            "pause": self._pause, "stack": self._show_stack, "review": self.show_review,
            "fit": self.page.fit, "theme": self.next_theme, "larger": self._larger,
            "smaller": self._smaller, "keys": self._show_keys,
            "fullscreen": self._full_screen, "quit": self._quit,
        }  # fmt: skip

    def _wire_rail(self) -> None:
        for name, button in self.window.rail.items():
            button.setToolTip(
                f"{button.text()} ({self.actions.action(name).shortcut().toString()})"
            )
            button.clicked.connect(self.actions.action(name).trigger)

    def _show_stack(self) -> None:
        self.window.show_page("stack")

    def show_review(self) -> None:
        """Bring the recorded runs to the front."""
        self.review.refresh()
        self.window.show_page("review")

    def next_theme(self) -> None:
        """Switch to the next theme."""
        at = THEMES.index(self.theme.tokens.name)
        self._restyle(at + 1, self.theme.scale)

    def set_theme(self, name: ThemeName) -> None:
        """Switch to a theme by name."""
        self._restyle(THEMES.index(name), self.theme.scale)

    def _larger(self) -> None:
        self._restyle(THEMES.index(self.theme.tokens.name), self.theme.scale + 0.1)

    def _smaller(self) -> None:
        self._restyle(THEMES.index(self.theme.tokens.name), self.theme.scale - 0.1)

    def _restyle(self, theme: int, scale: float) -> None:
        self.theme.apply(self._application, THEMES[theme % len(THEMES)], scale)
        self.window.fit_to_theme()
        self.page.fit_to_theme()
        self.page.run.draw_icons()

    def _show_keys(self) -> None:
        if self._sheet is None:
            self._sheet = KeySheet(self.window, key_rows())
        self._sheet.show()

    def _full_screen(self) -> None:
        full = self.window.isFullScreen()
        self.window.showNormal() if full else self.window.showFullScreen()

    def _quit(self) -> None:
        self.window.close()

    # -- the pump ---------------------------------------------------------------------------------

    def _pull(self) -> bool:
        if self._arriving:
            arrived = self._arriving.pop()
            if isinstance(arrived, Exception):
                self._connect_failed(arrived)
            else:
                self.attach(arrived)
            return True
        failure = self._box.take()
        if failure is not None:
            self.cards.show_card(failure)
            return True
        fact = self._mailbox.take()
        if fact is None:
            return False
        self._take(fact)
        return True

    def _take(self, fact: Fact) -> None:
        if self.stack is not None:
            self.stack.take(fact)
        if self._side is not None:
            self._side.take(fact)
        if isinstance(fact, FaultRaised):
            self.cards.show_card(card_of(fact.fault, _clock()))
        elif isinstance(fact, FaultsReset):
            self.cards.clear()
        elif isinstance(fact, RunStarted):
            self.window.show_message("")
        elif isinstance(fact, Said):
            self.window.show_message(fact.text)
        elif isinstance(fact, RunFinished) and fact.ending != "finished":
            was = "failed" if fact.ending == "failed" else f"was {fact.ending}"
            self.window.show_message(f"The run {was}: {fact.reason}")

    def _connect_failed(self, error: Exception) -> None:
        self.bar.pill.show_state(PillState("NO DEVICES", "ring", "grey"))
        self.page.show_waiting("No bench", "Nothing is connected.")
        self.cards.show_card(
            CardText(
                "CONNECT",
                f"The bench could not be prepared: {error}",
                "Nothing is connected; recorded runs can still be reviewed.",
                "Run 'touchdown doctor' for the cause.",
                reset=False,
            )
        )

    def _draw_left(self) -> None:
        if self.live is not None:
            self.live.draw_left()

    def _draw_right(self) -> None:
        if self.live is not None:
            self.live.draw_right()

    def _draw_wrench(self) -> None:
        if self.live is not None:
            self.live.draw_wrench()

    def _draw_rest(self) -> None:
        if self._link is None or self.live is None or self.stack is None or self._side is None:
            return
        if self.live.draw_chips():
            self._draw_figures()
        self.stack.draw()
        self._side.draw()
        self.bar.pill.show_state(pill_of(self._link))

    def _draw_figures(self) -> None:
        """Draw what changes all the time but is read now and then."""
        if self.inspect is not None:
            self.inspect.draw()
        pace = f"{self.pace:.2f}\N{MULTIPLICATION SIGN} real time" if self.pace else ""
        self.window.show_right(pace)


def _stay() -> None:
    """Do nothing: the run goes on."""


def _clock() -> str:
    return f"{datetime.now():%H:%M:%S}"


def _pull_back(window: MainWindow) -> None:
    """Move the window onto a screen that exists."""
    screen = window.screen()
    if screen is None:
        return
    area, mine = screen.availableGeometry(), window.geometry()
    if not area.intersects(mine):
        window.move(area.topLeft())

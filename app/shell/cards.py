"""Cards that report faults, refusals and questions."""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime

from PySide6.QtWidgets import QApplication, QWidget

from touchdown.app.shell.activity import is_run_active, start_obstacle
from touchdown.app.shell.errors import log
from touchdown.backend import core
from touchdown.backend.bench import Session
from touchdown.widgets.base import tr
from touchdown.widgets.shell import STOPPED, CardQuestion, CardText, FaultCards


def fault_card(fault: core.Fault) -> CardText:
    """Return the card of a fault that is raised now."""
    at, device = time_of_day(), f"\n{tr('Device')}: {fault.device}" if fault.device else ""
    details = (
        f"{fault.what}\n{fault.consequence}\n{fault.next_step}\n"
        f"{tr('Code')}: {fault.code}{device}\n{at}"
    )
    return CardText(fault.code, fault.what, fault.consequence, fault.next_step, details, at=at)


LIFT = "Reset and lift 5 mm"
LIFT_MM, LIFT_MM_S = 5.0, 5.0


def lift_hand(bench: Session, cards: FaultCards) -> None:
    """Lift the hand by ``LIFT_MM``, slowly while in contact."""
    hand = bench.hand
    if hand is not None:
        carry_out(lambda: hand.jog.step("z", "XYZ", LIFT_MM, LIFT_MM_S), cards)


def open_gripper(bench: Session, cards: FaultCards, ask: Callable[..., None]) -> None:
    """Open the gripper; while it holds a piece, ``ask`` first (text, no, yes, action of yes)."""
    hand = bench.hand
    if hand is None:
        return
    if hand.holding:
        ask("A piece is held. Opening lets it go.", "Keep holding", "Open and let it go",
            lambda: carry_out(lambda: hand.open(confirmed=True), cards))  # fmt: skip
    else:
        carry_out(lambda: hand.open(confirmed=False), cards)


def is_pressing(bench: Session) -> bool:
    """Return True if a held piece presses on something and no run moves it."""
    return bench.hand is not None and bool(bench.hand.pressing_n) and not is_run_active(bench)


def stopped_card(lift: Callable[[], None]) -> CardText:
    """Return the card of a STOP; ``lift`` is offered while in contact."""
    return CardText(
        STOPPED,
        "Stopped by the operator.",
        "The run ends and new motion is refused; the grip is kept.",
        "Look at the bench, then press Reset.",
        at=time_of_day(),
        offer=(LIFT, lift),
    )


def refusal_card(error: core.RefusedError) -> CardText:
    """Return the card of a refused or ended manual command."""
    consequence = "The order was refused or has ended."
    return CardText(
        error.reason, error.detail, consequence, "", reset=False, at=time_of_day(), passing=True
    )


def error_card(code: str, error: Exception, where: str = "", fix: str = "") -> CardText:
    """Return the card of a failed action. An ``InputError`` has a place and a fix of its own."""
    if isinstance(error, core.InputError):
        return CardText(
            code, error.what, where or tr("In {}.", error.where), error.fix, reset=False
        )
    what = str(error) or type(error).__name__
    if isinstance(error, OSError) and error.strerror:
        what = ": ".join(str(part) for part in (error.strerror, error.filename) if part)
    return CardText(code, what, where, fix, reset=False)


def carry_out(order: Callable[[], object], cards: FaultCards, code: str = "INPUT") -> bool:
    """Carry out an order of the operator; return False and show a card if it is refused.

    ``code`` is that of the card for invalid input. An accepted order removes earlier refusals.
    """
    try:
        order()
    except core.RefusedError as error:
        # The cause of an ended jog was shown already.
        if error.reason != "JOG-ENDED":
            cards.show_card(refusal_card(error))
    except core.FaultError as error:
        cards.show_card(refusal_card(core.RefusedError(error.fault.code, error.fault.what)))
    except core.InputError as error:
        cards.show_card(error_card(code, error))
    else:
        cards.pass_on()
        return True
    return False


def log_event(event: core.Event) -> None:
    """Log an event that an operator may ask about later."""
    if isinstance(event, core.RunStarted):
        log.info("run %s: %s, %s on %s, seed %s",
                 event.run_id, event.activity, event.piece, event.bottom, event.seed)  # fmt: skip
    elif isinstance(event, core.RunFinished):
        log.info("run %s %s %s", event.run_id, event.ending, event.reason)
    elif isinstance(event, core.FaultRaised):
        log.warning("fault %s: %s", event.fault.code, event.fault.what)
    elif isinstance(event, core.FaultsReset):
        log.info("reset by the operator")
    elif isinstance(event, core.Paused):
        log.warning("paused %s: %s", event.fault.code, event.fault.what)
    elif isinstance(event, core.Noticed):
        log.warning("noticed %s: %s", event.fault.code, event.fault.what)
    elif isinstance(event, core.Refused):
        log.info("refused %s: %s", event.reason, event.text)


def show_event(
    event: core.Event, bench: Session | None, cards: FaultCards, say: Callable[..., None]
) -> None:
    """Show an event to the operator, if it needs attention. ``say`` writes to the footer."""
    if isinstance(event, core.PhaseEntered | core.RunFinished):
        cards.clear(cards.obstacles)
    if isinstance(event, core.FaultRaised):
        cards.show_card(fault_card(event.fault))
    elif isinstance(event, core.Refused):
        cards.show_card(refusal_card(core.RefusedError(event.reason, event.text)))
    elif isinstance(event, core.FaultsReset):
        cards.clear()
        why = "" if bench is None else start_obstacle(bench)
        if bench is not None and why:
            say(f"{why}.", lambda: start_obstacle(bench) == why)
    elif isinstance(event, core.Paused | core.Noticed):
        waits = isinstance(event, core.Paused)
        card = fault_card(event.fault)
        cards.show_card(replace(card, reset=False, obstacle=waits, notice=not waits))
    elif isinstance(event, core.RunStarted):
        say("")
        cards.pass_on()
    elif isinstance(event, core.Said):
        say(event.text)
    elif isinstance(event, core.RunFinished) and event.ending != "finished":
        was = "The run failed: {1}" if event.ending == "failed" else "The run was {}: {}"
        say(tr(was, tr(event.ending), event.reason.removeprefix(f"{event.ending} ")))


def time_of_day() -> str:
    """Return the time of day as shown on cards."""
    return f"{datetime.now():%H:%M:%S}"


# Replaces a question about something that has ended meanwhile.
ENDED_QUESTION = "It has ended, and no piece is held. Close the window?"

EXIT_TIMEOUT_S = 5.0  # time after closing in which threads can end


def exit_after_timeout(after_s: float = EXIT_TIMEOUT_S) -> None:
    """End this process after ``after_s``, if it is still running. Returns at once.

    For a window that was closed in order: a hanging thread must not keep the process alive.
    """

    def end() -> None:
        names = ", ".join(sorted(thread.name for thread in threading.enumerate()))
        log.error("ended by force; still there: %s", names)
        os._exit(1)

    last = threading.Timer(after_s, end)
    last.name, last.daemon = "last word", True
    last.start()


class CloseConfirmation:
    """Asks before closing. ``allowed``: close without a question."""

    def __init__(
        self, cards: FaultCards, stop: Callable[[], None], close: Callable[[], object]
    ) -> None:
        self._cards, self._stop, self._close = cards, stop, close
        self._asked: CardQuestion | None = None
        self.allowed = False

    def may_close(self, bench: Session | None) -> bool:
        """Return True if the window can close, else ask."""
        question = None if self.allowed or bench is None else self._question(bench)
        if question is None:
            return True
        self._ask(question)
        return False

    def draw(self, bench: Session) -> None:
        """Update the question if its subject has ended."""
        if self._asked is None or self._cards.asks is not self._asked:
            return
        now = self._question(bench) or CardQuestion(
            ENDED_QUESTION, (("Stay", lambda: None), ("Close", self._close_now))
        )
        if now.text != self._asked.text:
            self._ask(now, front=False)

    def check_unused(self, bench: Session | None) -> None:
        """Raise ``RefusedError`` while closing needs a question."""
        if bench is not None and self._question(bench) is not None:
            what = "The bench is in use: a run is active, it is moved by hand, or a piece is held."
            raise core.RefusedError(
                "BENCH-IN-USE", what, "End that, then open the bench file again."
            )

    def _question(self, bench: Session) -> CardQuestion | None:
        if is_run_active(bench):
            what, stay = "A run is active and a piece may be held.", "Keep running"
        elif bench.hand is not None and bench.hand.active:
            what, stay = "The bench is being moved by hand.", "Continue"
        elif bench.hand is not None and bench.hand.holding:
            answers = (("Stay", lambda: None), ("Close, keep the grip", self._stop_and_close))
            return CardQuestion("A piece is held. Close the window?", answers)
        else:
            return None
        answers = ((stay, lambda: None), ("Stop and close", self._stop_and_close))
        return CardQuestion(f"{tr(what)} {tr('Stop and close? The grip is kept.')}", answers)

    def _ask(self, question: CardQuestion, *, front: bool = True) -> None:
        self._asked = question
        self._cards.ask(question, front=front)

    def _stop_and_close(self) -> None:
        self._stop()
        self._close_now()

    def _close_now(self) -> None:
        self.allowed = True
        self._close()


class PersonCalls:
    """Calls a person when an event needs one; ``on``: by sound and desktop notification.

    The window shows each of these events, so both are used only while another program is in front.
    The command of ``--notify`` runs always.
    """

    def __init__(self, window: QWidget, on: bool, command: core.CommandNotifier | None) -> None:
        self._window, self.on, self._command = window, on, command
        # The usual program of Linux desktops; without it there is the sound alone.
        desktop = shutil.which("notify-send")
        self._desktop = core.CommandNotifier(f"{desktop} --app-name=Touchdown") if desktop else None

    def take(self, event: core.Event) -> None:
        """Call a person if ``event`` needs one; returns at once."""
        if self._command is not None:
            self._command.take(event)
        if self.on and not self._window.isActiveWindow() and core.person_call(event) is not None:
            QApplication.beep()
            QApplication.alert(self._window)
            if self._desktop is not None:
                self._desktop.take(event)

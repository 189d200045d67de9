"""Questions of a trial on devices, asked and answered line by line: scene, hand, outcome."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING

from backend.core.facts import Fact, HandOverAwaited, OutcomeAwaited, Paused, SetUpAwaited
from backend.core.faults import Fault
from backend.core.flow import Outcome
from backend.runs.words import hand_over, outcome_question, scene_to_set
from backend.verbs.screen import Screen

if TYPE_CHECKING:
    from backend.session import Session

KEYS = {
    "s": Outcome.PLACED,
    "f": Outcome.FELL,
    "d": Outcome.KNOCKED_OVER,
    "v": Outcome.ABORTED,
}
HOW = "s: stands, f: fell, d: disturbed, v and why: void. Enter: as proposed."


def attend(fact: Fact, session: Session, screen: Screen) -> None:
    """Ask what ``fact`` wants to know; the bench goes on meanwhile, and STOP stays possible."""
    if isinstance(fact, SetUpAwaited):
        screen.say(f"  {scene_to_set(fact)} Enter: it is set. Ctrl-D: not today.")
        _on_a_thread(lambda line: session.answer(line != ""))
    elif isinstance(fact, HandOverAwaited):
        screen.say(f"  {hand_over(fact)} Enter confirms.")
        _on_a_thread(lambda line: session.answer(line != ""))
    elif isinstance(fact, OutcomeAwaited):
        screen.say(f"  {outcome_question(fact)} {HOW}")
        _on_a_thread(lambda line: _judge(line, fact, session, screen))
    # Devices cannot be left alone until somebody answers: there the run ends.
    elif isinstance(fact, Paused) and room_made(fact.fault, screen, "run", waits=session.simulated):
        session.engine.resume()


def room_made(fault: Fault, screen: Screen, what: str, *, waits: bool = True) -> bool:
    """Say what paused ``what`` and wait for its operator; False where nobody can answer."""
    screen.say(f"  {fault.what} {fault.consequence}")
    if screen.json or not waits:
        return False
    screen.say(f"  Make room on this disk, then press Enter. Ctrl-D ends the {what}.")
    return sys.stdin.readline() != ""


def read_outcome(line: str, proposed: OutcomeAwaited) -> tuple[Outcome, str] | None:
    """Return what a line says, None where it says nothing; a void trial needs its reason."""
    word, _, reason = line.strip().partition(" ")
    if not word:
        reason = proposed.why if proposed.proposed is Outcome.ABORTED else ""
        return proposed.proposed, reason
    outcome = KEYS.get(word.lower())
    if outcome is None or (outcome is Outcome.ABORTED and not reason.strip()):
        return None
    return outcome, reason.strip()


def _judge(line: str, fact: OutcomeAwaited, session: Session, screen: Screen) -> None:
    while line:
        said = read_outcome(line, fact)
        if said is not None:
            session.gate.see(*said)
            return
        screen.say(f"  {HOW}")
        line = sys.stdin.readline()
    session.gate.see(Outcome.ABORTED, "nobody said what became of the piece")


def _on_a_thread(take: Callable[[str], None]) -> None:
    """Give the next line of standard input to ``take``: "" at its end."""

    def read() -> None:
        take(sys.stdin.readline())

    threading.Thread(target=read, name="answer", daemon=True).start()

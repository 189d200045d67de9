"""Calls a person to an unattended run: on a fault, on a question, and at the end."""

from __future__ import annotations

import logging
import os
import queue
import shlex
import shutil
import subprocess
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from touchdown.backend.core import events
from touchdown.backend.core.faults import InputError
from touchdown.backend.core.files import errors_as_input

TITLE = "Touchdown"
# What a run waits for, by event; also shown as its state
QUESTIONS: dict[type[events.Event], str] = {
    events.SetUpAwaited: "set the scene",
    events.HandOverAwaited: "a hand at the jaws",
    events.MountingAwaited: "confirm the mounting",
    events.OutcomeAwaited: "say the outcome",
}
COMMAND_S = 30.0  # a command that takes longer is ended
WAITING = 16  # calls that wait for a slow command; later ones are dropped

log = logging.getLogger("touchdown")


@dataclass(frozen=True, slots=True)
class PersonCall:
    """A reason to call a person.

    Attributes
    ----------
    reason : {"fault", "question", "end"}
        Why somebody should come.
    text : str
        One line that says what happened.

    """

    reason: Literal["fault", "question", "end"]
    text: str

    @property
    def title(self) -> str:
        """Return the headline, such as "Touchdown: fault"."""
        return f"{TITLE}: {self.reason}"


def person_call(event: events.Event) -> PersonCall | None:
    """Return the call for an event, None for an event that needs no person.

    Parameters
    ----------
    event : Event
        Any event of a run.

    Returns
    -------
    PersonCall or None
        A fault, a question to the operator, an automatic pause, or the end of the run.

    """
    if isinstance(event, events.FaultRaised):
        fault = event.fault
        return PersonCall("fault", f"{fault.code}: {fault.what} {fault.next_step}".strip())
    if isinstance(event, events.ApprovalAwaited):
        return PersonCall("question", f"Approve the next action: {event.action.reason}")
    if isinstance(event, events.DecisionAwaited):
        return PersonCall("question", "Keep or discard the last probe.")
    if isinstance(event, events.Paused):
        return PersonCall("question", f"The run has paused: {event.fault.what}")
    if type(event) in QUESTIONS:
        return PersonCall("question", f"The run waits for you: {QUESTIONS[type(event)]}.")
    if isinstance(event, events.RunFinished):
        return PersonCall("end", f"The run ended ({event.ending}): {event.reason}".rstrip(": "))
    return None


class CommandNotifier:
    """Runs a command for each call, one after the other on a thread of its own.

    The command gets the title and the text as its last two arguments, so that ``notify-send`` works
    as it is, and ``TOUCHDOWN_REASON`` and ``TOUCHDOWN_TEXT`` in its environment. It runs without a
    shell. A slow or failed command never delays the run; its failure is written to the log and
    passed to ``failed`` once.

    Parameters
    ----------
    command : str
        Program and arguments, quoted as in a shell.
    failed : callable
        Called with a sentence when the command fails for the first time. From another thread.

    Raises
    ------
    InputError
        If the command is empty, wrongly quoted, or its program does not exist.

    """

    def __init__(self, command: str, failed: Callable[[str], None] = lambda text: None) -> None:
        said, fix = "The command cannot be read", "Quote it as in a shell."
        with errors_as_input(said, "--notify", fix, ValueError):
            self._words = shlex.split(command)
        if not self._words or shutil.which(self._words[0]) is None:
            name = self._words[0] if self._words else ""
            raise InputError(
                f"There is no program {name!r}.", "--notify", "Name a program that can be run."
            )
        self._failed, self._told = failed, False
        self._calls: queue.Queue[PersonCall | None] = queue.Queue(WAITING)
        self._thread = threading.Thread(target=self._work, name="notify", daemon=True)
        self._thread.start()

    def take(self, event: events.Event) -> None:
        """Call a person if ``event`` needs one; returns at once."""
        call = person_call(event)
        if call is not None:
            try:
                self._calls.put_nowait(call)
            except queue.Full:
                log.warning("notify: dropped %s", call.text)

    def close(self, timeout_s: float = COMMAND_S) -> None:
        """Wait until the waiting calls are made, at most ``timeout_s``."""
        try:
            self._calls.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._thread.join(timeout_s)

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            given = {"TOUCHDOWN_REASON": call.reason, "TOUCHDOWN_TEXT": call.text}
            try:
                subprocess.run(
                    [*self._words, call.title, call.text],
                    env={**os.environ, **given},
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    timeout=COMMAND_S,
                    check=True,
                )
            except (OSError, subprocess.SubprocessError) as error:
                log.warning("notify: %s", error)
                if not self._told:
                    self._told = True
                    self._failed(f"The command of --notify failed: {error}")

"""Errors and faults in the operator's language.

Each names the problem, its place, and the next step.
"""

from __future__ import annotations

from dataclasses import dataclass

MAX_MESSAGE = 600  # characters of a message about bad input


class TouchdownError(Exception):
    """Base of all errors that Touchdown raises.

    Parameters
    ----------
    *args
        As of ``Exception``.

    Examples
    --------
    >>> issubclass(InputError, TouchdownError)
    True

    """


class InputError(TouchdownError):
    """Bad input: a file, a setting, an argument, a checkpoint. Exit code 2.

    Attributes
    ----------
    what, where, fix : str
        Problem, its place (file, key or argument), and remedy.

    Examples
    --------
    >>> str(InputError("There is no piece 'pod'.", "pod.toml", "Use pot."))
    "There is no piece 'pod'. [pod.toml] Use pot."

    """

    def __init__(self, what: str, where: str, fix: str) -> None:
        if len(what) > MAX_MESSAGE:  # text of a foreign file may be part of it
            what = f"{what[:MAX_MESSAGE]} ..."
        super().__init__(f"{what} [{where}] {fix}")
        self.what: str = what
        self.where: str = where
        self.fix: str = fix

    def __reduce__(self) -> tuple[type[InputError], tuple[str, str, str]]:
        """Pass the three texts between processes; a subclass arrives as ``InputError``."""
        return InputError, (self.what, self.where, self.fix)


@dataclass(frozen=True, slots=True)
class Fault:
    """A failure of the running bench. Latched until the operator resets it.

    Attributes
    ----------
    code : str
        Stable identifier such as ``CAMERA-STALE``.
    what, consequence, next_step : str
        Problem, its consequence, and the action of the operator; one sentence each.
    device : str
        Name of the device that caused it, or "".

    """

    code: str
    what: str
    consequence: str
    next_step: str
    device: str = ""


class FaultError(TouchdownError):
    """A fault ended the activity.

    Attributes
    ----------
    fault : Fault
        Code, problem, consequence and next step.

    Examples
    --------
    >>> error = FaultError(Fault("FT-LINK", "The sensor is silent.", "The run ended.", "Check it."))
    >>> error.fault.code
    'FT-LINK'

    """

    def __init__(self, fault: Fault) -> None:
        super().__init__(f"{fault.what} {fault.consequence} {fault.next_step} [{fault.code}]")
        self.fault = fault


class RefusedError(TouchdownError):
    """A command was refused by the interlock.

    Attributes
    ----------
    reason : str
        Name of the condition that failed.
    what, next_step, detail : str
        Problem, remedy (may be ""), and both together.

    Examples
    --------
    >>> str(RefusedError("BUSY", "A run is in progress."))
    'A run is in progress. [BUSY]'

    """

    def __init__(self, reason: str, what: str, next_step: str = "") -> None:
        self.reason: str = reason
        self.what: str = what
        self.next_step: str = next_step
        self.detail: str = f"{what} {next_step}".rstrip()
        super().__init__(f"{self.detail} [{reason}]")


class StaleSampleError(TouchdownError):
    """There is no sample, or it is older than allowed."""

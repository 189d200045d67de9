"""Errors and faults in the operator's language.

Each names the problem, its place, and the next step.
"""

from __future__ import annotations

from dataclasses import dataclass


class TouchdownError(Exception):
    """Base of every error that Touchdown raises on purpose."""


class InputError(TouchdownError):
    """Bad input from outside: a file, a setting, an argument, a checkpoint. Exit code 2.

    ``what`` is wrong, ``where`` (the file, key or argument), and the ``fix``.
    """

    def __init__(self, what: str, where: str, fix: str) -> None:
        super().__init__(f"{what} [{where}] {fix}")
        self.what, self.where, self.fix = what, where, fix


@dataclass(frozen=True, slots=True)
class Fault:
    """Something failed while the bench was running. Latched until the operator resets it.

    ``code`` is a short stable word such as ``CAMERA-STALE``; ``what`` happened, its
    ``consequence`` and the ``next_step``; ``device`` names the cause.
    """

    code: str
    what: str
    consequence: str
    next_step: str
    device: str = ""


class FaultError(TouchdownError):
    """Raised where a ``Fault`` stops the present activity."""

    def __init__(self, fault: Fault) -> None:
        super().__init__(f"{fault.what} {fault.consequence} {fault.next_step} [{fault.code}]")
        self.fault = fault


class RefusedError(TouchdownError):
    """The interlock refused a command; ``reason`` is the name of the condition that failed.

    ``detail`` says what, and then ``next_step`` where that is told apart.
    """

    def __init__(self, reason: str, what: str, next_step: str = "") -> None:
        self.reason, self.what, self.next_step = reason, what, next_step
        self.detail = f"{what} {next_step}".rstrip()
        super().__init__(f"{self.detail} [{reason}]")


class StaleSampleError(TouchdownError):
    """A sample is older than allowed, or there is none: that is not an observation."""

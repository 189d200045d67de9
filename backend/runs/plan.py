"""Plan of a run: a generator that yields events and waits.

A plan never sleeps, never touches a thread and never reads a wall clock. Each ``yield`` is a point
where the engine publishes, pauses or cancels; a test drives a plan with ``next``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from touchdown.backend.core import Event, Fault, FaultError, StaleSampleError, TouchdownError
from touchdown.backend.devices import Motion

CODES = {"arm": "ARM-STALE", "force_torque": "FT-STALE"}
SAYS = {"arm": "The arm does not tell where it is"}


def stale_fault(error: StaleSampleError) -> Fault:
    """Return the fault of ``error``, which begins with the name of the stream."""
    name, _, detail = str(error).partition(": ")
    says = SAYS.get(name, f"No fresh sample of '{name}'")
    return Fault(
        CODES.get(name, "SAMPLE-STALE"),
        f"{says}: {detail or name}.",
        "Nothing was moved on it; the gripper was not opened.",
        "Check the device and its cable, press Reset, then connect it again.",
        name if name in CODES else "",
    )


class CancelledError(TouchdownError):
    """Thrown into a plan by the engine: end in an orderly way (lift, keep the piece)."""


class StoppedError(TouchdownError):
    """Thrown into a plan by the engine after STOP: end without any motion."""


def stopped_message(who: str) -> str:
    """Say who stopped a run; ``who`` is empty where a reset came before anybody could ask."""
    return f"stopped by {who}" if who else "stopped"


@dataclass(frozen=True, slots=True)
class Wait:
    """The plan goes on when ``until()`` is true; after ``timeout_s`` it fails with a fault."""

    until: Callable[[], bool]
    timeout_s: float
    what: str


@dataclass(frozen=True, slots=True)
class PausePoint:
    """A safe place to pause: the arm is lifted and nothing moves.

    ``obstacle``: the run pauses here by itself until the operator has removed it and resumes.
    """

    obstacle: Fault | None = None


R = TypeVar("R")
Step = Event | Wait | PausePoint
Plan = Generator[Step, None, R]


def motion_done(motion: Motion, timeout_s: float, what: str) -> Plan[None]:
    """Wait for ``motion``; raises its cause if it failed."""
    yield Wait(lambda: motion.done, timeout_s, what)
    motion.result()


def timeout_fault(waiting: Wait) -> FaultError:
    """Return the fault of a wait that took too long."""
    return FaultError(
        Fault(
            code="TIMEOUT",
            what=f"Waited {waiting.timeout_s:.1f} s in vain for {waiting.what}.",
            consequence="The run ended; the gripper was not opened.",
            next_step="Look at the device chips, then press Reset.",
        )
    )

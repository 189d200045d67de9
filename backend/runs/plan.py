"""Plan of a run: a generator that yields events and waits.

A plan never sleeps, never uses threads and never reads a wall clock. At each ``yield`` the engine
may publish, pause or cancel; a test runs a plan with ``next``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from touchdown.backend.core import Event, Fault, FaultError, StaleSampleError, TouchdownError
from touchdown.backend.devices import Motion

CODES = {"arm": "ARM-STALE", "force_torque": "FT-STALE"}
SAYS = {"arm": "The arm reports no position"}


def stale_fault(error: StaleSampleError) -> Fault:
    """Return the fault of ``error``, whose text begins with the name of the stream."""
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
    """Thrown into a plan by the engine: end in order (lift, keep the piece)."""


class StoppedError(TouchdownError):
    """Thrown into a plan by the engine after STOP: end without any motion."""


def stopped_message(who: str) -> str:
    """Return the reason of a stopped run; ``who`` is empty after an early reset."""
    return f"stopped by {who}" if who else "stopped"


@dataclass(frozen=True, slots=True)
class Wait:
    """Wait until ``until()`` is true; fails with a fault after ``timeout_s``."""

    until: Callable[[], bool]
    timeout_s: float
    what: str


@dataclass(frozen=True, slots=True)
class PausePoint:
    """Safe place to pause: the arm is lifted and nothing moves.

    With an ``obstacle`` the run pauses here until the operator removes it and resumes.
    """

    obstacle: Fault | None = None


R = TypeVar("R")
Step = Event | Wait | PausePoint
Plan = Generator[Step, None, R]


def motion_done(motion: Motion, timeout_s: float, what: str) -> Plan[None]:
    """Wait for ``motion``; raises its error."""
    yield Wait(lambda: motion.done, timeout_s, what)
    motion.result()


def timeout_fault(waiting: Wait) -> FaultError:
    """Return the fault of a wait that exceeded its time limit."""
    return FaultError(
        Fault(
            code="TIMEOUT",
            what=f"Waited {waiting.timeout_s:.1f} s for {waiting.what} without success.",
            consequence="The run ended; the gripper was not opened.",
            next_step="Look at the device chips, then press Reset.",
        )
    )

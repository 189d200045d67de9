"""What a plan is: a generator that announces facts and says what it waits for.

A plan never sleeps, never touches a thread and never reads a wall clock. Each ``yield`` is a point
where the engine publishes, pauses or cancels; a test drives a plan with ``next``.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

from backend.core.facts import Fact
from backend.core.faults import Fault, FaultError, TouchdownError
from backend.devices.protocols import Motion


class CancelledError(TouchdownError):
    """Thrown into a plan by the engine: end in an orderly way (lift, keep the piece)."""


class StoppedError(TouchdownError):
    """Thrown into a plan by the engine after STOP: end without any motion."""


def stopped_words(who: str) -> str:
    """Say who stopped a run; ``who`` is empty where a reset came before anybody could ask."""
    return f"stopped by {who}" if who else "stopped"


@dataclass(frozen=True, slots=True)
class Waiting:
    """The plan goes on when ``until()`` is true; after ``timeout_s`` it fails with a fault."""

    until: Callable[[], bool]
    timeout_s: float
    what: str


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """A safe place to pause: the arm is lifted and nothing moves.

    ``obstacle``: the run pauses here by itself until the operator has removed it and resumes.
    """

    obstacle: Fault | None = None


R = TypeVar("R")
Step = Fact | Waiting | Checkpoint
Plan = Generator[Step, None, R]


def motion_done(motion: Motion, timeout_s: float, what: str) -> Plan[None]:
    """Wait for ``motion``; raises its cause if it failed."""
    yield Waiting(lambda: motion.done, timeout_s, what)
    motion.result()


def timeout_fault(waiting: Waiting) -> FaultError:
    """Return the fault of a wait that took too long."""
    return FaultError(
        Fault(
            code="TIMEOUT",
            what=f"Waited {waiting.timeout_s:.1f} s in vain for {waiting.what}.",
            consequence="The run ended; the gripper was not opened.",
            next_step="Look at the device chips, then press Reset.",
        )
    )

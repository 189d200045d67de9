"""What the reader needs to know of a make's protocol."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeVar

from touchdown.backend.core import TouchdownError
from touchdown.backend.devices.force_torque.links import Link
from touchdown.backend.devices.framing import Wrench
from touchdown.backend.devices.protocols import Identity

Answer = TypeVar("Answer")
AXES = 6
"""Fx Fy Fz Tx Ty Tz."""


class NotAnsweredError(TouchdownError):
    """The sensor does not answer as it should; the text is a sentence for the operator."""


@dataclass(frozen=True, slots=True)
class Reading:
    """One sample in the axes of the sensor, N and N·m; NaN if the sensor marks it invalid.

    ``missed``: samples that the sensor took in between and that did not arrive. ``overload``: at
    the end of the range. ``trouble``: a failure that the sensor itself tells, in words.
    """

    wrench: Wrench
    missed: int = 0
    overload: bool = False
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class Greeting:
    """What a sensor told at its start: who it is, (6,) rated N and N·m, and its period.

    ``numbered``: it numbers its samples far enough that ``Reading.missed`` shows every loss.
    """

    identity: Identity
    rated: tuple[float, ...]
    period_s: float
    numbered: bool = False

    def __post_init__(self) -> None:
        """Refuse what no reader could use; ``ValueError``."""
        if len(self.rated) != AXES or not self.period_s > 0:
            raise ValueError(f"{AXES} rated loads and a period are needed, not {self}")


class Refusals(NamedTuple):
    """Frames refused in all and since the last good one; bytes that belonged to no frame."""

    frames: int
    in_a_row: int
    discarded: int


class Language(Protocol):
    """One make of sensor, for one connection."""

    @property
    def baud(self) -> int:
        """Speed of its serial line."""

    @property
    def chunk(self) -> int:
        """Bytes of about two frames: read together."""

    def start(self, link: Link, cancel: threading.Event) -> Greeting:
        """Bring the sensor from any state to streaming; raises ``NotAnsweredError``, ``WireError``.

        ``cancel`` ends the waiting.
        """

    def take(self, data: bytes) -> list[Reading]:
        """Return the samples that ``data`` completes, oldest first."""

    @property
    def refusals(self) -> Refusals:
        """What could not be read so far."""

    def stop(self, link: Link) -> None:
        """Leave a silent sensor behind."""


def pause(cancel: threading.Event, seconds: float) -> None:
    """Wait; raises ``NotAnsweredError`` when cancelled."""
    if cancel.wait(seconds):
        raise NotAnsweredError("Connecting was cancelled")


def listen(
    link: Link, cancel: threading.Event, limit_s: float, find: Callable[[bytes], Answer | None]
) -> Answer | None:
    """Hand what comes to ``find`` until it returns an answer; None after ``limit_s``."""
    end_s = time.monotonic() + limit_s
    while (left_s := end_s - time.monotonic()) > 0:
        pause(cancel, 0.0)
        found = find(link.read(min(left_s, 0.02)))
        if found is not None:
            return found
    return None


def ask(
    link: Link,
    cancel: threading.Event,
    request: bytes,
    find: Callable[[bytes], Answer | None],
    *,
    limit_s: float = 0.2,
    tries: int = 3,
) -> Answer:
    """Send ``request`` up to ``tries`` times until ``find`` knows the answer."""
    for _ in range(tries):
        link.write(request)
        answer = listen(link, cancel, limit_s, find)
        if answer is not None:
            return answer
    raise NotAnsweredError("The sensor sends nothing that is an answer")

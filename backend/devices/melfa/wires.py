"""What the driver needs of its wires: real sockets on threads, or a hand-wound clock in tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from backend.core.faults import Fault
from backend.devices.melfa.r3_client import Ticket
from backend.wire.melfa_joints import CYCLE_S
from backend.wire.melfa_r3 import Request

Cycle = Callable[[float, tuple[bytes, ...]], bytes | None]
"""(now, datagrams that came) -> the packet of this cycle, None if there is none."""


@dataclass(frozen=True, slots=True)
class CycleTimes:
    """Of the wake-ups of the real-time wire: number, late by more than a cycle, latest (s).

    ``realtime``: whether its owner has real-time priority.
    """

    wakes: int = 0
    late: int = 0
    latest_s: float = 0.0
    realtime: bool = False

    def after(self, over_s: float) -> CycleTimes:
        """Return them after one more wake-up, so much after its deadline."""
        late = self.late + (over_s > CYCLE_S)
        return CycleTimes(self.wakes + 1, late, max(self.latest_s, over_s), self.realtime)


class Wires(Protocol):
    """One command channel, one STOP lane, one real-time wire.

    ``cycle`` is called once per control cycle by the owner of the real-time wire; ``lost`` when
    the command channel is gone.
    """

    times: CycleTimes

    @property
    def bad_replies(self) -> int:
        """Replies of the command channel that could not be read."""

    def open(self, cycle: Cycle, lost: Callable[[Fault], None]) -> None:
        """Connect; raises ``FaultError``."""

    def ask(self, request: Request, timeout_s: float) -> Ticket:
        """Send a request in its turn."""

    def finish(self, ticket: Ticket) -> None:
        """Wait until the ticket has ended."""

    def watch_anew(self) -> None:
        """Count ``times`` from now on."""

    def pause(self, seconds: float) -> None:
        """Let time pass between two questions."""

    def pace(self, running: bool) -> None:
        """Say whether a program of the controller runs."""

    def stop_now(self, packet: bytes) -> None:
        """Send STOP on its own lane and ``packet`` on the real-time wire; wait for nothing."""

    def close(self) -> None:
        """Close all; a second time changes nothing."""

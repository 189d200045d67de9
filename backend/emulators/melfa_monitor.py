"""The real-time monitor of an emulated MELFA controller: one packet a cycle to whoever began it.

The numbers of the data types are stand-ins: only the manual of the controller knows them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from backend.emulators.pace import Pace
from backend.wire import melfa_monitor
from backend.wire.framing import WireError
from backend.wire.melfa_blocks import Block, Kind, Values
from backend.wire.melfa_joints import CYCLE_S
from backend.wire.melfa_monitor import START, Reply, Types

TYPE_FORCE = 901
COUNTER_TURN = 1 << 32


class EmulatedMonitor:
    """``wrench(now_s)`` gives six values, N and N·m; a type it does not know is a zero block."""

    def __init__(
        self, wrench: Callable[[float], Sequence[float]], *, type_force: int = TYPE_FORCE
    ) -> None:
        self._wrench, self._force = wrench, type_force
        self.pace = Pace()
        self._types: Types = (0, 0, 0, 0)
        self._counter = 0

    def receive(self, now_s: float, data: bytes) -> list[bytes]:
        """Take one request."""
        try:
            request = melfa_monitor.decode_request(data)
        except WireError:
            return []
        if request.command == START:
            self._types = request.types
            self.pace.begin(now_s, CYCLE_S)
        else:
            self.pace.end()
        return []

    def due(self, now_s: float) -> list[bytes]:
        """Return the packets up to now."""
        late, times = self.pace.due(now_s)
        self._counter = (self._counter + late) % COUNTER_TURN
        return [self._packet(t_s) for t_s in times]

    def _packet(self, now_s: float) -> bytes:
        self._counter = (self._counter + 1) % COUNTER_TURN
        first, second, third, fourth = (self._block(now_s, number) for number in self._types)
        kinds = {
            number: Kind.FORCE if number == self._force else Kind.NONE for number in self._types
        }
        reply = Reply(self._types, (first, second, third, fourth), self._counter)
        return melfa_monitor.encode_reply(reply, kinds)

    def _block(self, now_s: float, number: int) -> Block:
        if number != self._force:
            return None
        return Values(Kind.FORCE, tuple(self._wrench(now_s)))

"""Which replies of a real-time stream count: whole, finite, plausible, and newer than the last."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from backend.core.flow import FloatArray
from backend.wire.framing import WireError
from backend.wire.melfa_blocks import Values
from backend.wire.melfa_mxt import decode_reply

COMMAND_JOINTS, FEEDBACK_JOINTS = 2, 8
MONITORS = (COMMAND_JOINTS, FEEDBACK_JOINTS, 5, 11)
"""Wanted in every reply: joints commanded, measured, filtered, and currents."""
TURN_RAD = 10.0
"""No joint of any arm reads more."""
_HALF = 1 << 31
_WRAP = 1 << 32


@dataclass(slots=True)
class Counts:
    """What became of the datagrams since the stream began."""

    accepted: int = 0
    refused: int = 0
    """Wrong size, type, numbers."""
    repeated: int = 0
    """The counter of the last accepted one again."""
    old: int = 0
    """Overtaken by a newer one."""
    skipped: int = 0
    """Counters that never came."""


@dataclass(frozen=True, slots=True)
class Echo:
    """One accepted reply: (6,) joints as commanded and as measured, and the missed cycles."""

    command_rad: FloatArray
    feedback_rad: FloatArray
    timeouts: int


class Replies:
    """Takes datagrams, keeps the newest, counts the others."""

    def __init__(self) -> None:
        self.counts = Counts()
        self._counter: int | None = None

    def take(self, datagrams: Iterable[bytes]) -> Echo | None:
        """Return the newest acceptable echo among ``datagrams`` and all before, None if none."""
        newest: Echo | None = None
        for data in datagrams:
            told = _acceptable(data)
            if told is None:
                self.counts.refused += 1
            elif self._is_newer(told[0]):
                newest = told[1]
                self.counts.accepted += 1
        return newest

    def _is_newer(self, counter: int) -> bool:
        if self._counter is not None:
            ahead = (counter - self._counter) % _WRAP
            if ahead == 0:
                self.counts.repeated += 1
                return False
            if ahead >= _HALF:
                self.counts.old += 1
                return False
            self.counts.skipped += ahead - 1
        self._counter = counter
        return True


def _acceptable(data: bytes) -> tuple[int, Echo] | None:
    """Return counter and echo of one datagram, None if it cannot be meant."""
    try:
        reply = decode_reply(data)
    except WireError:
        return None
    if reply.monitors != MONITORS:
        return None
    command, feedback = reply.blocks[0], reply.blocks[1]
    assert isinstance(command, Values)
    assert isinstance(feedback, Values)
    wanted, found = command.axes[:6], feedback.axes[:6]
    if not all(-TURN_RAD <= angle <= TURN_RAD for angle in (*wanted, *found)):
        return None
    return reply.counter, Echo(np.array(wanted), np.array(found), reply.timeouts)

"""MXT, real-time external control of a MELFA controller: 196 bytes each way per cycle.

Source: CR800 Ethernet Function manual BFP-A3379, 3.3.2 and tables 3-1 to 3-7.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from backend.wire.framing import WireError, expect_length
from backend.wire.melfa_blocks import (
    BLOCK_BYTES,
    Block,
    Kind,
    decode_block,
    encode_block,
    kind_of,
)

PACKET_BYTES = 196

_HEAD = struct.Struct("<4H")
_SIGNALS = struct.Struct("<6HI")
_SLOT = struct.Struct("<2H")
_SLOTS = (64, 108, 152)

SEND_KINDS = {0: Kind.NONE, 1: Kind.POSE, 2: Kind.JOINT, 3: Kind.PULSE}
MONITOR_KINDS = {
    0: Kind.NONE,
    **{number: (Kind.POSE, Kind.JOINT, Kind.PULSE)[(number - 1) % 3] for number in range(1, 10)},
    10: Kind.CURRENT,
    11: Kind.CURRENT,
}
"""Content of each monitor type: 1-3 command, 4-6 after filter, 7-9 encoder, 10, 11 currents."""


class Command(IntEnum):
    """What the packet asks for; the first packet must be NONE."""

    NONE = 0
    MOVE = 1
    END = 255


@dataclass(frozen=True, slots=True)
class Signals:
    """Digital signals: direction codes 0 none, 1 output, 2 input; 16 bits from ``head``."""

    send: int = 0
    receive: int = 0
    head: int = 0
    mask: int = 0
    bits: int = 0


@dataclass(frozen=True, slots=True)
class Request:
    """To the controller: an absolute ``target`` and the four monitor types wanted."""

    command: Command
    target: Block = None
    monitors: tuple[int, int, int, int] = (0, 0, 0, 0)
    counter: int = 0
    signals: Signals = Signals()
    timeouts: int = 0


@dataclass(frozen=True, slots=True)
class Reply:
    """From the controller: the monitored ``blocks`` with their types.

    ``timeouts``: cycles without a packet; ``counter``: number of the exchange; both wrap.
    ``send_type`` repeats the type of the first block.
    """

    command: Command
    send_type: int
    monitors: tuple[int, int, int, int]
    blocks: tuple[Block, Block, Block, Block]
    counter: int
    signals: Signals = Signals()
    timeouts: int = 0


def encode_request(request: Request) -> bytes:
    """Return the 196 bytes; raises ``WireError`` if a number does not fit or is none."""
    kind = kind_of(request.target)
    send_type = next((code for code, known in SEND_KINDS.items() if known is kind), None)
    if send_type is None:
        raise WireError("type", "mxt target", 2)
    blocks = (request.target, None, None, None)
    return _join(request, send_type, blocks)


def encode_reply(reply: Reply) -> bytes:
    """Return the 196 bytes."""
    kinds = tuple(map(kind_of, reply.blocks))
    if kinds != tuple(MONITOR_KINDS.get(number) for number in reply.monitors):
        raise WireError("type", "mxt reply", 4)
    return _join(reply, reply.send_type, reply.blocks)


def _join(packet: Request | Reply, send_type: int, blocks: tuple[Block, ...]) -> bytes:
    signals = packet.signals
    io = (signals.send, signals.receive, signals.head, signals.mask, signals.bits)
    try:
        first, *others = packet.monitors
        parts = [
            _HEAD.pack(packet.command, send_type, first, 0),
            encode_block(blocks[0]),
            _SIGNALS.pack(*io, packet.timeouts, packet.counter),
        ]
        for monitor, block in zip(others, blocks[1:], strict=True):
            parts += [_SLOT.pack(monitor, 0), encode_block(block)]
    except struct.error as error:
        raise WireError("range", "mxt packet") from error
    return b"".join(parts)


def decode_request(data: bytes) -> Request:
    """Return the request of one datagram; raises ``WireError``."""
    command, send_type, monitors, signals, timeouts, counter = _open(data)
    if send_type not in SEND_KINDS:
        raise WireError("type", "mxt request", 2)
    target = decode_block(SEND_KINDS[send_type], data[8 : 8 + BLOCK_BYTES], "mxt target", 8)
    return Request(command, target, monitors, counter, signals, timeouts)


def decode_reply(data: bytes) -> Reply:
    """Return the reply of one datagram; raises ``WireError``."""
    command, send_type, monitors, signals, timeouts, counter = _open(data)
    starts = (8, *(slot + _SLOT.size for slot in _SLOTS))
    first, second, third, fourth = (
        decode_block(MONITOR_KINDS[number], data[at : at + BLOCK_BYTES], "mxt reply", at)
        for number, at in zip(monitors, starts, strict=True)
    )
    blocks = (first, second, third, fourth)
    return Reply(command, send_type, monitors, blocks, counter, signals, timeouts)


def _open(data: bytes) -> tuple[Command, int, tuple[int, int, int, int], Signals, int, int]:
    expect_length(data, PACKET_BYTES, "mxt packet")
    number, send_type, first, _ = _HEAD.unpack_from(data, 0)
    try:
        command = Command(number)
    except ValueError as error:
        raise WireError("command", "mxt packet") from error
    *io, timeouts, counter = _SIGNALS.unpack_from(data, 48)
    second, third, fourth = (_SLOT.unpack_from(data, slot)[0] for slot in _SLOTS)
    monitors = (first, second, third, fourth)
    for number, at in zip(monitors, (4, *_SLOTS), strict=True):
        if number not in MONITOR_KINDS:
            raise WireError("type", "mxt packet", at)
    return command, send_type, monitors, Signals(*io), timeouts, counter

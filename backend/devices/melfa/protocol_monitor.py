"""Monitor packets of the controller."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass

from touchdown.backend.devices.framing import WireError, expect_length
from touchdown.backend.devices.melfa.protocol_mxt import (
    BLOCK_BYTES,
    Block,
    Kind,
    decode_block,
    encode_block,
    kind_of,
)

PACKET_BYTES = 196
START, END = 1, 255

_HEAD = struct.Struct("<4H")
_SIGNALS = struct.Struct("<2H3I")
_SLOT = struct.Struct("<2H")
_SLOTS = (64, 108, 152)

Kinds = Mapping[int, Kind]
"""What each data type number of this controller stands for; 0 is none."""
Types = tuple[int, int, int, int]


@dataclass(frozen=True, slots=True)
class Request:
    """START with four data types, or END."""

    command: int
    types: Types = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class Reply:
    """One cycle: four blocks, 32 input and output signals from their heads, and a counter."""

    types: Types
    blocks: tuple[Block, Block, Block, Block]
    counter: int
    input_head: int = 0
    output_head: int = 0
    inputs: int = 0
    outputs: int = 0


def encode_request(request: Request) -> bytes:
    """Return the 196 bytes."""
    return _join(request.command, request.types, (None,) * 4, bytes(_SIGNALS.size))


def decode_request(data: bytes) -> Request:
    """Return the request of one datagram; raises ``WireError``."""
    command, types = _open(data)
    return Request(command, types)


def encode_reply(reply: Reply, kinds: Kinds) -> bytes:
    """Return the 196 bytes."""
    if tuple(map(kind_of, reply.blocks)) != tuple(_kind(kinds, number) for number in reply.types):
        raise WireError("type", "monitor reply", 4)
    heads = reply.input_head, reply.output_head
    try:
        signals = _SIGNALS.pack(*heads, reply.inputs, reply.outputs, reply.counter)
    except struct.error as error:
        raise WireError("range", "monitor reply", 48) from error
    return _join(START, reply.types, reply.blocks, signals)


def decode_reply(data: bytes, kinds: Kinds) -> Reply:
    """Return the reply of one datagram; an unknown data type is a ``WireError``."""
    command, types = _open(data)
    if command != START:
        raise WireError("command", "monitor reply")
    starts = (8, *(slot + _SLOT.size for slot in _SLOTS))
    first, second, third, fourth = (
        decode_block(_kind(kinds, number), data[at : at + BLOCK_BYTES], "monitor reply", at)
        for number, at in zip(types, starts, strict=True)
    )
    input_head, output_head, inputs, outputs, counter = _SIGNALS.unpack_from(data, 48)
    blocks = (first, second, third, fourth)
    return Reply(types, blocks, counter, input_head, output_head, inputs, outputs)


def _kind(kinds: Kinds, number: int) -> Kind:
    if number == 0:
        return Kind.NONE
    if number not in kinds:
        raise WireError("type", "monitor reply", 4)
    return kinds[number]


def _join(command: int, types: Types, blocks: tuple[Block, ...], signals: bytes) -> bytes:
    first, *others = types
    try:
        parts = [_HEAD.pack(command, 0, first, 0), encode_block(blocks[0]), signals]
        for number, block in zip(others, blocks[1:], strict=True):
            parts += [_SLOT.pack(number, 0), encode_block(block)]
    except struct.error as error:
        raise WireError("range", "monitor packet") from error
    return b"".join(parts)


def _open(data: bytes) -> tuple[int, Types]:
    expect_length(data, PACKET_BYTES, "monitor packet")
    command, _, first, _ = _HEAD.unpack_from(data, 0)
    if command not in (START, END):
        raise WireError("command", "monitor packet")
    second, third, fourth = (_SLOT.unpack_from(data, slot)[0] for slot in _SLOTS)
    return command, (first, second, third, fourth)

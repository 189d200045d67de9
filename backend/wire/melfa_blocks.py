"""The 40-byte data blocks that MELFA's real-time packets share: mm and rad, little-endian.

Source: CR800 Ethernet Function manual BFP-A3379, 3.3.2 and 3.4.5.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from enum import Enum

from backend.wire.framing import WireError

BLOCK_BYTES = 40

_POSE = struct.Struct("<8f2I")
_FLOATS = struct.Struct("<8f8x")
_INTEGERS = struct.Struct("<8i8x")
_FORCE = struct.Struct("<6f16x")
_ROBMON = struct.Struct("<6f2h6shI")


class Kind(Enum):
    """What a block holds."""

    NONE = "none"
    POSE = "pose"
    JOINT = "joint"
    PULSE = "pulse"
    CURRENT = "current"
    FORCE = "force"
    FLOATS = "float8"
    ROBMON = "robmon"


@dataclass(frozen=True, slots=True)
class Pose:
    """x, y, z (mm), rotations a, b, c about X, Y, Z (rad), l1, l2, and the structure flags."""

    axes: tuple[float, ...]
    flag1: int
    flag2: int


@dataclass(frozen=True, slots=True)
class Values:
    """Eight joints (rad), pulses, currents (%), plain numbers, or six of force (N, N·m)."""

    kind: Kind
    axes: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class RobotMonitor:
    """State of motion: speeds mm/s, distances mm, transport factor %.

    ``accelerating``: 0 stopped, 1 accelerating, 2 constant, 3 decelerating.
    """

    speed_feedback_mm_s: float
    remaining_feedback_mm: float
    speed_command_mm_s: float
    remaining_command_mm: float
    gap: float
    transport_factor: float
    accelerating: int
    step: int
    program: str
    temperature_c: float
    cycle_counter: int


Block = Pose | Values | RobotMonitor | None

_LAYOUTS = {
    Kind.JOINT: _FLOATS,
    Kind.FLOATS: _FLOATS,
    Kind.PULSE: _INTEGERS,
    Kind.CURRENT: _INTEGERS,
    Kind.FORCE: _FORCE,
}


def kind_of(block: Block) -> Kind:
    """Return what ``block`` holds."""
    if block is None:
        return Kind.NONE
    if isinstance(block, Pose):
        return Kind.POSE
    return block.kind if isinstance(block, Values) else Kind.ROBMON


def encode_block(block: Block) -> bytes:
    """Return 40 bytes; raises ``WireError`` for numbers that are none or do not fit."""
    try:
        return _pack(block)
    except (struct.error, OverflowError, ValueError) as error:
        raise WireError("range", "melfa block") from error


def _pack(block: Block) -> bytes:
    if block is None:
        return bytes(BLOCK_BYTES)
    if isinstance(block, Pose):
        return _POSE.pack(*_finite(block.axes), block.flag1, block.flag2)
    if isinstance(block, Values):
        return _LAYOUTS[block.kind].pack(*_finite(block.axes))
    numbers = (
        block.speed_feedback_mm_s,
        block.remaining_feedback_mm,
        block.speed_command_mm_s,
        block.remaining_command_mm,
        block.gap,
        block.transport_factor,
    )
    name = block.program.encode("ascii")
    if len(name) > 6:
        raise WireError("length", "melfa program name")
    tenths = round(block.temperature_c * 10)
    return _ROBMON.pack(
        *_finite(numbers), block.accelerating, block.step, name, tenths, block.cycle_counter
    )


def decode_block(kind: Kind, data: bytes, where: str, offset: int) -> Block:
    """Return the block of 40 bytes; ``where`` and ``offset`` name it in an error."""
    try:
        return _unpack(kind, data)
    except WireError as error:
        raise WireError(error.what, where, offset) from error


def _unpack(kind: Kind, data: bytes) -> Block:
    if kind is Kind.NONE:
        return None
    if kind is Kind.POSE:
        *axes, flag1, flag2 = _POSE.unpack(data)
        return Pose(_finite(tuple(axes)), flag1, flag2)
    if kind is not Kind.ROBMON:
        return Values(kind, _finite(_LAYOUTS[kind].unpack(data)))
    *numbers, accelerating, step, name, tenths, counter = _ROBMON.unpack(data)
    program = name.rstrip(b"\x00")
    if not program.isascii() or b"\x00" in program:
        raise WireError("text", "melfa program name")
    a, b, c, d, e, f = _finite(tuple(numbers))
    text = program.decode("ascii")
    return RobotMonitor(a, b, c, d, e, f, accelerating, step, text, tenths / 10, counter)


def _finite(numbers: tuple[float, ...]) -> tuple[float, ...]:
    # The sum is none if a number is none, and found several times as fast.
    if not math.isfinite(sum(numbers)) and not all(map(math.isfinite, numbers)):
        raise WireError("number", "melfa block")
    return numbers


def turns(flag2: int) -> tuple[int, ...]:
    """Return the turn counts of J1 to J8, -8 to 7, that ``flag2`` packs."""
    nibbles = (flag2 >> 4 * joint & 0xF for joint in range(8))
    return tuple(nibble - 16 if nibble & 8 else nibble for nibble in nibbles)

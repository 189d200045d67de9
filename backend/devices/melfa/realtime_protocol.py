"""Real-time packets of a MELFA controller: external control (MXT), monitor.

Packets of 196 bytes with 40-byte data blocks; mm and rad, little-endian. The data type numbers of
the monitor are settings. Source: CR800 Ethernet Function manual BFP-A3379, 3.3.2, 3.4.5, tables 3-1
to 3-7. Joint data of the RV-5AS-D: arm model and joint limits of the vendor's ROS 2 driver.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum, IntEnum

from touchdown.backend.devices.framing import ProtocolError, range_errors, require_length

BLOCK_BYTES = 40

_POSE = struct.Struct("<8f2I")
_FLOATS = struct.Struct("<8f8x")
_INTEGERS = struct.Struct("<8i8x")
_FORCE = struct.Struct("<6f16x")


class BlockKind(Enum):
    """Content of a data block."""

    NONE = "none"
    POSE = "pose"
    JOINT = "joint"
    PULSE = "pulse"
    CURRENT = "current"
    FORCE = "force"
    FLOATS = "float8"


@dataclass(frozen=True, slots=True)
class MelfaPose:
    """x, y, z (mm), rotations a, b, c about X, Y, Z (rad), l1, l2, and the structure flags."""

    axes: tuple[float, ...]
    flag1: int
    flag2: int


@dataclass(frozen=True, slots=True)
class AxisValues:
    """Eight joints (rad), pulses, currents (%), plain numbers, or six of force (N, N·m)."""

    kind: BlockKind
    axes: tuple[float, ...]


Block = MelfaPose | AxisValues | None
Blocks = tuple[Block, ...]  # four

_LAYOUTS = {
    BlockKind.JOINT: _FLOATS,
    BlockKind.FLOATS: _FLOATS,
    BlockKind.PULSE: _INTEGERS,
    BlockKind.CURRENT: _INTEGERS,
    BlockKind.FORCE: _FORCE,
}


def kind_of(block: Block) -> BlockKind:
    """Return the kind of ``block``."""
    if block is None:
        return BlockKind.NONE
    return BlockKind.POSE if isinstance(block, MelfaPose) else block.kind


def encode_block(block: Block) -> bytes:
    """Return 40 bytes; raises ``ProtocolError`` for numbers that are not finite or out of range."""
    with range_errors("melfa block"):
        if block is None:
            return bytes(BLOCK_BYTES)
        if isinstance(block, MelfaPose):
            return _POSE.pack(*_finite(block.axes), block.flag1, block.flag2)
        return _LAYOUTS[block.kind].pack(*_finite(block.axes))


def decode_block(kind: BlockKind, data: bytes, where: str, offset: int) -> Block:
    """Return the block of 40 bytes; ``where`` and ``offset`` name it in an error."""
    try:
        if kind is BlockKind.NONE:
            return None
        if kind is BlockKind.POSE:
            *axes, flag1, flag2 = _POSE.unpack(data)
            return MelfaPose(_finite(tuple(axes)), flag1, flag2)
        return AxisValues(kind, _finite(_LAYOUTS[kind].unpack(data)))
    except ProtocolError as error:
        raise ProtocolError(error.what, where, offset) from error


def _finite(numbers: tuple[float, ...]) -> tuple[float, ...]:
    # The sum is NaN if a number is NaN; testing it is several times faster.
    if not math.isfinite(sum(numbers)) and not all(map(math.isfinite, numbers)):
        raise ProtocolError("number", "melfa block")
    return numbers


def turns(flag2: int) -> tuple[int, ...]:
    """Return the turn counts of J1 to J8, -8 to 7, that ``flag2`` packs."""
    nibbles = (flag2 >> 4 * joint & 0xF for joint in range(8))
    return tuple(nibble - 16 if nibble & 8 else nibble for nibble in nibbles)


PACKET_BYTES = 196

_HEAD = struct.Struct("<4H")
_MXT_SIGNALS = struct.Struct("<6HI")
_SLOT = struct.Struct("<2H")
_SLOTS = (64, 108, 152)
_BLOCKS = (8, *(slot + _SLOT.size for slot in _SLOTS))
DataTypes = tuple[int, int, int, int]

SEND_KINDS = {0: BlockKind.NONE, 1: BlockKind.POSE, 2: BlockKind.JOINT, 3: BlockKind.PULSE}
# Content of each monitor type: 1-3 command, 4-6 after filter, 7-9 encoder, 10, 11 currents.
MONITOR_KINDS = {
    0: BlockKind.NONE,
    **dict.fromkeys((1, 4, 7), BlockKind.POSE),
    **dict.fromkeys((2, 5, 8), BlockKind.JOINT),
    **dict.fromkeys((3, 6, 9), BlockKind.PULSE),
    **dict.fromkeys((10, 11), BlockKind.CURRENT),
}


class MxtCommand(IntEnum):
    """Command of a packet; the first packet must be NONE."""

    NONE = 0
    MOVE = 1
    END = 255


@dataclass(frozen=True, slots=True)
class MxtRequest:
    """Request to the controller: an absolute ``target`` and four monitor types.

    ``signals``: digital signals: codes to send and receive (0 none, 1 output, 2 input), number of
    the first one, mask, and bits.
    """

    command: MxtCommand
    target: Block = None
    monitors: DataTypes = (0, 0, 0, 0)
    counter: int = 0
    signals: tuple[int, ...] = (0,) * 5
    timeouts: int = 0


@dataclass(frozen=True, slots=True)
class MxtReply:
    """Reply of the controller: the monitored ``blocks`` with their types.

    ``timeouts``: cycles without a packet; ``counter``: number of the exchange; both wrap.
    ``send_type`` repeats the type of the first block.
    """

    command: MxtCommand
    send_type: int
    monitors: DataTypes
    blocks: Blocks
    counter: int
    signals: tuple[int, ...] = (0,) * 5
    timeouts: int = 0


def encode_mxt_request(request: MxtRequest) -> bytes:
    """Return the 196 bytes; raises ``ProtocolError`` if a number is not finite or out of range."""
    kind = kind_of(request.target)
    send_type = next((code for code, known in SEND_KINDS.items() if known is kind), None)
    if send_type is None:
        raise ProtocolError("type", "mxt target", 2)
    return _encode_mxt(request, send_type, (request.target, None, None, None))


def encode_mxt_reply(reply: MxtReply) -> bytes:
    """Return the 196 bytes."""
    kinds = tuple(map(kind_of, reply.blocks))
    if kinds != tuple(MONITOR_KINDS.get(number) for number in reply.monitors):
        raise ProtocolError("type", "mxt reply", 4)
    return _encode_mxt(reply, reply.send_type, reply.blocks)


def _encode_mxt(packet: MxtRequest | MxtReply, send_type: int, blocks: Blocks) -> bytes:
    with range_errors("mxt packet"):
        signals = _MXT_SIGNALS.pack(*packet.signals, packet.timeouts, packet.counter)
        return _join_packet(packet.command, send_type, packet.monitors, blocks, signals)


def _join_packet(
    command: int, send_type: int, types: DataTypes, blocks: Blocks, signals: bytes
) -> bytes:
    first, *others = types
    parts = [_HEAD.pack(command, send_type, first, 0), encode_block(blocks[0]), signals]
    for number, block in zip(others, blocks[1:], strict=True):
        parts += [_SLOT.pack(number, 0), encode_block(block)]
    return b"".join(parts)


def _open_packet(data: bytes, where: str) -> tuple[int, int, DataTypes]:
    require_length(data, PACKET_BYTES, where)
    command, send_type, first, _ = _HEAD.unpack_from(data, 0)
    second, third, fourth = (_SLOT.unpack_from(data, slot)[0] for slot in _SLOTS)
    return command, send_type, (first, second, third, fourth)


def _decode_blocks(data: bytes, kinds: Iterable[BlockKind], where: str) -> Blocks:
    places = zip(kinds, _BLOCKS, strict=True)
    return tuple(decode_block(kind, data[at : at + BLOCK_BYTES], where, at) for kind, at in places)


def decode_mxt_request(data: bytes) -> MxtRequest:
    """Return the request of one datagram; raises ``ProtocolError``."""
    command, send_type, monitors, signals, timeouts, counter = _open_mxt_packet(data)
    if send_type not in SEND_KINDS:
        raise ProtocolError("type", "mxt request", 2)
    target = decode_block(SEND_KINDS[send_type], data[8 : 8 + BLOCK_BYTES], "mxt target", 8)
    return MxtRequest(command, target, monitors, counter, signals, timeouts)


def decode_mxt_reply(data: bytes) -> MxtReply:
    """Return the reply of one datagram; raises ``ProtocolError``."""
    command, send_type, monitors, signals, timeouts, counter = _open_mxt_packet(data)
    blocks = _decode_blocks(data, map(MONITOR_KINDS.__getitem__, monitors), "mxt reply")
    return MxtReply(command, send_type, monitors, blocks, counter, signals, timeouts)


def _open_mxt_packet(data: bytes) -> tuple[MxtCommand, int, DataTypes, tuple[int, ...], int, int]:
    number, send_type, monitors = _open_packet(data, "mxt packet")
    try:
        command = MxtCommand(number)
    except ValueError as error:
        raise ProtocolError("command", "mxt packet") from error
    *io, timeouts, counter = _MXT_SIGNALS.unpack_from(data, 48)
    for number, at in zip(monitors, (4, *_SLOTS), strict=True):
        if number not in MONITOR_KINDS:
            raise ProtocolError("type", "mxt packet", at)
    return command, send_type, monitors, tuple(io), timeouts, counter


START, END = 1, 255

_MONITOR_SIGNALS = struct.Struct("<2H3I")

# Kind of each data type number of this controller; 0 is none.
BlockKinds = Mapping[int, BlockKind]


@dataclass(frozen=True, slots=True)
class MonitorRequest:
    """START with four data types, or END."""

    command: int
    types: DataTypes = (0, 0, 0, 0)


@dataclass(frozen=True, slots=True)
class MonitorReply:
    """One cycle: four blocks, a counter, and ``signals``: the numbers of the first input and the
    first output, and 32 bits of each.
    """

    types: DataTypes
    blocks: Blocks
    counter: int
    signals: tuple[int, ...] = (0,) * 4


def encode_monitor_request(request: MonitorRequest) -> bytes:
    """Return the 196 bytes."""
    with range_errors("monitor packet"):
        signals = bytes(_MONITOR_SIGNALS.size)
        return _join_packet(request.command, 0, request.types, (None,) * 4, signals)


def decode_monitor_request(data: bytes) -> MonitorRequest:
    """Return the request of one datagram; raises ``ProtocolError``."""
    return MonitorRequest(*_open_monitor_packet(data))


def encode_monitor_reply(reply: MonitorReply, kinds: BlockKinds) -> bytes:
    """Return the 196 bytes."""
    if tuple(map(kind_of, reply.blocks)) != tuple(_kind(kinds, number) for number in reply.types):
        raise ProtocolError("type", "monitor reply", 4)
    with range_errors("monitor reply", 48):
        signals = _MONITOR_SIGNALS.pack(*reply.signals, reply.counter)
        return _join_packet(START, 0, reply.types, reply.blocks, signals)


def decode_monitor_reply(data: bytes, kinds: BlockKinds) -> MonitorReply:
    """Return the reply of one datagram; an unknown data type is a ``ProtocolError``."""
    command, types = _open_monitor_packet(data)
    if command != START:
        raise ProtocolError("command", "monitor reply")
    blocks = _decode_blocks(data, (_kind(kinds, number) for number in types), "monitor reply")
    *signals, counter = _MONITOR_SIGNALS.unpack_from(data, 48)
    return MonitorReply(types, blocks, counter, tuple(signals))


def _kind(kinds: BlockKinds, number: int) -> BlockKind:
    if number == 0:
        return BlockKind.NONE
    if number not in kinds:
        raise ProtocolError("type", "monitor reply", 4)
    return kinds[number]


def _open_monitor_packet(data: bytes) -> tuple[int, DataTypes]:
    command, _, types = _open_packet(data, "monitor packet")
    if command not in (START, END):
        raise ProtocolError("command", "monitor packet")
    return command, types


CYCLE_S = 0.0035  # control cycle of a CR800


@dataclass(frozen=True, slots=True)
class Joint:
    """One joint: ``axis`` of rotation, ``rise_mm`` along z from the joint before it.

    ``limit_rad`` in both directions, highest speed.
    """

    axis: str
    rise_mm: float
    limit_rad: float
    speed_rad_s: float

    @property
    def step_rad(self) -> float:
        """Largest step in one cycle at the highest speed."""
        return self.speed_rad_s * CYCLE_S


# J1 to J6; at zero the arm stands straight up.
JOINTS = (
    Joint("z", 0.0, 4.18879, 2.16421),
    Joint("y", 254.0, 2.58309, 2.16421),
    Joint("y", 410.0, 2.61799, 2.16421),
    Joint("z", 0.0, 3.49066, 3.4383),
    Joint("y", 500.0, 2.0944, 6.21337),
    Joint("z", 0.0, 3.49066, 6.28318),
)
FLANGE_MM = 125.0  # from the crossing of the wrist axes to the flange

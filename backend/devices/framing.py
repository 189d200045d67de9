"""Framing shared by the byte protocols of all makes.

Check values of the checksums over ``123456789``: X-25 906E, MODBUS 4B37 (catalogue of R. Williams
and G. Cook).
"""

from __future__ import annotations

import math
import struct
from binascii import crc_hqx
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from operator import xor
from typing import Generic, NamedTuple, TypeVar

from touchdown.backend.core import TouchdownError

Message = TypeVar("Message")


class ProtocolError(TouchdownError):
    """Bytes or a message that violate the protocol.

    ``what`` is one word such as "length" or "crc"; ``where`` names message and field; ``offset``
    counts bytes from the start of the message.
    """

    def __init__(self, what: str, where: str, offset: int = 0) -> None:
        super().__init__(f"{what} [{where}, byte {offset}]")
        self.what, self.where, self.offset = what, where, offset


@contextmanager
def range_errors(where: str, offset: int = 0) -> Iterator[None]:
    """Raise ``ProtocolError`` for a value that does not fit its field."""
    try:
        yield
    except (struct.error, OverflowError, ValueError) as error:
        raise ProtocolError("range", where, offset) from error


class FrameStep(NamedTuple, Generic[Message]):
    """Result of decoding at one position: ``length`` bytes are a message, rejected, or noise."""

    length: int
    message: Message | None = None
    refused: bool = False


# (bytes, position) -> step, or None if more bytes are needed.
TakeFrame = Callable[[bytes, int], FrameStep[Message] | None]

# (take, bytes, position of an incomplete message) -> True to skip it.
SkipUnfinished = Callable[[TakeFrame[Message], bytes, int], bool]


def two_in_a_row(take: TakeFrame[Message], data: bytes, at: int) -> bool:
    """Return True if two complete messages follow each other behind ``at``. A false header with a
    large length field then does not block the stream.
    """
    place = at + 1
    while place < len(data):
        first = take(data, place)
        if first is not None and first.message is not None:
            behind = place + first.length
            second = take(data, behind) if behind < len(data) else None
            if second is not None and second.message is not None:
                return True
        place += first.length if first is not None and first.message is None else 1
    return False


class MessageStream:
    """Bytes of an incomplete message of a stream, and counts of what is no message."""

    def __init__(self) -> None:
        self._rest = b""
        self.bad_frames = self.bad_in_a_row = self.discarded = 0

    @property
    def pending(self) -> int:
        """Number of bytes of an incomplete message."""
        return len(self._rest)

    def reset(self) -> None:
        """Discard an incomplete message; the counts stay."""
        self._rest = b""


class FrameStream(MessageStream, Generic[Message]):
    """Stream decoder of a protocol; ``take`` decodes one message at a position."""

    def __init__(
        self, take: TakeFrame[Message], overtake: SkipUnfinished[Message] = two_in_a_row
    ) -> None:
        super().__init__()
        self._take, self._overtake = take, overtake

    def feed(self, data: bytes) -> list[Message]:
        """Take the next bytes; return the messages they complete, oldest first."""
        rest, at = self._rest + data, 0
        messages: list[Message] = []
        while at < len(rest):
            step = self._take(rest, at)
            if step is None:
                if not self._overtake(self._take, rest, at):
                    break
                # Same result as for complete bytes, so that cutting the stream has no effect.
                step = FrameStep(1, refused=True)
            at += step.length
            self._count(step)
            if step.message is not None:
                messages.append(step.message)
        self._rest = rest[at:]
        return messages

    def _count(self, step: FrameStep[Message]) -> None:
        if step.message is None:
            self.discarded += step.length
        elif not step.refused:
            self.bad_in_a_row = 0
        if step.refused:
            self.bad_frames += 1
            self.bad_in_a_row += 1


def never_skip(take: TakeFrame[Message], data: bytes, at: int) -> bool:
    """Wait for the rest of every incomplete message."""
    return False


def require_length(data: bytes, length: int, where: str) -> None:
    """Raise ``ProtocolError`` unless ``data`` is exactly ``length`` bytes."""
    if len(data) != length:
        raise ProtocolError("length", where, min(len(data), length))


def noise_until(data: bytes, at: int, starts: bytes) -> FrameStep[Message]:
    """Return the step to the next byte that may start a message, at least one byte."""
    end = at + 1
    while end < len(data) and data[end] not in starts:
        end += 1
    return FrameStep(end - at)


def take_frame(
    data: bytes, at: int, length: int | None, starts: bytes, decode: Callable[[bytes], Message]
) -> FrameStep[Message] | None:
    """Return the step over the frame at ``at``.

    ``length`` is 0 if no frame starts there, None if it is not known yet. ``starts`` are the first
    bytes of all frames.
    """
    if length == 0:
        return noise_until(data, at, starts)
    if length is None or at + length > len(data):
        return None
    try:
        return FrameStep(length, decode(data[at : at + length]))
    except ProtocolError:
        return FrameStep(1, refused=True)


def _reflected_table(polynomial: int) -> tuple[int, ...]:
    def entry(crc: int) -> int:
        for _ in range(8):
            crc = crc >> 1 ^ (polynomial if crc & 1 else 0)
        return crc

    return tuple(map(entry, range(256)))


WSG_TABLE = tuple(crc_hqx(bytes([index]), 0) for index in range(256))  # polynomial 1021
_X25_TABLE = _reflected_table(0x8408)
_MODBUS_TABLE = _reflected_table(0xA001)


def _crc16(table: tuple[int, ...], data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = table[(crc ^ byte) & 0xFF] ^ crc >> 8
    return crc


def crc_wsg(data: bytes) -> int:
    """CRC of Weiss grippers, from the preamble on.

    Not in the catalogue: it combines the table of the unreflected polynomial with the update of the
    reflected form. Source: command set reference manual, firmware 2.2.0.
    """
    return _crc16(WSG_TABLE, data)


def crc16_x25(data: bytes) -> int:
    """CRC-16/X-25: polynomial 1021 reflected, start FFFF, final exclusive or FFFF."""
    return _crc16(_X25_TABLE, data) ^ 0xFFFF


def crc16_modbus(data: bytes) -> int:
    """CRC-16/MODBUS: polynomial 8005 reflected, start FFFF; sent low byte first."""
    return _crc16(_MODBUS_TABLE, data)


def sum16(data: bytes) -> int:
    """Sum of all bytes, 16 bits."""
    return sum(data) & 0xFFFF


def xor8(data: bytes) -> int:
    """Exclusive or of all bytes."""
    return reduce(xor, data, 0)


class LineStream(MessageStream, Generic[Message]):
    """Stream decoder of lines of at most ``longest`` bytes; ``parse`` gets a line without its end.

    If a device sends no line end, call ``flush`` after a silence.
    """

    def __init__(self, parse: Callable[[bytes], Message], longest: int) -> None:
        super().__init__()
        self._parse, self._longest, self._skipping = parse, longest, False

    def feed(self, data: bytes) -> list[Message]:
        """Take the next bytes; return the messages they complete, oldest first."""
        *whole, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        messages: list[Message] = []
        for line in whole:
            self._finish(line, messages)
        self._rest = rest
        if len(rest) > self._longest:
            self.discarded += len(rest)
            self._rest, self._skipping = b"", True
        return messages

    def flush(self) -> list[Message]:
        """Process the bytes received so far as a line."""
        messages: list[Message] = []
        line, self._rest = self._rest, b""
        self._finish(line, messages)
        return messages

    def reset(self) -> None:
        """Discard an incomplete line; the counts stay."""
        super().reset()
        self._skipping = False

    def _finish(self, line: bytes, messages: list[Message]) -> None:
        skipping, self._skipping = self._skipping, False
        if not line and not skipping:
            return
        try:
            if skipping or len(line) > self._longest:
                raise ProtocolError("length", "line", self._longest)
            messages.append(self._parse(line))
        except ProtocolError:
            self.discarded += len(line)
            self.bad_frames += 1
            self.bad_in_a_row += 1
        else:
            self.bad_in_a_row = 0


Vector3 = tuple[float, float, float]


class Wrench(NamedTuple):
    """Force (N) and torque (N·m) in the axes and with the sign of the sensor."""

    force_n: Vector3
    torque_nm: Vector3


# Wrench of a sample that is invalid.
NO_WRENCH = Wrench((math.nan, math.nan, math.nan), (math.nan, math.nan, math.nan))


def wrench_of(values: Sequence[float]) -> Wrench:
    """Return the wrench of six values, forces first; raises ``ProtocolError`` for another
    number.
    """
    if len(values) != 6:
        raise ProtocolError("length", "wrench", len(values))
    fx, fy, fz, mx, my, mz = values
    return Wrench((fx, fy, fz), (mx, my, mz))

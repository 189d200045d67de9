"""Byte protocol of OptoForce and OnRobot HEX sensors.

Big-endian frames with a sum, on the serial acquisition unit. Source: sensor data sheets as in the
public driver alknemeyer/optoforce.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

from touchdown.backend.devices import framing
from touchdown.backend.devices.identification import ProtocolSignature

# Rate of each ``speed`` code; 0 stops the stream.
SPEED_HZ = {0: 0, 1: 1000, 3: 333, 10: 100, 33: 30, 100: 10}
# Cut-off of each ``filter`` code.
FILTER_HZ = {0: None, 1: 500.0, 2: 150.0, 3: 50.0, 4: 15.0, 5: 5.0, 6: 1.5}
ZERO_NOW = 255

_CONFIG, _ACK, _FRAME = b"\xaa\x00\x32\x03", b"\xaa\x00\x50\x01", b"\xaa\x07\x08"
_AXES = {0x0A: 3, 0x10: 6, 0x1C: 12}
_OVERLOADS = ((9, "Fx"), (8, "Fy"), (7, "Fz"), (6, "Tx"), (5, "Ty"), (4, "Tz"))


@dataclass(frozen=True, slots=True)
class OptoforceConfig:
    """Codes of ``SPEED_HZ`` and ``FILTER_HZ``; ``zero`` is 0, or 255 to tare the sensor."""

    speed: int
    filter: int
    zero: int = 0


@dataclass(frozen=True, slots=True)
class OptoforceAck:
    """Answer to a configuration; ``status`` 0 is success."""

    status: int


@dataclass(frozen=True, slots=True)
class OptoforceFrame:
    """One sample of 3, 6 or 12 axes; ``count`` wraps at 65536."""

    count: int
    status: int
    counts: tuple[int, ...]

    @property
    def daq(self) -> int:
        """Fault of the acquisition unit: 1 error, 2 communication; 0 for none."""
        return self.status >> 13

    @property
    def sensor(self) -> int:
        """Fault of the sensor: 1 not detected, 2 failure, 4 temperature; 0 for none."""
        return self.status >> 10 & 7

    @property
    def overload(self) -> tuple[str, ...]:
        """Axes over their capacity."""
        return tuple(name for bit, name in _OVERLOADS if self.status >> bit & 1)

    def scaled(self, counts_at_capacity: Sequence[float], capacity: Sequence[float]) -> list[float]:
        """Return N (N·m) per axis, by the sensor's data sheet."""
        triples = zip(self.counts, counts_at_capacity, capacity, strict=True)
        return [count / full * load for count, full, load in triples]

    def wrench(
        self, counts_at_capacity: Sequence[float], capacity: Sequence[float]
    ) -> framing.Wrench:
        """Return the wrench of a sensor of six axes."""
        return framing.wrench_of(self.scaled(counts_at_capacity, capacity))


OptoforceMessage = OptoforceFrame | OptoforceAck


def encode(message: OptoforceMessage | OptoforceConfig) -> bytes:
    """Return the bytes of any message of this protocol."""
    with framing.range_errors("optoforce message", 4):
        body = _body(message)
    return body + struct.pack(">H", framing.sum16(body))


def _body(message: OptoforceMessage | OptoforceConfig) -> bytes:
    if isinstance(message, OptoforceConfig):
        return _CONFIG + bytes((message.speed, message.filter, message.zero))
    if isinstance(message, OptoforceAck):
        return _ACK + bytes((message.status,))
    kind = {axes: code for code, axes in _AXES.items()}.get(len(message.counts))
    if kind is None:
        raise framing.ProtocolError("length", "optoforce frame", 8)
    content = struct.pack(
        f">HH{len(message.counts)}h", message.count, message.status, *message.counts
    )
    return _FRAME + bytes((kind,)) + content


def decode(frame: bytes) -> OptoforceMessage:
    """Return the message of one whole frame from the sensor; raises ``ProtocolError``."""
    body = _summed(frame)
    if body[:4] == _ACK:
        return OptoforceAck(body[4])
    count, status, *counts = struct.unpack(f">HH{_AXES[body[3]]}h", body[4:])
    return OptoforceFrame(count, status, tuple(counts))


def incoming() -> framing.FrameStream[OptoforceMessage]:
    """Return the decoder of the sensor's messages."""
    return framing.FrameStream(_take)


def requests() -> framing.FrameStream[OptoforceConfig]:
    """Return the decoder of configurations."""
    return framing.FrameStream(_take_request)


def _summed(frame: bytes) -> bytes:
    if framing.sum16(frame[:-2]) != int.from_bytes(frame[-2:], "big"):
        raise framing.ProtocolError("sum", "optoforce frame", len(frame) - 2)
    return frame[:-2]


def _length(data: bytes, at: int) -> int | None:
    """Return the length of the frame at ``at``; 0 if none starts there, None if unknown yet."""
    head = data[at : at + 4]
    if head == _ACK:
        return 7
    if len(head) == 4 and head[:3] == _FRAME:
        return 10 + 2 * _AXES[head[3]] if head[3] in _AXES else 0
    return None if len(head) < 4 and (_ACK.startswith(head) or _FRAME.startswith(head)) else 0


def _take(data: bytes, at: int) -> framing.FrameStep[OptoforceMessage] | None:
    return framing.take_frame(data, at, _length(data, at), b"\xaa", decode)


def _take_request(data: bytes, at: int) -> framing.FrameStep[OptoforceConfig] | None:
    length = 9 if _CONFIG.startswith(data[at : at + 4]) else 0
    return framing.take_frame(data, at, length, b"\xaa", lambda f: OptoforceConfig(*_summed(f)[4:]))


SIGNATURES = (
    ProtocolSignature(
        "optoforce", "an OptoForce force/torque sensor", b"", incoming, (OptoforceFrame,), 2
    ),
)

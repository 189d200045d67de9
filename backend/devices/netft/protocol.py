"""Datagram protocol of ATI Net F/T, Ethernet Axia and OnRobot compute box.

RDT datagrams, big-endian. Source: ATI 9610-05 and 9620-05 chapters 10 and 12; public clients
CameronDevine/NetFT and netft/pyNetFT.
"""

from __future__ import annotations

import math
import re
import struct
from dataclasses import dataclass
from enum import IntEnum

from touchdown.backend.devices import framing

HEADER = 0x1234
RECORD_BYTES = 36
TCP_REQUEST = b"\x01" + bytes(19)  # request for the calibration on the TCP channel
UNIT_NEWTON, UNIT_NEWTON_METRE = 2, 3

_REQUEST = struct.Struct(">HHI")
_RECORD = struct.Struct(">3I6i")
_CALIBRATION = struct.Struct(">HBB2I6H")


class RdtCommand(IntEnum):
    """Requests; the last two exist on OnRobot boxes only and are unconfirmed."""

    STOP = 0x0000
    START_AXIA = 0x0001
    START = 0x0002
    START_BUFFERED = 0x0003
    BIAS = 0x0042
    FILTER = 0x0082
    SPEED = 0x0083


@dataclass(frozen=True, slots=True)
class RdtRequest:
    """Request for ``count`` records, 0 for an endless stream."""

    command: int
    count: int = 0


@dataclass(frozen=True, slots=True)
class RdtRecord:
    """One sample; ``status`` other than 0 is a fault of the sensor."""

    rdt_sequence: int
    ft_sequence: int
    status: int
    counts: tuple[int, ...]

    def wrench(self, counts_per_n: float, counts_per_nm: float) -> framing.Wrench:
        """Scale by the calibration of the sensor."""
        forces, torques = self.counts[:3], self.counts[3:]
        return framing.wrench_of(
            [*(c / counts_per_n for c in forces), *(c / counts_per_nm for c in torques)]
        )


@dataclass(frozen=True, slots=True)
class Calibration:
    """Answer on the TCP channel; ``scale`` as sent."""

    force_unit: int
    torque_unit: int
    counts_per_n: int
    counts_per_nm: int
    scale: tuple[int, ...]


def encode_request(request: RdtRequest) -> bytes:
    """Return the 8 bytes."""
    with framing.range_errors("rdt request", 2):
        return _REQUEST.pack(HEADER, request.command, request.count)


def decode_request(data: bytes) -> RdtRequest:
    """Return the request of one datagram; raises ``ProtocolError``."""
    framing.require_length(data, _REQUEST.size, "rdt request")
    header, command, count = _REQUEST.unpack(data)
    if header != HEADER:
        raise framing.ProtocolError("header", "rdt request")
    return RdtRequest(command, count)


def encode_records(records: tuple[RdtRecord, ...]) -> bytes:
    """Return one datagram."""
    with framing.range_errors("rdt record"):
        return b"".join(
            _RECORD.pack(r.rdt_sequence, r.ft_sequence, r.status, *r.counts) for r in records
        )


def decode_records(data: bytes) -> tuple[RdtRecord, ...]:
    """Return the records of one datagram, one or (buffered) several; raises ``ProtocolError``."""
    if not data or len(data) % RECORD_BYTES:
        raise framing.ProtocolError("length", "rdt record", len(data))
    rows = _RECORD.iter_unpack(data)
    return tuple(RdtRecord(rdt, ft, status, tuple(counts)) for rdt, ft, status, *counts in rows)


def encode_calibration(calibration: Calibration) -> bytes:
    """Return the answer on the TCP channel."""
    units = calibration.force_unit, calibration.torque_unit
    counts = calibration.counts_per_n, calibration.counts_per_nm
    with framing.range_errors("netft calibration"):
        return _CALIBRATION.pack(HEADER, *units, *counts, *calibration.scale)


def decode_calibration(data: bytes) -> Calibration:
    """Return the calibration; refuses units other than N and N·m."""
    framing.require_length(data, _CALIBRATION.size, "netft calibration")
    header, force_unit, torque_unit, per_n, per_nm, *scale = _CALIBRATION.unpack(data)
    if header != HEADER:
        raise framing.ProtocolError("header", "netft calibration")
    if (force_unit, torque_unit) != (UNIT_NEWTON, UNIT_NEWTON_METRE):
        raise framing.ProtocolError("unit", "netft calibration", 2)
    if not per_n or not per_nm:
        raise framing.ProtocolError("range", "netft calibration", 4)
    return Calibration(force_unit, torque_unit, per_n, per_nm, tuple(scale))


def decode_page(page: bytes) -> tuple[float, float]:
    """Return counts per N and per N·m from ``netftapi2.xml``; refuses other units."""

    def field(name: bytes) -> bytes:
        found = re.search(b"<" + name + rb">\s*([^<>\s]{1,20})\s*</" + name + b">", page)
        if found is None:
            raise framing.ProtocolError("field", f"netft page, {name.decode()}")
        return found[1]

    if field(b"scfgfu") != b"N" or field(b"scfgtu") not in (b"N-m", b"Nm"):
        raise framing.ProtocolError("unit", "netft page")
    try:
        counts = float(field(b"cfgcpf")), float(field(b"cfgcpt"))
    except ValueError as error:
        raise framing.ProtocolError("number", "netft page") from error
    if not all(math.isfinite(count) and count > 0 for count in counts):
        raise framing.ProtocolError("range", "netft page")
    return counts

"""Identification of an unexpected device by its protocol.

Used when the expected device does not answer, to name the one that does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from touchdown.backend.devices.bota import Boot, BotaFrame, incoming
from touchdown.backend.devices.dynpick import DynpickCommand, DynpickRecord, records
from touchdown.backend.devices.ft300 import FIRMWARE_REGISTER, Ft300Sample, Read, Registers
from touchdown.backend.devices.ft300 import encode as protocol_encode
from touchdown.backend.devices.ft300 import incoming as protocol_incoming_2
from touchdown.backend.devices.leptrino import (
    Info,
    LeptrinoCommand,
    LeptrinoSample,
    Plain,
    encode,
    packets,
)
from touchdown.backend.devices.optoforce import OptoforceFrame
from touchdown.backend.devices.optoforce import incoming as protocol_incoming
from touchdown.backend.devices.wsg import (
    Assignment,
    Query,
    WsgCommand,
    WsgReply,
    WsgRequest,
    encode_request,
    lines,
    replies,
)
from touchdown.backend.devices.wsg import encode as gcl_encode

LISTEN_S = 0.15
"""So long for what comes of itself, and for each answer."""
READ_S = 0.02


class _Decoder(Protocol):
    def feed(self, data: bytes) -> Sequence[object]: ...


@dataclass(frozen=True, slots=True)
class ProtocolSignature:
    """One protocol: its name in bench files, the device in words, and how it is known.

    ``request`` only reads, and no other device here moves or changes by its bytes; empty where
    the device speaks of itself. ``messages`` are the types that no noise is taken for, ``least``
    how many of them there must be.
    """

    name: str
    words: str
    request: bytes
    decoder: Callable[[], _Decoder]
    messages: tuple[type, ...]
    least: int = 1


PROTOCOL_SIGNATURES: Sequence[ProtocolSignature] = (
    ProtocolSignature(
        "binary", "a WSG gripper that speaks its binary protocol",
        encode_request(WsgRequest(WsgCommand.SYSTEM_STATE, (0, 0))),
        replies, (WsgReply,),
    ),
    ProtocolSignature(
        "gcl", "a WSG gripper that speaks its text protocol",
        b"\n" + gcl_encode(Query("GRIPSTATE")), lines, (Assignment,),
    ),
    ProtocolSignature(
        "leptrino", "a Leptrino force/torque sensor",
        encode(Plain(LeptrinoCommand.INFO)),
        packets, (Info, LeptrinoSample), 1,
    ),
    ProtocolSignature(
        "ft300", "a Robotiq FT300 force/torque sensor",
        protocol_encode(Read(FIRMWARE_REGISTER, 3)),
        protocol_incoming_2, (Registers, Ft300Sample),
    ),
    ProtocolSignature(
        "dynpick", "a Dynpick force/torque sensor", 2 * DynpickCommand.READ.value,
        records, (DynpickRecord,), 2,
    ),
    ProtocolSignature("bota", "a Bota force/torque sensor", b"", incoming, (Boot, BotaFrame), 2),
    ProtocolSignature(
        "optoforce", "an OptoForce force/torque sensor", b"", protocol_incoming,
        (OptoforceFrame,), 2,
    ),
)  # fmt: skip


def identify_device(
    send: Callable[[bytes], None], receive: Callable[[float], bytes], expected: str
) -> str:
    """Return who is at the other end, in words; nothing if nobody known, or ``expected`` itself.

    ``receive`` waits at most so many seconds; both may raise ``OSError``: then nobody is known.
    """
    heard = [(kind, kind.decoder()) for kind in PROTOCOL_SIGNATURES]
    known = {kind.name: 0 for kind in PROTOCOL_SIGNATURES}
    try:
        for request in (b"", *(kind.request for kind in PROTOCOL_SIGNATURES if kind.request)):
            if request:
                send(request)
            end_s = time.monotonic() + LISTEN_S
            while (left_s := end_s - time.monotonic()) > 0:
                data = receive(min(left_s, READ_S))
                for kind, decoder in heard if data else ():
                    known[kind.name] += sum(
                        isinstance(m, kind.messages) for m in decoder.feed(data)
                    )
                    if known[kind.name] >= kind.least:
                        return "" if kind.name == expected else kind.words
    except OSError:
        pass
    return ""

"""Who answers in the place of the device that was expected: devices are known by their protocol."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from backend.wire import bota, dynpick, leptrino, optoforce, robotiq_ft300, wsg_binary, wsg_gcl
from backend.wire.wsg_words import Command

LISTEN_S = 0.15
"""So long for what comes of itself, and for each answer."""
READ_S = 0.02


class _Decoder(Protocol):
    def feed(self, data: bytes) -> Sequence[object]: ...


@dataclass(frozen=True, slots=True)
class Kind:
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


KINDS: Sequence[Kind] = (
    Kind(
        "binary", "a WSG gripper that speaks its binary protocol",
        wsg_binary.encode_request(wsg_binary.Request(Command.SYSTEM_STATE, (0, 0))),
        wsg_binary.replies, (wsg_binary.Reply,),
    ),
    Kind(
        "gcl", "a WSG gripper that speaks its text protocol",
        b"\n" + wsg_gcl.encode(wsg_gcl.Query("GRIPSTATE")), wsg_gcl.lines, (wsg_gcl.Assignment,),
    ),
    Kind(
        "leptrino", "a Leptrino force/torque sensor",
        leptrino.encode(leptrino.Plain(leptrino.Command.INFO)),
        leptrino.packets, (leptrino.Info, leptrino.Sample), 1,
    ),
    Kind(
        "ft300", "a Robotiq FT300 force/torque sensor",
        robotiq_ft300.encode(robotiq_ft300.Read(robotiq_ft300.FIRMWARE_REGISTER, 3)),
        robotiq_ft300.incoming, (robotiq_ft300.Registers, robotiq_ft300.Sample),
    ),
    Kind(
        "dynpick", "a Dynpick force/torque sensor", 2 * dynpick.Command.READ.value,
        dynpick.records, (dynpick.Record,), 2,
    ),
    Kind("bota", "a Bota force/torque sensor", b"", bota.incoming, (bota.Boot, bota.Frame), 2),
    Kind(
        "optoforce", "an OptoForce force/torque sensor", b"", optoforce.incoming,
        (optoforce.Frame,), 2,
    ),
)  # fmt: skip


def who_answers(
    send: Callable[[bytes], None], receive: Callable[[float], bytes], expected: str
) -> str:
    """Return who is at the other end, in words; nothing if nobody known, or ``expected`` itself.

    ``receive`` waits at most so many seconds; both may raise ``OSError``: then nobody is known.
    """
    heard = [(kind, kind.decoder()) for kind in KINDS]
    known = {kind.name: 0 for kind in KINDS}
    try:
        for request in (b"", *(kind.request for kind in KINDS if kind.request)):
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

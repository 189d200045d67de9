"""Registry of the makes of arms and of plug-ins from other packages."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Protocol, TypeVar

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError, SampleStream
from touchdown.backend.devices.bota import Boot, Frame, incoming
from touchdown.backend.devices.dynpick import Command as protocol_Command
from touchdown.backend.devices.dynpick import Record, records
from touchdown.backend.devices.ft300 import FIRMWARE_REGISTER, Read, Registers
from touchdown.backend.devices.ft300 import Sample as protocol_Sample
from touchdown.backend.devices.ft300 import encode as protocol_encode
from touchdown.backend.devices.ft300 import incoming as protocol_incoming_2
from touchdown.backend.devices.leptrino import Command as protocol_Command_2
from touchdown.backend.devices.leptrino import Info, Plain, Sample, encode, packets
from touchdown.backend.devices.melfa import MelfaArm, SocketWires
from touchdown.backend.devices.optoforce import Frame as protocol_Frame
from touchdown.backend.devices.optoforce import incoming as protocol_incoming
from touchdown.backend.devices.protocols import Arm
from touchdown.backend.devices.ur import UrArm
from touchdown.backend.devices.wsg import (
    Assignment,
    Command,
    Query,
    Reply,
    Request,
    encode_request,
    lines,
    replies,
)
from touchdown.backend.devices.wsg import encode as protocol_gcl_encode

Maker = TypeVar("Maker")


def find_offered(group: str, name: str, shipped: Mapping[str, Maker], where: str) -> Maker:
    """Return what makes the driver ``name``; raises ``InputError`` for one nobody offers.

    A package offers a driver as ``name = "module:callable"`` under the entry points ``group``; one
    that ships cannot be replaced.
    """
    if name in shipped:
        return shipped[name]
    offered = {point.name: point for point in entry_points(group=group)}
    if name not in offered:
        raise no_driver(name, where, [*shipped, *sorted(offered)])
    try:
        maker: Maker = offered[name].load()
    except (ImportError, AttributeError) as error:
        raise InputError(
            f"The driver '{name}' cannot be loaded: {error}.", where, "Install its package anew."
        ) from error
    return maker


def no_driver(name: str, where: str, known: Sequence[str]) -> InputError:
    """Return the error of a driver that none of the installed packages offers."""
    return InputError(
        f"There is no driver '{name}'.",
        where,
        f"Use one of {', '.join(known)}, or install the package that offers it.",
    )


GROUP = "touchdown.arm"
"""Entry points: name -> callable(settings, now_s, wrench, poses) that returns an ``Arm``."""

ArmMaker = Callable[[HardwareSettings, Callable[[], float], SampleStream, SampleStream], Arm]


def make_arm(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> Arm:
    """Return the driver of ``melfa.driver``; raises ``InputError``.

    ``wrench``: untared samples of the wrist in the axes of the bench; ``poses`` takes what the arm
    measures of ``G``.
    """
    shipped: dict[str, ArmMaker] = {"melfa": _melfa, "ur": _ur}
    maker = find_offered(GROUP, settings.melfa.driver, shipped, "melfa.driver")
    return maker(settings, now_s, wrench, poses)


def _melfa(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> MelfaArm:
    return MelfaArm(SocketWires(settings.melfa, now_s), wrench, settings.melfa, now_s, poses)


def _ur(
    settings: HardwareSettings,
    now_s: Callable[[], float],
    wrench: SampleStream,
    poses: SampleStream,
) -> UrArm:
    return UrArm(settings.ur, now_s, wrench, poses)


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
        encode_request(Request(Command.SYSTEM_STATE, (0, 0))),
        replies, (Reply,),
    ),
    Kind(
        "gcl", "a WSG gripper that speaks its text protocol",
        b"\n" + protocol_gcl_encode(Query("GRIPSTATE")), lines, (Assignment,),
    ),
    Kind(
        "leptrino", "a Leptrino force/torque sensor",
        encode(Plain(protocol_Command_2.INFO)),
        packets, (Info, Sample), 1,
    ),
    Kind(
        "ft300", "a Robotiq FT300 force/torque sensor",
        protocol_encode(Read(FIRMWARE_REGISTER, 3)),
        protocol_incoming_2, (Registers, protocol_Sample),
    ),
    Kind(
        "dynpick", "a Dynpick force/torque sensor", 2 * protocol_Command.READ.value,
        records, (Record,), 2,
    ),
    Kind("bota", "a Bota force/torque sensor", b"", incoming, (Boot, Frame), 2),
    Kind(
        "optoforce", "an OptoForce force/torque sensor", b"", protocol_incoming,
        (protocol_Frame,), 2,
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

"""Identification of an unexpected device by its protocol.

When the expected device does not answer, the fault text names the device that does.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Protocol

from touchdown.backend.devices import registry

LISTEN_S = 0.15  # for unrequested messages, and for each answer
READ_S = 0.02


class _Decoder(Protocol):
    def feed(self, data: bytes) -> Sequence[object]: ...


@dataclass(frozen=True, slots=True)
class ProtocolSignature:
    """Identifying traits of one protocol.

    Parameters
    ----------
    name
        Protocol or driver name in the lab file.
    description
        Device, for the text of a fault.
    request
        Bytes that make the device answer. They must read only, and must not move or configure any
        other device. Empty if the device sends without a request.
    decoder
        Factory of the decoder of its messages.
    messages
        Message types that noise cannot imitate.
    least
        Number of such messages that identify the device.

    """

    name: str
    description: str
    request: bytes
    decoder: Callable[[], _Decoder]
    messages: tuple[type, ...]
    least: int = 1


def load_signatures() -> tuple[ProtocolSignature, ...]:
    """Return the signatures of all makes in the order of requests: the surest protocols first.

    The first call imports their protocols. Factories call it, so that no import delays the
    real-time process later.
    """
    return _load(registry.MAKES)


@cache
def _load(makes: tuple[registry.Make, ...]) -> tuple[ProtocolSignature, ...]:
    found = [signature for make in makes for signature in make.load_signatures()]
    return tuple(sorted(found, key=lambda signature: signature.least))


def identify_device(
    send: Callable[[bytes], None], receive: Callable[[float], bytes], expected: str
) -> str:
    """Return the description of the connected device.

    Parameters
    ----------
    send, receive
        Access to the wire. ``receive`` waits at most the given seconds. Both may raise ``OSError``.
    expected
        Name of the protocol or driver that was expected.

    Returns
    -------
    str
        Empty if the device is unknown, is the expected one, or if the wire fails.

    """
    signatures = load_signatures()
    decoders = [(signature, signature.decoder()) for signature in signatures]
    known = dict.fromkeys((signature.name for signature in signatures), 0)
    try:
        for request in (b"", *(s.request for s in signatures if s.request)):
            if request:
                send(request)
            end_s = time.monotonic() + LISTEN_S
            while (left_s := end_s - time.monotonic()) > 0:
                data = receive(min(left_s, READ_S))
                for signature, decoder in decoders if data else ():
                    known[signature.name] += sum(
                        isinstance(m, signature.messages) for m in decoder.feed(data)
                    )
                    if known[signature.name] >= signature.least:
                        return "" if signature.name == expected else signature.description
    except OSError:
        pass
    return ""

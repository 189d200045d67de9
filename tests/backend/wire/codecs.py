"""Every decoder of the layer, by device and direction: how bytes become messages and back."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from backend.wire import (
    bota,
    dynpick,
    leptrino,
    melfa_monitor,
    melfa_mxt,
    melfa_r3,
    net_ft,
    optoforce,
    robotiq_ft300,
    wsg_binary,
    wsg_gcl,
)
from backend.wire.framing import WireError
from backend.wire.melfa_blocks import Kind

MONITOR_KINDS = {901: Kind.FORCE, 902: Kind.ROBMON, 903: Kind.POSE, 904: Kind.FLOATS}
"""Stand-ins of the vectors for the data type numbers that no source gives."""


@dataclass(frozen=True)
class Codec:
    encode: Callable[[Any], bytes] | None
    stream: Callable[[], Any] | None = None
    datagram: Callable[[bytes], Any] | None = None
    end: bytes = b""
    exact: bool = True
    """Whether a decoded message is found again, byte by byte, in what was decoded."""

    def messages(self, data, cut=None):
        """Decode ``data``, a stream cut after each ``cut`` bytes, or one datagram."""
        if self.datagram is not None:
            try:
                return [self.datagram(data)]
            except WireError:
                return []
        decoder = self.stream()
        step = cut or max(1, len(data))
        return [m for at in range(0, len(data), step) for m in decoder.feed(data[at : at + step])]


def _monitor_reply(reply):
    return melfa_monitor.encode_reply(reply, MONITOR_KINDS)


def _monitor_message(data):
    return melfa_monitor.decode_reply(data, MONITOR_KINDS)


def _wsg_request(message):
    if isinstance(message, wsg_binary.Request):
        return wsg_binary.encode_request(message)
    raise WireError("type", "a refusal answers a frame that cannot be encoded")


OUT, IN = "pc-to-device", "device-to-pc"
CODECS: dict[tuple[str, str], Codec] = {
    ("melfa-mxt", OUT): Codec(
        melfa_mxt.encode_request, datagram=melfa_mxt.decode_request, exact=False
    ),
    ("melfa-mxt", IN): Codec(melfa_mxt.encode_reply, datagram=melfa_mxt.decode_reply, exact=False),
    ("melfa-monitor", OUT): Codec(
        melfa_monitor.encode_request, datagram=melfa_monitor.decode_request, exact=False
    ),
    ("melfa-monitor", IN): Codec(_monitor_reply, datagram=_monitor_message, exact=False),
    ("melfa-r3", OUT): Codec(
        melfa_r3.encode_request, stream=melfa_r3.requests, end=b"\r", exact=False
    ),
    ("melfa-r3", IN): Codec(melfa_r3.encode_reply, stream=melfa_r3.replies, end=b"\r"),
    ("wsg-binary", OUT): Codec(_wsg_request, stream=wsg_binary.requests),
    ("wsg-binary", IN): Codec(wsg_binary.encode_reply, stream=wsg_binary.replies),
    ("wsg-gcl", OUT): Codec(wsg_gcl.encode, stream=wsg_gcl.lines, exact=False),
    ("wsg-gcl", IN): Codec(wsg_gcl.encode, stream=wsg_gcl.lines, exact=False),
    ("dynpick", OUT): Codec(lambda command: command.value, stream=dynpick.command_stream),
    ("dynpick", IN): Codec(dynpick.encode_record, stream=dynpick.records),
    ("leptrino", OUT): Codec(leptrino.encode, stream=leptrino.packets),
    ("leptrino", IN): Codec(leptrino.encode, stream=leptrino.packets),
    ("robotiq-ft300", OUT): Codec(robotiq_ft300.encode, stream=robotiq_ft300.requests),
    ("robotiq-ft300", IN): Codec(robotiq_ft300.encode, stream=robotiq_ft300.incoming),
    ("bota", OUT): Codec(bota.encode, stream=bota.requests),
    ("bota", IN): Codec(bota.encode, stream=bota.incoming),
    ("optoforce", OUT): Codec(optoforce.encode, stream=optoforce.requests),
    ("optoforce", IN): Codec(optoforce.encode, stream=optoforce.incoming),
    ("netft", OUT): Codec(net_ft.encode_request, datagram=net_ft.decode_request),
    ("netft", IN): Codec(net_ft.encode_records, datagram=net_ft.decode_records),
}

"""Every decoder of the layer, by device and direction: how bytes become messages and back."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.framing import WireError
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import protocol_monitor, protocol_mxt, protocol_r3
from touchdown.backend.devices.melfa.protocol_mxt import Kind
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import protocol as wsg_binary
from touchdown.backend.devices.wsg import protocol_gcl

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
    return protocol_monitor.encode_reply(reply, MONITOR_KINDS)


def _monitor_message(data):
    return protocol_monitor.decode_reply(data, MONITOR_KINDS)


def _wsg_request(message):
    if isinstance(message, wsg_binary.Request):
        return wsg_binary.encode_request(message)
    raise WireError("type", "a refusal answers a frame that cannot be encoded")


OUT, IN = "pc-to-device", "device-to-pc"
CODECS: dict[tuple[str, str], Codec] = {
    ("melfa-mxt", OUT): Codec(
        protocol_mxt.encode_request, datagram=protocol_mxt.decode_request, exact=False
    ),
    ("melfa-mxt", IN): Codec(
        protocol_mxt.encode_reply, datagram=protocol_mxt.decode_reply, exact=False
    ),
    ("melfa-monitor", OUT): Codec(
        protocol_monitor.encode_request, datagram=protocol_monitor.decode_request, exact=False
    ),
    ("melfa-monitor", IN): Codec(_monitor_reply, datagram=_monitor_message, exact=False),
    ("melfa-r3", OUT): Codec(
        protocol_r3.encode_request, stream=protocol_r3.requests, end=b"\r", exact=False
    ),
    ("melfa-r3", IN): Codec(protocol_r3.encode_reply, stream=protocol_r3.replies, end=b"\r"),
    ("wsg-binary", OUT): Codec(_wsg_request, stream=wsg_binary.requests),
    ("wsg-binary", IN): Codec(wsg_binary.encode_reply, stream=wsg_binary.replies),
    ("wsg-gcl", OUT): Codec(protocol_gcl.encode, stream=protocol_gcl.lines, exact=False),
    ("wsg-gcl", IN): Codec(protocol_gcl.encode, stream=protocol_gcl.lines, exact=False),
    ("dynpick", OUT): Codec(lambda command: command.value, stream=dynpick.command_stream),
    ("dynpick", IN): Codec(dynpick.encode_record, stream=dynpick.records),
    ("leptrino", OUT): Codec(leptrino.encode, stream=leptrino.packets),
    ("leptrino", IN): Codec(leptrino.encode, stream=leptrino.packets),
    ("robotiq-ft300", OUT): Codec(robotiq_ft300.encode, stream=robotiq_ft300.requests),
    ("robotiq-ft300", IN): Codec(robotiq_ft300.encode, stream=robotiq_ft300.incoming),
    ("bota", OUT): Codec(protocol.encode, stream=protocol.requests),
    ("bota", IN): Codec(protocol.encode, stream=protocol.incoming),
    ("optoforce", OUT): Codec(optoforce.encode, stream=optoforce.requests),
    ("optoforce", IN): Codec(optoforce.encode, stream=optoforce.incoming),
    ("netft", OUT): Codec(net_ft.encode_request, datagram=net_ft.decode_request),
    ("netft", IN): Codec(net_ft.encode_records, datagram=net_ft.decode_records),
}

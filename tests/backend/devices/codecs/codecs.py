"""Every decoder of the layer, by device and direction: how bytes become messages and back."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from touchdown.backend.devices.bota import protocol
from touchdown.backend.devices.dynpick import protocol as dynpick
from touchdown.backend.devices.framing import ProtocolError
from touchdown.backend.devices.ft300 import protocol as robotiq_ft300
from touchdown.backend.devices.leptrino import protocol as leptrino
from touchdown.backend.devices.melfa import r3_protocol, realtime_protocol
from touchdown.backend.devices.melfa.realtime_protocol import BlockKind
from touchdown.backend.devices.netft import protocol as net_ft
from touchdown.backend.devices.optoforce import protocol as optoforce
from touchdown.backend.devices.wsg import gcl
from touchdown.backend.devices.wsg import protocol as wsg_binary

MONITOR_KINDS = {901: BlockKind.FORCE, 903: BlockKind.POSE, 904: BlockKind.FLOATS}
"""Stand-ins of the vectors for the data type numbers that no source gives."""


@dataclass(frozen=True)
class Codec:
    encode: Callable[[Any], bytes] | None
    stream: Callable[[], Any] | None = None
    datagram: Callable[[bytes], Any] | None = None
    end: bytes = b""
    exact: bool = True
    """True if a decoded message is found again, byte by byte, in what was decoded."""

    def messages(self, data, cut=None):
        """Decode ``data``, a stream cut after each ``cut`` bytes, or one datagram."""
        if self.datagram is not None:
            try:
                return [self.datagram(data)]
            except ProtocolError:
                return []
        decoder = self.stream()
        step = cut or max(1, len(data))
        return [m for at in range(0, len(data), step) for m in decoder.feed(data[at : at + step])]


def _monitor_reply(reply):
    return realtime_protocol.encode_monitor_reply(reply, MONITOR_KINDS)


def _monitor_message(data):
    return realtime_protocol.decode_monitor_reply(data, MONITOR_KINDS)


def _wsg_request(message):
    if isinstance(message, wsg_binary.WsgRequest):
        return wsg_binary.encode_request(message)
    raise ProtocolError("type", "a refusal answers a frame that cannot be encoded")


OUT, IN = "pc-to-device", "device-to-pc"
CODECS: dict[tuple[str, str], Codec] = {
    ("melfa-mxt", OUT): Codec(
        realtime_protocol.encode_mxt_request,
        datagram=realtime_protocol.decode_mxt_request,
        exact=False,
    ),
    ("melfa-mxt", IN): Codec(
        realtime_protocol.encode_mxt_reply, datagram=realtime_protocol.decode_mxt_reply, exact=False
    ),
    ("melfa-monitor", OUT): Codec(
        realtime_protocol.encode_monitor_request,
        datagram=realtime_protocol.decode_monitor_request,
        exact=False,
    ),
    ("melfa-monitor", IN): Codec(_monitor_reply, datagram=_monitor_message, exact=False),
    ("melfa-r3", OUT): Codec(
        r3_protocol.encode_request, stream=r3_protocol.requests, end=b"\r", exact=False
    ),
    ("melfa-r3", IN): Codec(r3_protocol.encode_reply, stream=r3_protocol.replies, end=b"\r"),
    ("wsg-binary", OUT): Codec(_wsg_request, stream=wsg_binary.requests),
    ("wsg-binary", IN): Codec(wsg_binary.encode_reply, stream=wsg_binary.replies),
    ("wsg-gcl", OUT): Codec(gcl.encode, stream=gcl.lines, exact=False),
    ("wsg-gcl", IN): Codec(gcl.encode, stream=gcl.lines, exact=False),
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

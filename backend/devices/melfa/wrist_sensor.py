"""Driver of the force sensor of a MELFA controller through its real-time monitor.

UDP, one packet per cycle. The number of its data type is only in the controller's manual (BFP-A3379
3.4.6): a setting without default.
"""

from __future__ import annotations

import threading

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import InputError
from touchdown.backend.devices import force_torque
from touchdown.backend.devices.framing import ProtocolError, wrench_of
from touchdown.backend.devices.melfa import realtime_protocol
from touchdown.backend.devices.melfa.realtime_protocol import (
    CYCLE_S,
    END,
    PACKET_BYTES,
    START,
    AxisValues,
    BlockKind,
    MonitorReply,
    MonitorRequest,
)
from touchdown.backend.devices.protocols import Identity

SETTLE_S = 0.05


class MelfaWrenchDriver(force_torque.DatagramDriver):
    """Old and repeated packets are dropped by their counter; a gap counts as lost."""

    baud = 0
    chunk = PACKET_BYTES

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        super().__init__()
        number = settings.melfa.monitor.type_force
        if number is None:
            raise InputError(
                "The number of the force in the real-time monitor is not known.",
                "melfa.monitor.type_force",
                "Copy it from section 3.4.6 of the controller's Ethernet manual, or name another "
                "sensor as ft.driver.",
            )
        self._number, self._address = number, address
        own = settings.melfa.fs
        self._rated = (own.rated_n,) * 3 + (own.rated_nm,) * 3

    @staticmethod
    def default_address(settings: HardwareSettings) -> str:
        """Return the address of the monitor on the arm's controller."""
        return f"udp://{settings.melfa.host}:{settings.melfa.monitor.port}"

    def start(
        self, link: force_torque.SensorLink, cancel: threading.Event
    ) -> force_torque.SensorDescription:
        """End an old stream, start one, and wait for the force."""
        self.stop(link)
        force_torque.pause(cancel, SETTLE_S)
        link.drain()
        self._last = None
        types = (self._number, 0, 0, 0)
        force_torque.ask(
            link,
            cancel,
            realtime_protocol.encode_monitor_request(MonitorRequest(START, types)),
            self._started,
        )
        identity = Identity("Mitsubishi Electric", "force sense", self._address, "")
        return force_torque.SensorDescription(identity, self._rated, CYCLE_S, numbered=True)

    def take(self, data: bytes) -> list[force_torque.WrenchReading]:
        """Return the sample of one datagram, unless it is old."""
        reply = self.decoded(data, self._decode)
        missed = None if reply is None else self.missed(reply.counter)
        if reply is None or missed is None:
            return []
        block = reply.blocks[0]
        assert isinstance(block, AxisValues)
        return [force_torque.WrenchReading(wrench_of(block.axes), missed)]

    def stop(self, link: force_torque.SensorLink) -> None:
        """Stop the stream; sent three times, because a datagram may be lost."""
        for _ in range(3):
            link.write(realtime_protocol.encode_monitor_request(MonitorRequest(END)))

    def _started(self, data: bytes) -> bool | None:
        return True if self.decoded(data, self._decode) is not None else None

    def _decode(self, data: bytes) -> MonitorReply:
        reply = realtime_protocol.decode_monitor_reply(data, {self._number: BlockKind.FORCE})
        if reply.types[0] != self._number:
            raise ProtocolError("type", "monitor reply", 4)
        return reply

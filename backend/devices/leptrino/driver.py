"""Driver of a Leptrino sensor."""

from __future__ import annotations

import threading
from typing import TypeVar

from touchdown.backend.config import HardwareSettings
from touchdown.backend.devices.force_torque import Greeting, Link, Reading, Refusals, ask, pause
from touchdown.backend.devices.leptrino import protocol
from touchdown.backend.devices.leptrino.protocol import (
    CLIP,
    Command,
    Filter,
    Info,
    Packet,
    Plain,
    Rated,
    Sample,
    Status,
)
from touchdown.backend.devices.protocols import Identity

RATE_HZ = 1000.0
SETTLE_S = 0.05
Wanted = TypeVar("Wanted", Info, Rated, Plain, Filter)


class LeptrinoLanguage:
    """The sensor numbers nothing: a frame that was refused counts as one sample lost."""

    baud = 460_800
    chunk = 50

    def __init__(self, settings: HardwareSettings, address: str) -> None:
        self._rate_hz = settings.ft.rate_hz or RATE_HZ
        self._decoder = protocol.packets()
        self._rated: tuple[float, ...] = ()
        self._seen_bad = 0

    def start(self, link: Link, cancel: threading.Event) -> Greeting:
        """Stop twice, ask who it is and for its rated loads, start the stream."""
        for _ in range(2):
            link.write(protocol.encode(Plain(Command.STOP)))
            pause(cancel, SETTLE_S)
        link.drain()
        self._decoder.reset()
        info = self._ask(link, cancel, Command.INFO, Info)
        self._rated = self._ask(link, cancel, Command.RATED, Rated).loads
        self._ask(link, cancel, Command.START, Plain)
        self._seen_bad = self._decoder.bad_frames
        identity = Identity("Leptrino", info.model, info.serial, info.firmware)
        return Greeting(identity, self._rated, 1.0 / self._rate_hz)

    def take(self, data: bytes) -> list[Reading]:
        """Return the samples."""
        readings = []
        for packet in self._decoder.feed(data):
            if isinstance(packet, Sample):
                missed = self._decoder.bad_frames - self._seen_bad
                self._seen_bad = self._decoder.bad_frames
                readings.append(self._reading(packet, missed))
        return readings

    @property
    def refusals(self) -> Refusals:
        """Frames that were none."""
        decoder = self._decoder
        return Refusals(decoder.bad_frames, decoder.bad_in_a_row, decoder.discarded)

    def stop(self, link: Link) -> None:
        """End the stream."""
        link.write(protocol.encode(Plain(Command.STOP)))

    def _ask(
        self, link: Link, cancel: threading.Event, command: Command, kind: type[Wanted]
    ) -> Wanted:
        def find(data: bytes) -> Wanted | None:
            for packet in self._decoder.feed(data):
                if isinstance(packet, kind) and _answers(packet, command):
                    return packet
            return None

        return ask(link, cancel, protocol.encode(Plain(command)), find)

    def _reading(self, sample: Sample, missed: int) -> Reading:
        overload = bool(sample.status & Status.OVER_RATING) or max(map(abs, sample.counts)) >= CLIP
        trouble = ""
        if sample.status & (Status.SENSOR | Status.CALIBRATION):
            trouble = f"The sensor reports a failure (status {sample.status})"
        return Reading(sample.wrench(self._rated), missed, overload, trouble)


def _answers(packet: Packet, command: Command) -> bool:
    return not isinstance(packet, Plain) or (packet.command == command and packet.code == 0)

"""The two protocols of a WSG: what the driver decides, as bytes, and what the gripper says of it.

The messages are those of the binary protocol; a language holds no thread and no wire.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from backend.devices.protocols import Identity
from backend.wire import wsg_binary
from backend.wire.wsg_binary import Reply, Request

MAKER = "Weiss Robotics"
TYPES = {0: "WSG", 1: "WSG 50"}
DECIMALS = 100


class GripperLanguage(Protocol):
    """One protocol, for one connection."""

    @property
    def bad_frames(self) -> int:
        """What could not be read so far."""

    def encode(self, requests: Iterable[Request]) -> bytes:
        """Return what to send for these requests, in their order."""

    def take(self, data: bytes) -> list[Reply]:
        """Return the replies that ``data`` completes, oldest first."""

    def due(self, now_s: float) -> bytes:
        """Return what is to be sent by the clock alone."""

    def identity(self, told: Reply, address: str) -> Identity:
        """Return who answers, by the reply to SYSTEM_INFO; ``address`` stands for a number."""


class BinaryLanguage:
    """The binary protocol: updates come of themselves and keep the connection alive."""

    def __init__(self) -> None:
        self._decoder = wsg_binary.replies()

    @property
    def bad_frames(self) -> int:
        """Frames that were none."""
        return self._decoder.bad_frames

    def encode(self, requests: Iterable[Request]) -> bytes:
        """Return the frames."""
        return b"".join(map(wsg_binary.encode_request, requests))

    def take(self, data: bytes) -> list[Reply]:
        """Return the replies."""
        return self._decoder.feed(data)

    def due(self, now_s: float) -> bytes:
        """Nothing."""
        return b""

    def identity(self, told: Reply, address: str) -> Identity:
        """Return type, serial number and firmware."""
        values = [int(value) for value in told.values] or [0, 0, 0, 0]
        kind, hardware, firmware, serial = values
        model = f"{TYPES.get(kind, 'WSG')}, hardware {hardware}"
        number = str(serial) if serial else address
        return Identity(MAKER, model, number, f"{firmware / DECIMALS:.2f}")

"""Choice of an emulated device, and its running servers."""

from __future__ import annotations

import socket
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from touchdown.backend.core import Finger, ImageArray, InputError
from touchdown.backend.emulation import fault_plan
from touchdown.backend.emulation.server import DeviceServer, EmulatedDevice, PtyServer, TcpServer

WrenchFunction = Callable[[float], Sequence[float]]  # time in s -> (6,) N and N·m
PictureFunction = Callable[[float], ImageArray | None]  # time in s -> picture, None if no new one
RequestT = TypeVar("RequestT")
BenchTables = Mapping[str, Mapping[str, object]]  # tables of a bench file


class RequestDecoder(Protocol[RequestT]):
    """Stream decoder of the requests to a sensor."""

    def feed(self, data: bytes) -> list[RequestT]:
        """Take the next bytes; return the requests they complete, oldest first."""


class SerialSensor(EmulatedDevice, Generic[RequestT]):
    """Base of emulated wrist sensors; ``wrench(now_s)`` returns (6,) N and N·m, sensor axes. A
    subclass gives ``_answer`` to a request and the ``_frame`` of a sample.
    """

    def __init__(self, wrench: WrenchFunction, requests: RequestDecoder[RequestT]) -> None:
        self._wrench, self._requests, self.pace = wrench, requests, fault_plan.SampleSchedule()

    def receive(self, now_s: float, data: bytes) -> bytes:
        """Process requests; return the answers."""
        return b"".join(self._answer(now_s, request) for request in self._requests.feed(data))

    def due(self, now_s: float) -> bytes:
        """Return the frames of the stream up to now."""
        lost, times_s = self.pace.due(now_s)
        self._skip(lost)
        return b"".join(map(self._frame, times_s))

    def _answer(self, now_s: float, request: RequestT) -> bytes:
        raise NotImplementedError

    def _frame(self, now_s: float) -> bytes:
        raise NotImplementedError

    def _skip(self, lost: int) -> None:
        """Count samples that are lost after a pause, if the sensor numbers its samples."""

    def _counts(self, now_s: float, per_unit: Sequence[float]) -> tuple[int, ...]:
        """Return the wrench in counts, by the counts per N and per N·m of each axis."""
        pairs = zip(self._wrench(now_s), per_unit, strict=True)
        return tuple(round(value * factor) for value, factor in pairs)


@dataclass(frozen=True, slots=True)
class EmulationChoice:
    """An emulated device and its wire.

    Parameters
    ----------
    kind
        Name of the make, as in ``touchdown emulate``.
    host, port
        Address to listen on; None takes a free port.
    tty
        Link to the pseudo terminal of a serial sensor.
    faults
        Planned faults.
    wrench
        Load on a wrist sensor, (6,) N and N·m as a function of time in s.
    part_mm
        Width of the piece between the jaws of a gripper, None for none.
    text
        True for a gripper with its text protocol.
    finger, serial, folder, film
        Of a camera: finger, serial number, folder of its devices, video or picture to show.
    pictures
        Of a camera: picture as a function of time in s, in place of ``film``.

    """

    kind: str
    host: str = "127.0.0.1"
    port: int | None = None
    tty: Path | None = None
    faults: fault_plan.FaultPlan = field(default_factory=fault_plan.FaultPlan)
    wrench: WrenchFunction = field(
        default_factory=lambda: fault_plan.add_noise(fault_plan.hanging_gripper)
    )
    part_mm: float | None = 20.0
    text: bool = False
    finger: Finger = "left"
    serial: str = ""
    folder: Path | None = None
    film: Path | None = None
    pictures: PictureFunction | None = None

    def network_port(self) -> int:
        """Return the port, 0 for a free one; raises ``InputError`` if ``tty`` is given."""
        if self.tty is not None:
            raise InputError(f"A {self.kind} has no serial port.", "--tty", "Give --port instead.")
        return self.port or 0


@dataclass(frozen=True, slots=True)
class Emulation:
    """The servers of one emulated device, the main one first, and its tables of a bench file."""

    fronts: tuple[DeviceServer, ...]
    bench: BenchTables

    def start(self) -> None:
        """Start to serve."""
        for front in self.fronts:
            front.start()

    def close(self) -> None:
        """Stop serving."""
        for front in self.fronts:
            front.close()


EVERY_ADDRESS = "0.0.0.0"  # noqa: S104


def own_address() -> str:
    """Return the address of this computer in its network, 127.0.0.1 without a network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # chooses the route, sends nothing
        except OSError:
            return "127.0.0.1"
        return str(probe.getsockname()[0])


def replace_host(tables: BenchTables, address: str) -> BenchTables:
    """Return tables that name ``address`` in place of "every address"."""
    return {
        name: {
            key: value.replace(EVERY_ADDRESS, address) if isinstance(value, str) else value
            for key, value in table.items()
        }
        for name, table in tables.items()
    }


def serve_serial(
    emulated: Callable[[WrenchFunction], SerialSensor[Any]],
    choice: EmulationChoice,
    faults: fault_plan.Faults,
    tables: BenchTables | None = None,
) -> Emulation:
    """Serve a wrist sensor on a pseudo terminal, or on a TCP port if one is given.

    Parameters
    ----------
    emulated
        Class of the emulated sensor; its wrench function applies ``faults``.
    choice
        Port or link to use.
    faults
        Faults of the wire and of the sample rate.
    tables
        Tables of the bench file beyond ``[ft]``.

    """
    sensor = emulated(fault_plan.apply_faults(choice.wrench, faults))
    sensor.pace.faults = faults
    front: DeviceServer
    if choice.port is not None or sys.platform == "win32":
        front = TcpServer(sensor, choice.host, choice.port or 0, faults=faults)
    else:
        front = PtyServer(sensor, faults=faults, link=choice.tty)
    return Emulation(
        (front,), {"ft": {"driver": choice.kind, "address": front.url}, **(tables or {})}
    )

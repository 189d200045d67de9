"""Registry of emulated devices by name, each behind the wire of the real one.

A camera without a scene shows a rendered gel that is gently sheared, or a recorded clip; a wrist
sensor feels a hanging gripper.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np

from touchdown.backend.config import HardwareSettings
from touchdown.backend.core import MARKERS, Finger, ImageArray, InputError
from touchdown.backend.devices.bota import EmulatedBota
from touchdown.backend.devices.dynpick import EmulatedDynpick
from touchdown.backend.devices.ft300 import EmulatedFt300
from touchdown.backend.devices.gelsight import SERIAL as SERIAL_NUMBER
from touchdown.backend.devices.gelsight import GelsightServer, PictureFunction
from touchdown.backend.devices.leptrino import EmulatedLeptrino
from touchdown.backend.devices.melfa import (
    TIMEOUT_CYCLES,
    TYPE_FORCE,
    EmulatedMelfa,
    EmulatedMonitor,
    MelfaServer,
)
from touchdown.backend.devices.netft import EmulatedCalibration, EmulatedNetFt, EmulatedPage
from touchdown.backend.devices.optoforce import CAPACITY, COUNTS, EmulatedOptoforce
from touchdown.backend.devices.wsg import EmulatedGcl, EmulatedWsg
from touchdown.backend.emulation import (
    DeviceServer,
    EmulatedDevice,
    FaultPlan,
    Faults,
    PtyServer,
    SampleSchedule,
    TcpServer,
    UdpServer,
    add_noise,
    apply_faults,
    hanging_gripper,
)
from touchdown.backend.simulation import TactileRenderer, load_gel_appearance, mirror_appearance

STILL_NOISE = 1.0
"""Grey levels added to a still picture: no living camera repeats itself."""


def sheared_gel(
    finger: Finger, amplitude_px: float = 3.0, period_s: float = 4.0, seed: int = 0
) -> PictureFunction:
    """Return the pictures of a gel whose markers swing to and fro by ``amplitude_px``."""
    look = load_gel_appearance() if finger == "left" else mirror_appearance(load_gel_appearance())
    optics = TactileRenderer(look, seed)
    hidden = np.zeros(MARKERS, dtype=np.bool_)

    def seen(now_s: float) -> ImageArray:
        swing_px = amplitude_px * math.sin(2 * math.pi * now_s / period_s)
        return optics.render(np.tile([swing_px, 0.5 * swing_px], (MARKERS, 1)), hidden)

    return seen


def recorded(path: Path, seed: int = 0) -> PictureFunction:
    """Return the pictures of a video, one a call, from the start again at its end; or of a still.

    Raises ``InputError`` if OpenCV reads neither.
    """
    still = cv2.imread(str(path)) if path.is_file() else None
    if still is not None:
        rng = np.random.default_rng(seed)
        flat = still.astype(np.float64)

        def trembling(now_s: float) -> ImageArray:
            noisy = flat + STILL_NOISE * rng.standard_normal(flat.shape)
            return np.asarray(np.clip(np.round(noisy), 0, 255), dtype=np.uint8)

        return trembling
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(
            "This is neither a picture nor a video.", str(path), "Name a file that OpenCV reads."
        )

    def playing(now_s: float) -> ImageArray:
        there, picture = capture.read()
        if not there:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0.0)
            there, picture = capture.read()
        return np.asarray(picture, dtype=np.uint8)

    return playing


WrenchFunction = Callable[[float], Sequence[float]]


class StreamingSensor(EmulatedDevice, Protocol):
    """A sensor that sends its samples of itself."""

    pace: SampleSchedule


SERIAL: dict[str, Callable[[WrenchFunction], StreamingSensor]] = {
    "dynpick": EmulatedDynpick,
    "leptrino": EmulatedLeptrino,
    "ft300": EmulatedFt300,
    "bota": EmulatedBota,
    "optoforce": EmulatedOptoforce,
}
"""Wrist sensors on a serial port."""
REHEARSED_CHECK_S = 0.5
"""Of a bench file: an emulated arm hurts nobody, so its idle check is short."""

FAULT_DEVICES = {
    **dict.fromkeys((*SERIAL, "netft", "monitor"), "force_torque"),
    "wsg": "gripper",
    "melfa": "arm",
    "gelsight": "tactile",
}
"""The device of a fault plan that each kind is."""


@dataclass(frozen=True, slots=True)
class EmulationChoice:
    """What to emulate and where; ``port`` 0 takes a free one.

    ``tty``: a name for the pseudo terminal of a serial sensor. ``wrench``: what a sensor feels, N
    and N·m by time. ``part_mm``: the piece between the jaws of a gripper, None for none;
    ``text``: it speaks its text protocol. A camera
    has a ``finger``, a ``serial`` number, a ``folder`` to be found in, and may play a ``film``.
    """

    kind: str
    host: str = "127.0.0.1"
    port: int | None = None
    tty: Path | None = None
    faults: FaultPlan = field(default_factory=FaultPlan)
    wrench: WrenchFunction = field(default_factory=lambda: add_noise(hanging_gripper))
    part_mm: float | None = 20.0
    text: bool = False
    finger: Finger = "left"
    serial: str = SERIAL_NUMBER
    folder: Path | None = None
    film: Path | None = None


@dataclass(frozen=True, slots=True)
class Emulation:
    """Fronts that belong together, the main one first, and what a bench file says of them."""

    fronts: tuple[DeviceServer, ...]
    bench: Mapping[str, Mapping[str, object]]

    def start(self) -> None:
        """Begin to serve."""
        for front in self.fronts:
            front.start()

    def close(self) -> None:
        """Stop serving."""
        for front in self.fronts:
            front.close()


def emulate(choice: EmulationChoice) -> Emulation:
    """Make the emulated device; raises ``InputError`` for a wire it cannot have."""
    if choice.kind not in FAULT_DEVICES:
        raise InputError(
            f"There is no emulated '{choice.kind}'.",
            "emulate",
            f"Use one of {', '.join(FAULT_DEVICES)}.",
        )
    if choice.tty is not None and choice.kind not in SERIAL:
        raise InputError(f"A {choice.kind} has no serial port.", "--tty", "Give --port instead.")
    if choice.tty is not None and choice.port is not None:
        raise InputError("A wire is either serial or TCP.", "--tty, --port", "Give one of them.")
    device = FAULT_DEVICES[choice.kind]
    device = f"{device}_{choice.finger}" if choice.kind == "gelsight" else device
    faults = Faults(device, choice.faults)
    try:
        if choice.kind in SERIAL:
            return _serial(choice, faults)
        return MAKERS[choice.kind](choice, faults)
    except OSError as error:
        where = str(choice.tty) if choice.tty else f"{choice.host}:{choice.port or 0}"
        raise InputError(
            f"The wire cannot be made: {error.strerror or error}.",
            where,
            "Choose another --port or --tty; ports below 1024 need special rights.",
        ) from error


def bench_toml(bench: Mapping[str, Mapping[str, object]]) -> str:
    """Return the tables of a bench file as TOML."""
    tables = (
        "\n".join([f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())])
        for name, table in bench.items()
    )
    return "\n\n".join(tables) + "\n"


def _serial(choice: EmulationChoice, faults: Faults) -> Emulation:
    device = SERIAL[choice.kind](apply_faults(choice.wrench, faults))
    device.pace.faults = faults
    front: DeviceServer
    if choice.port is not None or sys.platform == "win32":
        front = TcpServer(device, choice.host, choice.port or 0, faults=faults)
    else:
        front = PtyServer(device, faults=faults, link=choice.tty)
    bench: dict[str, Mapping[str, object]] = {"ft": {"driver": choice.kind, "address": front.url}}
    if choice.kind == "optoforce":
        bench["optoforce"] = {"counts": list(COUNTS), "capacity": list(CAPACITY)}
    return Emulation((front,), bench)


def _net_ft(choice: EmulationChoice, faults: Faults) -> Emulation:
    """Serve the datagrams on the port, the TCP channel below it, the page above."""
    port = choice.port or 0
    sensor = EmulatedNetFt(apply_faults(choice.wrench, faults))
    sensor.pace.faults = faults
    front = UdpServer(sensor, choice.host, port, faults=faults)
    channel = TcpServer(EmulatedCalibration(), choice.host, port - 1 if port else 0)
    page = TcpServer(EmulatedPage(), choice.host, port + 1 if port else 0)
    bench: dict[str, Mapping[str, object]] = {
        "ft": {"driver": "netft", "address": front.url},
        "netft": {"tcp_port": channel.address[1], "http_port": page.address[1]},
    }
    return Emulation((front, channel, page), bench)


def _monitor(choice: EmulationChoice, faults: Faults) -> Emulation:
    sensor = EmulatedMonitor(apply_faults(choice.wrench, faults))
    sensor.pace.faults = faults
    front = UdpServer(sensor, choice.host, choice.port or 0, faults=faults)
    bench: dict[str, Mapping[str, object]] = {
        "ft": {"driver": "melfa", "address": front.url},
        "melfa.monitor": {"type_force": TYPE_FORCE},
    }
    return Emulation((front,), bench)


def _wsg(choice: EmulationChoice, faults: Faults) -> Emulation:
    gripper = EmulatedWsg(part_mm=choice.part_mm, faults=faults)
    mouth: EmulatedDevice = EmulatedGcl(gripper) if choice.text else gripper
    front = TcpServer(mouth, choice.host, choice.port or 0, faults=faults)
    table: dict[str, object] = {"host": choice.host, "port": front.address[1]}
    return Emulation((front,), {"wsg": table | ({"protocol": "gcl"} if choice.text else {})})


def _melfa(choice: EmulationChoice, faults: Faults) -> Emulation:
    """Serve the stream on the port, commands and STOP above it: 10000 is as on a controller."""
    port = choice.port or 0
    ports = (port + 1, port + 2, port) if port else (0, 0, 0)
    settings = HardwareSettings.model_validate({"melfa": {"mxt": {"mxttout": TIMEOUT_CYCLES}}})
    front = MelfaServer(EmulatedMelfa(settings.melfa), choice.host, ports, faults=faults)
    return Emulation((front,), melfa_tables(front))


def melfa_tables(front: MelfaServer) -> dict[str, Mapping[str, object]]:
    """Return what a bench file says of an emulated arm."""
    told = front.settings
    return {
        "melfa": {"host": told.host, "idle_check_s": REHEARSED_CHECK_S},
        "melfa.r3": {"port": told.r3.port, "stop_port": told.r3.stop_port},
        "melfa.mxt": {"port": told.mxt.port, "mxttout": told.mxt.mxttout},
    }


def camera_tables(folder: Path, serials: Mapping[Finger, str]) -> dict[str, Mapping[str, object]]:
    """Return what a bench file says of emulated cameras."""
    names = {"by_id": "by-id", "names": "names", "nodes": "nodes"}
    places = {key: str((folder / name).resolve()) for key, name in names.items()}
    own = {f"gelsight.{finger}": {"serial": serial} for finger, serial in serials.items()}
    return {"gelsight": {**places, "crop_fraction": 0.0}, **own}


def _gelsight(choice: EmulationChoice, faults: Faults) -> Emulation:
    if choice.folder is None or choice.port is not None:
        raise InputError(
            "An emulated camera is a pipe in a folder.", "--folder", "Name a folder; no --port."
        )
    film = recorded(choice.film) if choice.film else sheared_gel(choice.finger)
    front = GelsightServer(film, choice.folder, choice.serial, faults=faults)
    return Emulation((front,), camera_tables(choice.folder, {choice.finger: choice.serial}))


MAKERS: dict[str, Callable[[EmulationChoice, Faults], Emulation]] = {
    "netft": _net_ft,
    "monitor": _monitor,
    "wsg": _wsg,
    "melfa": _melfa,
    "gelsight": _gelsight,
}

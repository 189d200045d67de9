"""Pulled plugs of emulated wrist sensors and cameras, in real time."""

import random
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from tests.backend.devices.optoforce.trials_wrist import (
    DATAGRAMS,
    EMULATED,
    LOAD,
    SETTINGS,
    TREMBLE,
)
from tests.backend.devices.waiting import until
from tests.bench.arm import LIMIT_S, Bench, in_contact
from tests.bench.figures import Figure, at_most, figure
from touchdown.backend.config.hardware import ForceTorqueSettings, GelsightSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, ImageArray, TactileFrame
from touchdown.backend.devices import DeviceState, Interlock, make_force_torque
from touchdown.backend.devices.cameras.sources import PictureSource, UvcSource, open_source
from touchdown.backend.devices.gelsight.driver import TactileCamera
from touchdown.backend.devices.gelsight.emulator import SERIAL as NUMBER
from touchdown.backend.devices.gelsight.emulator import GelsightServer, encode
from touchdown.backend.devices.safety_trips import GRACE_S, Supervision
from touchdown.backend.emulation import Faults, PtyServer, add_noise, apply_faults

SERIAL = [kind for kind in EMULATED if kind not in DATAGRAMS]
PULLS, LIFTS, REPLUGS = 10, 10, 20
LOOK_S, LATE_MS, FAULT_MS, JOIN_MS = 0.002, 100.0, 300.0, 1000.0
FRAME_LATE_MS, FRAME_FAULT_MS, BACK_MS = 120.0, 500.0, 2000.0
PERIOD_S, AWAY_S, ROSE_MM = 0.04, 4.0, 0.02
Times = list[float]


class Watched:
    """A driver, and the supervision that a session has of it; all else that it watches is well."""

    def __init__(self, wrist: Any = None, camera: Any = None) -> None:
        self.interlock = Interlock()
        self._own = camera
        self._frames: dict[Any, Stream[TactileFrame]] = {
            finger: Stream(f"tactile_{finger}", 256) for finger in FINGERS
        }
        if camera is not None:
            self._frames[camera.finger] = camera.frames
        self._wrist = wrist
        self._wrench = wrist.samples if wrist else SampleStream("force_torque", 6, 8192)
        self._supervision = Supervision(self.interlock, self._wrench, self._frames)
        self._rng = np.random.default_rng(1)
        self._next_s, self._number, self._pause = 0.0, 0, threading.Event()

    def begin(self) -> None:
        """Count from here, past the grace of a new scene."""
        self._supervision.begin(time.monotonic())
        end_s = time.monotonic() + GRACE_S + 0.1
        while time.monotonic() < end_s:
            self.look()

    def look(self) -> tuple[bool, bool]:
        """Let the other sensors be well, look; return whether something is late, and a fault."""
        now_s = time.monotonic()
        if now_s >= self._next_s:
            self._next_s, self._number = now_s + PERIOD_S, self._number + 1
            self._be_well(now_s)
        self._supervision.check(now_s)
        self._pause.wait(LOOK_S)
        return bool(self._supervision.degraded), bool(self.interlock.faults)

    def _be_well(self, now_s: float) -> None:
        for finger in FINGERS:
            if self._own is None or finger != self._own.finger:
                image: ImageArray = self._rng.integers(0, 255, (32, 32, 3), dtype=np.uint8)
                frame = TactileFrame(finger, self._number, now_s, image, None)
                self._frames[finger].put(now_s, frame)
        if self._wrist is None:
            self._wrench.put(np.array([now_s]), self._rng.normal(size=(1, 6)))


def _told(watched: Watched, driver: Any, pull: Callable[[], float]) -> tuple[float, float]:
    """Pull, at the instant that is returned; ms until it is told as late or worse, as a fault."""
    watched.begin()
    begun_s = pull()
    late_ms = fault_ms = float("inf")
    while fault_ms == float("inf") and time.monotonic() < begun_s + LIMIT_S:
        late, fault = watched.look()
        fault = fault or driver.state is DeviceState.FAULT
        spent_ms = 1e3 * (time.monotonic() - begun_s)
        late_ms = min(late_ms, spent_ms) if late or fault else late_ms
        fault_ms = spent_ms if fault else fault_ms
    return late_ms, fault_ms


def _pulled_s(front: PtyServer | GelsightServer, take_away: str) -> float:
    """Pull a plug; return when the wire was gone (monotonic)."""
    gone_s: list[float] = []
    away = getattr(front, take_away)

    def noted() -> None:
        away()
        gone_s.append(time.monotonic())

    setattr(front, take_away, noted)
    front.inject("unplug")
    until(lambda: gone_s)
    setattr(front, take_away, away)
    return gone_s[0]


def _row(name: str, took_ms: Times, most_ms: float) -> Figure:
    worst = max(took_ms)
    told = f"{len(took_ms)} times; median {np.median(took_ms):.0f} ms"
    return at_most(f"{name}, worst", worst, "ms", most_ms, told)


# -- wrist sensors --------------------------------------------------------------------------------


@figure("faults")
def plugs_of_wrist_sensors(pulls: int = PULLS, lifts: int = LIFTS) -> list[Figure]:
    """The terminal of each serial sensor is closed in mid-stream; the same in contact."""
    if sys.platform == "win32":
        return [Figure("plugs of wrist sensors", None, "", "", None, "no pseudo terminals")]
    late, fault, joined = list[float](), list[float](), list[float]()
    for kind in SERIAL:
        for _ in range(pulls):
            one = _pulled(kind)
            late.append(one[0])
            fault.append(one[1])
            joined.append(one[2])
    name = f"plug of a wrist sensor pulled ({', '.join(SERIAL)})"
    return [
        _row(f"{name}: degraded or worse", late, LATE_MS),
        _row("the same: a fault", fault, FAULT_MS),
        _row("the same: its thread has ended", joined, JOIN_MS),
        *_lifted(lifts),
    ]


def _pulled(kind: str) -> tuple[float, float, float]:
    faults = Faults("force_torque")
    sensor = EMULATED[kind](apply_faults(add_noise(lambda now_s: LOAD, TREMBLE), faults))
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        front = PtyServer(sensor, faults=faults, link=Path(folder) / "sensor")
        front.start()
        stack.callback(front.close)
        address = {"driver": kind, "address": front.url}
        wanted = ForceTorqueSettings.model_validate(address)
        settings = SETTINGS.model_copy(update={"ft": wanted})
        driver = make_force_torque(settings, time.monotonic)
        stack.callback(driver.close)
        driver.connect(5.0, threading.Event())
        late_ms, fault_ms = _told(Watched(driver), driver, lambda: _pulled_s(front, "_unplug"))
        begun_s = time.monotonic()
        driver.close()
        return late_ms, fault_ms, 1e3 * (time.monotonic() - begun_s)


def _lifted(lifts: int) -> list[Figure]:
    """Pull the plug of the sensor while the arm presses: when the arm begins to rise, how far."""
    began, rose_mm = list[float](), list[float]()
    bench = Bench()
    try:
        while len(began) < lifts:
            with suppress(FaultError):
                bench.above()
                in_contact(bench)
                before_s, lowest_mm = time.monotonic(), bench.height_mm()
                bench.served.wrist.inject("unplug")
                end_s, first_s = before_s + 3.0, None
                while time.monotonic() < end_s:
                    height_mm = bench.height_mm()
                    lowest_mm = min(lowest_mm, height_mm)
                    if first_s is None and height_mm > lowest_mm + ROSE_MM:
                        first_s = time.monotonic()
                        end_s = first_s + 0.5
                    bench.wait(LOOK_S)
                began.append(1e3 * (first_s - before_s) if first_s else float("inf"))
                rose_mm.append(bench.height_mm() - lowest_mm)
            bench.served.wrist.faults.clear()
            bench.backend.disconnect()
            bench.recover()
    finally:
        bench.close()
    least, most = min(rose_mm), max(rose_mm)
    told = f"{len(rose_mm)} times; {least:.2f} to {most:.2f} mm"
    worst, first = max(began), min(began)
    return [
        Figure("wrist sensor unplugged in contact: the arm begins to rise, latest", worst, "ms",
               "300 and what the arm lags",
               first >= FAULT_MS - 50.0 and worst <= FAULT_MS + 100.0,
               f"{len(began)} times; earliest {first:.0f}, median {np.median(began):.0f} ms"),
        Figure("wrist sensor unplugged in contact: rises by, least", least, "mm", "2",
               least >= 1.9 and most <= 2.3, told),
    ]  # fmt: skip


# -- cameras --------------------------------------------------------------------------------------


class StandIn:
    """Results of OpenCV for an unplugged camera: no picture, an empty or an old one."""

    def __init__(self, path: str, _: int) -> None:
        self._node = Path(path).resolve()
        self._pause, self._rng = threading.Event(), np.random.default_rng()
        self._old = self._taken()
        self.way = random.choice(("none", "empty", "old"))

    def _taken(self) -> np.ndarray:
        small = self._rng.integers(40, 200, (30, 40, 3))
        image = np.kron(small, np.ones((8, 8, 1))).astype(np.uint8)
        return np.frombuffer(encode(image), np.uint8)[None, :]

    def isOpened(self) -> bool:  # noqa: N802
        return self._node.exists()

    def set(self, number: int, value: float) -> bool:
        return True

    def get(self, number: int) -> float:
        return 1.0 / PERIOD_S

    def release(self) -> None:
        pass

    def read(self) -> tuple[bool, np.ndarray | None]:
        self._pause.wait(PERIOD_S)
        if self._node.exists():
            self._old = self._taken()
            return True, self._old
        if self.way == "none":
            return False, None
        return True, self._old if self.way == "old" else np.empty((0, 0), np.uint8)


def _standing_in(path: Path, settings: GelsightSettings) -> PictureSource:
    return UvcSource(path, settings, StandIn)


@contextmanager
def _camera(stand_in: bool) -> Iterator[tuple[TactileCamera, GelsightServer]]:
    """An emulated camera and its driver, connected; what is read of it may be stood in for."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder, rng = Path(name), np.random.default_rng(2)

        def seen(now_s: float) -> ImageArray:
            small = rng.integers(40, 200, (30, 40, 3))
            return np.asarray(np.kron(small, np.ones((8, 8, 1))), dtype=np.uint8)

        front = GelsightServer(seen, folder)
        front.start()
        stack.callback(front.close)
        places = {"by_id": "by-id", "names": "names", "nodes": "nodes"}
        content = {key: str(folder / place) for key, place in places.items()}
        own = {"left": {"serial": NUMBER}, "crop_fraction": 0.0}
        settings = GelsightSettings.model_validate({**content, **own})
        opened = _standing_in if stand_in else open_source
        driver = TactileCamera("left", settings, time.monotonic, open_camera=opened)
        stack.callback(driver.close)
        driver.connect(10.0, threading.Event())
        yield driver, front


@figure("faults")
def plugs_of_cameras(replugs: int = REPLUGS) -> list[Figure]:
    """A camera is unplugged and comes back: emulated, and a stand-in for what OpenCV has of one."""
    if sys.platform == "win32":
        return [Figure("plugs of cameras", None, "", "", None, "no named pipes")]
    late, fault, back = list[float](), list[float](), list[float]()
    rng = random.Random(4)
    for number in range(replugs):
        with _camera(stand_in=number % 2 == 1) as (driver, front):
            times = _told(Watched(camera=driver), driver, lambda: _pulled_s(front, "_pull"))
            late.append(times[0])
            fault.append(times[1])
            threading.Event().wait(rng.uniform(0.0, AWAY_S))
            before, begun_s = driver.frames.count, time.monotonic()
            front.faults.clear()
            until(lambda: driver.frames.count > before)  # noqa: B023 - called at once
            back.append(1e3 * (time.monotonic() - begun_s))
    return [
        _row("camera unplugged: degraded or worse", late, FRAME_LATE_MS),
        _row("the same: a fault", fault, FRAME_FAULT_MS),
        _row("the same: pictures again after its return", back, BACK_MS),
    ]

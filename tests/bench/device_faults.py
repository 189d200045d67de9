"""Faults of devices: damaged bytes on their lines, damaged pictures, and pulled plugs.

Pictures of real gels: none with lost packets is accepted, no accepted picture has a marker over
2 px off, and of those between 0.2 and 2 px at most half of what two gates leave (docs/faults.md,
C4). Also dropped frames (C5) and gels refused at connection (C6). Plugs are pulled in real time.
"""

import random
import sys
import tempfile
import threading
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import cache
from itertools import islice, permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tests.backend.devices.cameras.damage import GELSIGHT, KINDS, SCENES, outcomes
from tests.backend.devices.codecs.codecs import CODECS, IN
from tests.backend.devices.codecs.vectors import VECTORS, data
from tests.backend.devices.optoforce.trials_wrist import (
    DATAGRAMS,
    EMULATED,
    LOAD,
    SETTINGS,
    TREMBLE,
)
from tests.backend.devices.waiting import until
from tests.backend.runs.gel_bench import LOOKS, Gel, GelBench
from tests.bench.arm import LIMIT_S, Bench, in_contact
from tests.bench.figures import Figure, at_least, at_most, failures, figure
from touchdown.backend.calibration.cameras import HELD_LIMIT_PX, fingerprint_distance_px
from touchdown.backend.config.hardware import (
    ForceTorqueSettings,
    GelsightSettings,
    HardwareSettings,
)
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, FloatArray, ImageArray, TactileFrame
from touchdown.backend.devices import DeviceState, Interlock, make_force_torque
from touchdown.backend.devices.cameras.frames import PictureFilter
from touchdown.backend.devices.cameras.sources import PictureSource, UvcSource, open_source
from touchdown.backend.devices.dynpick.driver import PERIOD_S as DYNPICK_PERIOD_S
from touchdown.backend.devices.dynpick.driver import DynpickDriver
from touchdown.backend.devices.dynpick.protocol import DynpickRecord, encode_record
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.gelsight import SERIAL as NUMBER
from touchdown.backend.devices.gelsight import GelsightServer, TactileCamera
from touchdown.backend.devices.gelsight.emulator import encode
from touchdown.backend.devices.safety_trips import GRACE_S, Supervision
from touchdown.backend.emulation import Faults, PtyServer, add_noise, apply_faults
from touchdown.backend.sensing import measure_rest, read_pictures
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker
from touchdown.backend.simulation.finger_camera import GelAppearance

NOISE_BYTES, PIECE, BLOCK = 10_000_000, 256, 1_000_000
# data rate of the fastest serial line of a device
LINE_BYTES_S = {
    "dynpick": 92_160, "leptrino": 46_080, "bota": 46_080, "optoforce": 92_160,
    "robotiq-ft300": 1_920, "wsg-binary": 11_520, "wsg-gcl": 11_520, "melfa-r3": 11_520,
}  # fmt: skip
TIMES_LINE, MOST_BYTES = 20.0, 1_000_000
# bytes of a frame before the part protected by its checksum of 16 bits
HEADS = {"bota": 1, "robotiq-ft300": 2, "optoforce": 4, "wsg-binary": 6}
NOISY_FRAMES, FLIPPED_RECORDS = 500_000, 100_000
COUNTS_PER_N, MAX_RECORD_STEP_N = 65, 50.0


@figure("faults")
def noise_on_every_line() -> list[Figure]:
    """10 MB of noise into each decoder of what devices send: its speed, and what it keeps."""
    slowest, most, names = np.inf, 0, []
    for name, line in LINE_BYTES_S.items():
        decoder, rng = CODECS[(name, IN)].stream, random.Random(name)
        assert decoder is not None
        stream, took_s = decoder(), 0.0
        for _ in range(NOISE_BYTES // BLOCK):
            noise = rng.randbytes(BLOCK)
            begun_s = time.process_time()
            for at in range(0, BLOCK, PIECE):
                stream.feed(noise[at : at + PIECE])
            took_s += time.process_time() - begun_s
        times = NOISE_BYTES / took_s / line
        slowest = min(slowest, times)
        names.append(f"{name} {times:.0f}")
        # Apart: whoever counts memory is slow.
        noise = rng.randbytes(BLOCK)
        tracemalloc.start()
        for at in range(0, BLOCK, PIECE):
            stream.feed(noise[at : at + PIECE])
        most = max(most, tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return [
        Figure("10 MB of noise, slowest decoder, times its line", float(slowest), "", ">= 20",
               slowest >= TIMES_LINE, "no exception; " + ", ".join(names)),
        Figure("10 MB of noise, memory kept", most / 1e6, "MB", "< 1", most < MOST_BYTES),
    ]  # fmt: skip


@figure("faults")
def noise_in_frames_with_checksum() -> list[Figure]:
    """Frames with valid head and length and random content: count accepted ones."""
    believed, names = 0, []
    for name, head in HEADS.items():
        codec, rng = CODECS[(name, IN)], random.Random(name)
        assert codec.stream is not None
        whole = _a_frame(name)
        taken = 0
        for _ in range(NOISY_FRAMES):
            stream = codec.stream()
            taken += len(stream.feed(whole[:head] + rng.randbytes(len(whole) - head)))
        believed += taken
        names.append(f"{name} {taken}")
    frames = NOISY_FRAMES * len(HEADS)
    due = frames / 65_536
    # What chance alone does to such a count.
    ok = believed <= due + 3.0 * due**0.5
    told = f"of {frames} frames; chance lets {due:.0f} pass; " + ", ".join(names)
    return [
        Figure("frames of noise accepted, of 65,536", 65_536 * believed / frames, "",
               "<= 1 and three sigma of chance", ok, told)
    ]  # fmt: skip


def _a_frame(name: str) -> bytes:
    """Return the longest published frame of what a device sends in one piece."""
    codec = CODECS[(name, IN)]
    found = [
        data(vector)
        for vector, about in VECTORS.items()
        if about["device"] == name and about["direction"] == IN and about.get("valid", True)
    ]
    single = [frame for frame in found if len(codec.messages(frame)) == 1]
    return max(single, key=len)


@figure("faults")
def flipped_bits_without_checksum() -> list[Figure]:
    """One bit in each of 100,000 records of a sensor that has no checksum, in air."""
    rng, noise = random.Random(7), np.random.default_rng(7)
    settings = HardwareSettings.model_validate({"dynpick": {"sensitivity": (COUNTS_PER_N,) * 6}})
    language = DynpickDriver(settings, "")
    readout = WrenchStamper(ForceTorqueSettings(), DYNPICK_PERIOD_S)
    believed = [np.zeros((0, 6))]
    for number in range(FLIPPED_RECORDS):
        # Nine whole records for each damaged one.
        counts = 0x2000 + noise.integers(-9, 10, (10, 6))
        records = [
            encode_record(DynpickRecord((10 * number + k) % 10, tuple(map(int, row))))
            for k, row in enumerate(counts)
        ]
        hurt = bytearray(records[4])
        place = rng.randrange(8 * len(hurt))
        hurt[place // 8] ^= 1 << place % 8
        content = b"".join([*records[:4], bytes(hurt), *records[5:]])
        _, values = readout.accept(0.01 * (number + 1), language.take(content))
        believed.append(values[np.isfinite(values).all(axis=1)])
    values = np.concatenate(believed)
    forces = values[:, :3]
    step_n = float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())
    wrong = int((np.abs(forces).max(axis=1) > 1.0).sum())
    told = (
        f"{len(values)} samples of {10 * FLIPPED_RECORDS} records, {wrong} of them off by over 1 N"
    )
    return [
        Figure("flipped bits without checksum, largest step accepted", step_n, "N", "<= 50",
               step_n <= MAX_RECORD_STEP_N and len(values) > 8 * FLIPPED_RECORDS, told)
    ]  # fmt: skip


MOST_OFF_PERCENT = {"cut off": 0.0, "one bit": 3.1, "64 bytes zeroed": 9.3, "1 KiB lost": 0.0}
# Pictures of a kind at 320 x 240 px, and at native size, which takes 20 times as long.
COUNT = {False: 1000, True: 60}
CLIPS = (*(clip for clip, _ in SCENES), "artificial_strawberry_exp2_camera_0.avi")
LIVE, NOISE_GREY = 10_000, 0.5
CONNECTIONS = 100
CREEP_PX, LIGHT = 1.5, (0.8, 1.2)
REST_FILE = "nocontact_train_sensor.png"


@figure("faults")
def damaged_pictures() -> list[Figure]:
    """Damaged pictures: share of those accepted with an error."""
    rows = []
    cv2.setNumThreads(1)
    for native, count in COUNT.items():
        for kind, most in MOST_OFF_PERCENT.items():
            found = outcomes(kind, count, seed=1, native=native)
            off = 100 * found["off"] / count
            good = found["wrong"] == 0 and off <= most
            if kind == "1 KiB lost":
                good = good and found["right"] == 0
            size = "native size" if native else "320 x 240 px"
            note = (
                f"of {count}: {found['bytes']} refused by their bytes, {found['content']} by their "
                f"content, {found['wrong']} with a marker over 2 px off (limit 0)"
            )
            name = f"damaged pictures, {kind}, {size}: accepted with 0.2 to 2 px"
            rows.append(Figure(name, off, "%", f"<= {most}", good, note))
    return rows


@figure("faults")
def whole_pictures() -> list[Figure]:
    """Whole pictures that are refused all the same."""
    refused = count = 0
    for clip in CLIPS:
        tracker = DamageCheckingTracker("left")
        for frame in read_pictures(GELSIGHT / clip):
            tracker.track(replace(frame, from_jpeg=True))
            count += 1
        refused += tracker.refused
    share = 100 * refused / count
    note = f"{refused} of {count}, in fast slip; never two in a row"
    name = "whole pictures of real clips that are refused"
    return [at_most(name, share, "%", 1, note), _taken_for_frozen()]


def _taken_for_frozen() -> Figure:
    rng = np.random.default_rng(4)
    gate = PictureFilter("left", "left", GelsightSettings(crop_fraction=0.0), 0.0)
    still = np.full((48, 64, 3), 90.0)
    for k in range(LIVE):
        noise = NOISE_GREY * rng.standard_normal(still.shape)
        gate.judge(0.04 * k, (still + noise).round().astype(np.uint8))
    name = f"live pictures taken for frozen, noise {NOISE_GREY} levels"
    return failures(name, gate.invalid, note=f"of {LIVE}")


@figure("faults")
def gels_at_connection() -> list[Figure]:
    """Exchanged, other and equal gels: number refused at connection."""
    rng = np.random.default_rng(6)
    exchanged = other = wrongly = 0
    both = {"tactile_left": "GEL-OTHER", "tactile_right": "GEL-OTHER"}
    for number in range(CONNECTIONS):
        with tempfile.TemporaryDirectory() as folder:
            day = {f: Gel(look, 2 * number + (f == "left")) for f, look in LOOKS.items()}
            bench = GelBench(Path(folder), day)
            bench.calibrate()
            bench.gels = {f: _another_day(look, rng) for f, look in LOOKS.items()}
            wrongly += bench.connect() != {}
            bench.gels = {"left": bench.gels["right"], "right": bench.gels["left"]}
            exchanged += bench.connect() == both
            bench.gels = {**day, "left": _another_day(_other(rng), rng)}
            other += bench.connect() == {"tactile_left": "GEL-OTHER"}
            bench.connection.close()
    target, note = f"{CONNECTIONS}", f"of {CONNECTIONS}, in other light, crept by up to 1.5 px"
    return [
        Figure("gels exchanged, refused", exchanged, "", target, exchanged == CONNECTIONS, note),
        Figure("other gel, refused", other, "", target, other == CONNECTIONS, note),
        failures("the same gels, refused", wrongly, "", note),
        *_real_gels(),
    ]


def _another_day(look: GelAppearance, rng: np.random.Generator) -> Gel:
    turn = rng.uniform(0.0, 2.0 * np.pi)
    creep_px = rng.uniform(0.0, CREEP_PX) * np.array([np.cos(turn), np.sin(turn)])
    return Gel(look, int(rng.integers(1 << 30)), creep_px, float(rng.uniform(*LIGHT)))


def _other(rng: np.random.Generator) -> GelAppearance:
    """Return a gel whose dots lie as far from the left one's as those of two real sensors do."""
    apart_px = _rest_px(CLIPS[int(rng.integers(len(CLIPS)))]) - _rest_px(REST_FILE)
    return replace(LOOKS["left"], rest_px=LOOKS["left"].rest_px + apart_px)


@cache
def _rest_px(name: str) -> FloatArray:
    return measure_rest(list(islice(read_pictures(GELSIGHT / name), 10))).position_px


def _real_gels() -> list[Figure]:
    """Five recordings of a real gel, always with a piece in hand, and another one at rest."""
    same = [fingerprint_distance_px(_rest_px(a), _rest_px(b)) for a, b in permutations(CLIPS, 2)]
    other = [fingerprint_distance_px(_rest_px(a), _rest_px(REST_FILE)) for a in CLIPS]
    worst, nearest = max(same), min(other)
    name = "one real gel in five recordings, holding pieces: farthest apart"
    return [
        at_most(name, worst, "px", HELD_LIMIT_PX, f"rms, of {len(same)} pairs"),
        at_least("another real gel: nearest", nearest, "px", HELD_LIMIT_PX, "rms"),
    ]


assert set(KINDS) == set(MOST_OFF_PERCENT)


SERIAL = [kind for kind in EMULATED if kind not in DATAGRAMS]
PULLS, LIFTS, REPLUGS = 10, 10, 20
LOOK_S, LATE_MS, FAULT_MS, JOIN_MS = 0.002, 100.0, 300.0, 1000.0
FRAME_LATE_MS, FRAME_FAULT_MS, BACK_MS = 120.0, 500.0, 2000.0
FRAME_S, AWAY_S, ROSE_MM = 0.04, 4.0, 0.02
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
            self._next_s, self._number = now_s + FRAME_S, self._number + 1
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


@figure("faults", long=True)
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
        return 1.0 / FRAME_S

    def release(self) -> None:
        pass

    def read(self) -> tuple[bool, np.ndarray | None]:
        self._pause.wait(FRAME_S)
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


@figure("faults", long=True)
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

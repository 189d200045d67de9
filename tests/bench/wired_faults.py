"""Faults of the emulated devices in real time: during whole trials, and pulled plugs.

Drivers, rig process, sockets, terminals and pipes are those of a lab day. A fault strikes one
device at a random instant, from connecting to the retreat after the release. The emulated devices
themselves judge what the driver sent.
"""

from __future__ import annotations

import random
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

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
from tests.bench.figures import Figure, at_most, failures, figure
from touchdown.backend.bench.assembly import SimulatedBenchChoice
from touchdown.backend.bench.emulated import EmulatedBench
from touchdown.backend.bench.emulated_scene import DriverObservations
from touchdown.backend.config.hardware import ForceTorqueSettings, GelsightSettings
from touchdown.backend.core.events import (
    EpisodeRecorded,
    Event,
    FaultRaised,
    Paused,
    PhaseEntered,
    RunFinished,
    TrialFinished,
)
from touchdown.backend.core.faults import FaultError, RefusedError
from touchdown.backend.core.streams import SampleStream, Stream
from touchdown.backend.core.values import FINGERS, ImageArray, TactileFrame
from touchdown.backend.devices.cameras.sources import PictureSource, UvcSource, open_source
from touchdown.backend.devices.factories import make_force_torque
from touchdown.backend.devices.gelsight.driver import TactileCamera
from touchdown.backend.devices.gelsight.emulator import SERIAL as NUMBER
from touchdown.backend.devices.gelsight.emulator import GelsightServer, encode
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.protocols import DeviceState
from touchdown.backend.devices.supervision import GRACE_S, Supervision
from touchdown.backend.emulation.fault_plan import FaultPlan, Faults, add_noise, apply_faults
from touchdown.backend.emulation.server import PtyServer
from touchdown.backend.episodes.episode_file import read_episode
from touchdown.backend.runs.recorder import RecordingOptions
from touchdown.backend.runs.requests import StackRequest

FIRST = 20_000
EARLIEST_S, LATEST_S = 0.5, 16.0  # range of the instant of a fault after the start of connecting
# time until the arm stands after a trial; time after which a fault must have had an effect
SETTLE_S, SURELY_S = 1.0, 4.0
# Step share of `melfa.mxt.step_fraction`; 29 cycles until the end of a stream is known; highest
# force; tolerance of an arm that stands.
MOST_SHARE, MOST_LATE_S, MOST_N, STANDS_MM = 0.5, 0.15, 60.0, 0.05

ARM = {"MXT-LOST", "MXT-ENDED", "MXT-START", "ARM-LINK", "ARM-STALE", "HW-STOP", "CONTROLLER"} | {
    *("NOT-READY", "REJECTED", "SERVO-OFF", "OUT-OF-RANGE", "PRESS-VOID", "RIG-STARVED")
}
WRIST = {"FT-LINK", "FT-STALE", "FT-SENSOR", "FT-OVERLOAD", "FT-TRIP", "TARE-REFUSED"} | {
    *("PRESS-VOID", "NO-WRIST", "PROBE-REJECTED", "DEGRADED")
}
GRIPPER = {"WSG-LINK", "WSG-FAST-STOP", "WSG-DEVICE", "WSG-TIMEOUT", "WSG-ABORTED"} | {
    *("PIECE-LOST", "GRIP-STALE", "NOT-HOMED", "NO-PIECE")
}
CAMERA = {
    *("CAMERA-LINK", "CAMERA-STALE", "CAMERA-FROZEN", "CAMERA-DARK", "NO-REFERENCE"),
    *("PROBE-REJECTED", "DEGRADED"),
}
# Fault codes caused by a busy computer (docs/hardware.md), counted separately.
APPLIED_LOAD = {
    *("BACKEND-SILENT", "LEASE-LAPSED", "MXT-LOST", "PRESS-VOID", "FT-STALE", "CAMERA-STALE"),
    *("PROBE-REJECTED", "DEGRADED"),
}
CODES = {
    "arm": ARM,
    "force_torque": WRIST,
    "gripper": GRIPPER,
    "tactile_left": CAMERA,
    "tactile_right": CAMERA,
}


@dataclass(frozen=True)
class Kind:
    """One kind of fault of one device; ``ends``: no trial goes on with it."""

    device: str
    kind: str
    for_s: float
    ends: bool = False
    more: dict[str, float] = field(default_factory=dict)


def of_wire(device: str, share: float, for_s: float, *kinds: str) -> tuple[Kind, ...]:
    return tuple(Kind(device, kind, for_s, more={"share": share}) for kind in kinds)


KINDS = (
    *of_wire("arm", 0.2, 2.0, "lost", "duplicate", "reorder", "garbage"),
    *(Kind("arm", "late", 2.0, more={"share": 0.2, "by_s": 0.02}), Kind("arm", "silent", 0.06)),
    *(Kind("arm", "silent", 1.0, True), Kind("arm", "unplug", 1.0, True)),
    *(Kind("arm", kind, 1.0, True) for kind in ("alarm", "estop", "servo_off")),
    *of_wire("force_torque", 0.05, 1.0, "lost", "duplicate", "flip", "garbage", "cut"),
    *(Kind("force_torque", "silent", 0.06), Kind("force_torque", "silent", 1.0, True)),
    *(Kind("force_torque", "unplug", 1.0, True), Kind("force_torque", "freeze", 1.0, True)),
    *(Kind("force_torque", "saturate", 0.6, True), Kind("force_torque", "slow", 3.0)),
    *of_wire("gripper", 0.1, 1.0, "duplicate", "garbage"),
    *(Kind("gripper", "silent", 0.2), Kind("gripper", "silent", 2.0), Kind("gripper", "unplug", 1)),
    *(Kind("gripper", kind, 1.0, True) for kind in ("part_lost", "fast_stop", "power")),
    *(
        Kind(camera, kind, for_s, ends, more)
        for camera in ("tactile_left", "tactile_right")
        for kind, for_s, ends, more in (
            ("lost", 2.0, False, {"share": 0.2}),
            ("cut", 2.0, False, {"share": 0.2}),
            ("silent", 0.2, False, {}),
            ("silent", 1.5, True, {}),
            ("unplug", 1.5, True, {}),
            ("freeze", 1.0, True, {}),
            ("dark", 1.5, False, {}),
            ("slow", 3.0, False, {"hz": 8.0}),
        )
    ),
)
SLOW_HZ = 300.0


Told = TypeVar("Told", bound=Event)


@dataclass
class Heard:
    """Events of a trial, and the first motion of the arm (monotonic time)."""

    facts: list[Event] = field(default_factory=list)
    moved_s: float = float("inf")

    def codes(self) -> set[str]:
        """Return the faults that ended it or made it pause."""
        return {f.fault.code for f in self.facts if isinstance(f, FaultRaised | Paused)}

    def of(self, kind: type[Told]) -> list[Told]:
        return [fact for fact in self.facts if isinstance(fact, kind)]


@dataclass(frozen=True)
class Struck:
    """Result of a trial: device, instant, end, violated requirements."""

    seed: int
    kind: Kind
    at_s: float
    ended: str
    broken: tuple[str, ...]
    loaded: bool = False  # ended by the load of the computer

    def __str__(self) -> str:
        what = f"{self.kind.device} {self.kind.kind} {self.kind.for_s:g} s"
        return f"seed {self.seed}, {what} at {self.at_s:.1f} s, {self.ended}: {self.broken}"


class Campaign:
    """Trials on one emulated bench, one after the other; each begins from Reset and a new scene."""

    def __init__(self, folder: Path) -> None:
        self.bench = EmulatedBench(SimulatedBenchChoice(), keep=RecordingOptions(folder))
        self.bench.session.events.subscribe(self._hear)
        self._heard = Heard()

    def _hear(self, fact: Event) -> None:
        heard = self._heard
        heard.facts.append(fact)
        if isinstance(fact, PhaseEntered):
            heard.moved_s = min(heard.moved_s, time.monotonic())

    def trial(self, seed: int) -> Struck:
        """Run one; a fault that strikes while its devices are connected ends it there."""
        rng = random.Random(seed)
        kind = KINDS[seed % len(KINDS)]
        at_s = rng.uniform(EARLIEST_S, LATEST_S)
        more = {"hz": SLOW_HZ} | kind.more if kind.kind == "slow" else kind.more
        strike = {"at_s": at_s, "device": kind.device, "kind": kind.kind, "for_s": kind.for_s}
        self.bench.plan = FaultPlan.model_validate({"seed": seed, "fault": [strike | more]})
        session, self._heard = self.bench.session, Heard()
        begun_s, code = time.monotonic(), ""
        try:
            session.run(StackRequest("pot", ("short",), seed))
        except FaultError as error:
            code = error.fault.code
        except RefusedError as error:
            code = error.reason
        lasted_s = time.monotonic() - begun_s
        codes = self._heard.codes() | ({code} - {""})
        met = begun_s + at_s > self._heard.moved_s
        met = met and lasted_s > at_s + kind.for_s + SURELY_S
        self._settle()
        broken = self._broken(kind, codes, met=met)
        loaded = bool(codes) and not codes & CODES[kind.device]
        ends = self._heard.of(TrialFinished)
        ended = ends[-1].outcome.value if ends else code or "nothing told"
        why = ends[-1].reason if ends else ""
        session.reset()
        return Struck(
            seed, kind, at_s, f"{ended} after {lasted_s:.0f} s ({why})", tuple(broken), loaded
        )

    def _broken(self, kind: Kind, codes: set[str], *, met: bool) -> list[str]:
        """Return what does not hold; ``met``: the fault surely struck a trial that went on."""
        heard, session = self._heard, self.bench.session
        seen = self.bench.driver_observations()
        assert seen is not None
        # A fault may strike while the jaws open by right: then nothing more tells of the release.
        released = len([f for f in heard.of(PhaseEntered) if f.phase == "release"])
        connected = bool(heard.facts)
        allowed = CODES[kind.device] | APPLIED_LOAD
        rows = {
            f"fault {codes - allowed}": codes <= allowed,
            "no fault told": not (kind.ends and met) or bool(codes),
            "nothing says how the run ended": not connected or bool(heard.of(RunFinished)),
            "goes on": not session.engine.busy,
            **witnessed(seen, released),
            **{f"episode {name} is lost": False for name in self._lost()},
        }
        return [name for name, holds in rows.items() if not holds]

    def _settle(self) -> None:
        """Let a motion that the trial began with its last breath come to its end."""
        session = self.bench.session
        end_s = session.clock_s() + SETTLE_S
        while session.clock_s() < end_s:
            session.advance()

    def _lost(self) -> list[str]:
        """Return the acknowledged episodes that are missing or differ."""
        folder, lost = self.bench.session.run_folder, []
        for fact in self._heard.of(EpisodeRecorded):
            assert folder is not None
            kept = read_episode(folder / "episodes" / Path(fact.path).name)
            if not np.array_equal(kept.observation, fact.episode.observation, equal_nan=True):
                lost.append(fact.path)
        return lost


def witnessed(seen: DriverObservations, released: int) -> dict[str, bool]:
    """Return by requirement whether the devices received no unsafe command."""
    return {
        f"a step of {seen.step_share:.2f} of the top speed": seen.step_share <= MOST_SHARE,
        f"a command {seen.late_command_s:.3f} s after the end": seen.late_command_s <= MOST_LATE_S,
        f"still moving: {seen.moving_mm:.2f} mm": seen.moving_mm <= STANDS_MM,
        f"{seen.openings} openings, {released} releases": seen.openings <= released,
        f"{seen.barred} motions of a gripper in a fault": seen.barred == 0,
        f"{seen.force_n:.0f} N": seen.force_n <= MOST_N,
    }


def campaign(trials: int = len(KINDS), first: int = FIRST) -> list[Struck]:
    with tempfile.TemporaryDirectory() as folder:
        struck = Campaign(Path(folder))
        try:
            return [struck.trial(seed) for seed in range(first, first + trials)]
        finally:
            struck.bench.close()


@figure("wired-faults")
def faults_over_the_wires() -> list[Figure]:
    """Whole trials with a failing device: count those not ended as documented."""
    return [of(campaign())]


def of(ended: Sequence[Struck]) -> Figure:
    broken = [one for one in ended if one.broken]
    endings = Counter(one.ended.split()[0] for one in ended)
    kinds = len({(one.kind.device, one.kind.kind) for one in ended})
    note = f"{len(ended)} faults of {kinds} kinds; ends: "
    note += ", ".join(f"{count} {name}" for name, count in endings.most_common())
    note += f"; {sum(one.loaded for one in ended)} by a busy computer"
    note += "".join(f"; {one}" for one in broken[:3])
    name = "faults over the wires, in real time: not ended as documented, or an unsafe command"
    return failures(name, len(broken), f"of {len(ended)}", note)


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

"""Damage on the wires: noise, inserted, deleted and flipped bytes, lost packets, steps too large.

By stepped clock, except the speed of the decoders, which is processor time.
"""

from __future__ import annotations

import random
import threading
import time
import tracemalloc
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tests.backend.devices.codecs.codecs import CODECS, IN
from tests.backend.devices.codecs.vectors import VECTORS, data
from tests.backend.devices.melfa.emulated_arm import Rig
from tests.backend.devices.melfa.leaps import Leaping
from tests.backend.devices.melfa.test_stream import LEAD_MM, SPEED_MM_S
from tests.bench.registry import Figure, figure
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.faults import FaultError
from touchdown.backend.core.values import FloatArray, Pose
from touchdown.backend.devices.dynpick.driver import PERIOD_S, DynpickDriver
from touchdown.backend.devices.dynpick.protocol import DynpickRecord, encode_record
from touchdown.backend.devices.force_torque.reader import WrenchStamper
from touchdown.backend.devices.melfa.kinematics import STEPS_RAD
from touchdown.backend.devices.melfa.realtime_protocol import decode_mxt_request
from touchdown.backend.devices.protocols import CommandedMotion, DeviceState

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
LEAPS, STORM_CYCLES, MOST_SHARE = 200, 10, 0.5
LOSSES, MINUTES = (0.05, 0.20), 10.0


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
    readout = WrenchStamper(ForceTorqueSettings(), PERIOD_S)
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


@dataclass(frozen=True)
class _Travelled:
    ratio: float
    backwards: int
    travels: int
    well: bool


def _travelled(loss: float, minutes: float) -> _Travelled:
    """Travel up and down for so long while packets are lost both ways."""
    rig = Rig()
    rig.arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    rig.wires.link.loss = loss
    ratio, backwards, travels = 0.0, 0, 0
    goals, end_s = (160.0, 60.0), rig.wires.clock.now_s() + 60.0 * minutes
    while rig.wires.clock.now_s() < end_s and rig.arm.state is DeviceState.READY:
        goal_mm = goals[travels % 2]
        del rig.wires.packets[:]
        motion = rig.arm.move_to(Pose(0.0, 0.0, goal_mm), SPEED_MM_S)
        while not motion.done:
            rig.rest(0.5)
        told = _places(rig)
        ratio = max(ratio, float(np.linalg.norm(np.diff(told, axis=0), axis=1).max()) / LEAD_MM)
        way = 1.0 if goal_mm == goals[0] else -1.0
        backwards += int((way * np.diff(told[:, 2]) < -1e-4).sum())
        travels += 1
    return _Travelled(ratio, backwards, travels, rig.arm.state is DeviceState.READY)


def _places(rig: Rig) -> FloatArray:
    """Return the positions commanded since the last clearing: (n, 3) mm."""
    targets = [decode_mxt_request(packet).target for _, packet in rig.wires.packets]
    axes = [np.array(target.axes[:6]) for target in targets if target is not None]
    return np.array([rig.placing.pivot_mm(joints) for joints in axes])


@figure("faults")
def ten_minutes_of_lost_packets() -> list[Figure]:
    """5 and 20 % lost each way for ten minutes of travelling: steps, and their direction."""
    rows = []
    for loss in LOSSES:
        found = _travelled(loss, MINUTES)
        ok = found.well and found.ratio <= 1.05 and found.backwards == 0
        told = f"{found.travels} travels, {found.backwards} steps back" + (
            "" if found.well else ", a fault"
        )
        name = f"{100 * loss:.0f} % of the packets lost for 10 min: largest step"
        rows.append(Figure(name, found.ratio, "leads", "<= 1.05, no fault, none back", ok, told))
    return rows


@figure("faults")
def steps_too_large() -> list[Figure]:
    """Motions with jumps of any size, direction and number: largest step at the controller."""
    rng, broken, share = np.random.default_rng(11), [], 0.0
    faults = refused = 0
    for number in range(LEAPS):
        rig = Rig()
        rig.arm.connect(1.0, threading.Event())
        way, in_a_row = rng.normal(size=3), int(rng.integers(1, 31))
        size_mm = 10.0 ** rng.uniform(-0.3, 2.7)
        program = Leaping(size_mm * way / np.linalg.norm(way), in_a_row)
        rig.arm._core.run(program)
        rig.rest(0.2)
        joints = [t.axes[:6] for _, p in rig.wires.packets if (t := decode_mxt_request(p).target)]
        share = max(share, float((np.abs(np.diff(joints, axis=0)) / STEPS_RAD).max()))
        fault = "" if rig.arm.fault is None else rig.arm.fault.code
        faults, refused = faults + bool(fault), refused + (_failed(program.motion))
        wanted = {"STEPS-TOO-LARGE"} if in_a_row > STORM_CYCLES else {""}
        if rig.device.controller.error or fault not in wanted | {""} or not program.motion.done:
            broken.append(f"number {number}: {size_mm:.1f} mm, {in_a_row} times, '{fault}'")
        elif in_a_row > STORM_CYCLES and not _failed(program.motion):
            broken.append(f"number {number}: {size_mm:.1f} mm, {in_a_row} times, went on")
    told = f"{faults} ended as a fault, {refused - faults} refused at once" + "".join(
        f"; {one}" for one in broken[:3]
    )
    return [
        Figure(f"motions of {LEAPS} that leap, not ended as documented", len(broken), "", "0",
               not broken, told),
        Figure("largest step that reached the controller, of its top speed", share, "", "<= 0.5",
               share <= MOST_SHARE, "its own step check never fired"),
    ]  # fmt: skip


def _failed(motion: CommandedMotion) -> bool:
    try:
        motion.result()
    except FaultError:
        return True
    return False


FRAMED = (
    "dynpick", "leptrino", "robotiq-ft300", "bota", "optoforce", "wsg-binary", "wsg-gcl",
    "melfa-r3",
)  # fmt: skip
SHARES = (1e-3, 1e-2, 0.1, 0.3)
EDITED_FRAMES, CLEAN, TRIALS = 400, 6, 20
LOST_FRAMES = 2
PIECES = (1, 7, 64, 10_000)
SENSITIVITIES = {"24.9": 24.9, "65": 65.0}  # counts per newton of two sizes of the sensor
FLIPPED_UNDER_LOAD, MAX_LOADED_STEP_N, LOAD_N, HELD, BESIDE = 20_000, 50.0, 80.0, 40, 4


def _frames(name: str) -> list[bytes]:
    """Return the published frames of what a device sends, each of one message."""
    codec = CODECS[(name, IN)]
    found = [
        data(vector)
        for vector, about in VECTORS.items()
        if about["device"] == name and about["direction"] == IN and about.get("valid", True)
    ]
    return [
        frame + codec.end if not frame.endswith(codec.end) else frame
        for frame in found
        if len(codec.messages(frame + codec.end)) == 1
    ]


def _edited(content: bytes, share: float, kind: str, rng: random.Random) -> bytes:
    out = bytearray()
    for byte in content:
        if rng.random() >= share:
            out.append(byte)
        elif kind == "flip":
            out.append(byte ^ 1 << rng.randrange(8))
        elif kind == "insert":
            out += bytes((byte, rng.randrange(256)))
    return bytes(out)


@figure("faults")
def edited_lines() -> list[Figure]:
    """0.1 to 30 % of the bytes inserted, deleted or flipped, in pieces of any size."""
    late, unlike, count = 0, 0, 0
    for name in FRAMED:
        codec, frames = CODECS[(name, IN)], _frames(name)
        assert codec.stream is not None
        for kind in ("insert", "delete", "flip"):
            for share in SHARES:
                for trial in range(TRIALS):
                    rng = random.Random(f"{name} {kind} {share} {trial}")
                    chosen = [rng.choice(frames) for _ in range(EDITED_FRAMES // TRIALS)]
                    hurt = _edited(b"".join(chosen), share, kind, rng)
                    clean = [rng.choice(frames) for _ in range(CLEAN)]
                    stream = hurt + b"".join(clean)
                    cuts = [codec.messages(stream, cut) for cut in PIECES]
                    unlike += any(one != two for one, two in pairwise(cuts))
                    good = [codec.messages(frame)[0] for frame in clean]
                    tail = good[LOST_FRAMES:]
                    late += cuts[0][-len(tail) :] != tail
                    count += 1
    told = f"{count} lines of {len(FRAMED)} devices; {unlike} read otherwise when cut otherwise"
    ok = late == 0 and unlike == 0
    name = "lines with inserted, lost and flipped bytes: not read again after two frames"
    return [Figure(name, late, "", "0", ok, told)]


def _believed(per_n: float) -> Iterator[FloatArray]:
    """Yield believed samples (n, 6): one bit flipped in each fourth record, loads in between."""
    rng, noise = random.Random(8), np.random.default_rng(8)
    told = {"dynpick": {"sensitivity": (per_n,) * 6}}
    language = DynpickDriver(HardwareSettings.model_validate(told), "")
    readout = WrenchStamper(ForceTorqueSettings(), PERIOD_S)
    for number in range(FLIPPED_UNDER_LOAD):
        counts = 0x2000 + noise.integers(-9, 10, (BESIDE, 6))
        if number % HELD >= HELD // 2:
            counts[:, 2] += round(LOAD_N * per_n)
        records = [
            bytearray(
                encode_record(DynpickRecord((BESIDE * number + k) % 10, tuple(map(int, row))))
            )
            for k, row in enumerate(counts)
        ]
        place = rng.randrange(8 * len(records[1]))
        records[1][place // 8] ^= 1 << place % 8
        content = b"".join(records)
        yield readout.accept(BESIDE * PERIOD_S * (number + 1), language.take(content))[1]


@figure("faults")
def flipped_bits_amid_loads() -> list[Figure]:
    """Loads of 80 N come and go amid 20,000 flipped bits: every step that is believed stays."""
    rows = []
    for name, per_n in SENSITIVITIES.items():
        values = np.concatenate(list(_believed(per_n)))
        fz = values[np.isfinite(values).all(axis=1), 2]
        steps = np.flatnonzero(np.abs(np.diff(fz)) > MAX_LOADED_STEP_N)
        # A step is believed once it has lasted for two samples: then it goes on.
        lone = sum(
            abs(fz[at + 2] - fz[at + 1]) > MAX_LOADED_STEP_N for at in steps if at + 2 < len(fz)
        )
        due = 2 * (FLIPPED_UNDER_LOAD // HELD) - 1
        ok = lone == 0 and abs(len(steps) - due) <= max(1, due // 500)
        told = f"{len(steps)} believed of {due} loads, of {BESIDE * FLIPPED_UNDER_LOAD} records"
        text = f"steps over 50 N believed that did not last, {name} counts for a newton"
        rows.append(Figure(text, int(lone), "", "0", ok, told))
    return rows

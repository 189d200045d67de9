"""Damaged bytes on the lines of all devices."""

import random
import time
import tracemalloc

import numpy as np

from tests.backend.devices.codecs.codecs import CODECS, IN
from tests.backend.devices.codecs.vectors import VECTORS, data
from tests.bench.figures import Figure, figure
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.devices.dynpick.driver import PERIOD_S, DynpickDriver
from touchdown.backend.devices.dynpick.protocol import DynpickRecord, encode_record
from touchdown.backend.devices.force_torque.reader import WrenchStamper

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

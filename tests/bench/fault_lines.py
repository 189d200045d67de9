"""Bytes inserted, deleted and flipped on the lines of devices; records without a checksum."""

from __future__ import annotations

import random
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from tests.backend.wire.codecs import CODECS, IN
from tests.backend.wire.vectors import VECTORS, data
from tests.bench.registry import Figure, figure
from touchdown.backend.config.hardware import ForceTorqueSettings, HardwareSettings
from touchdown.backend.core.values import FloatArray
from touchdown.backend.devices.dynpick.driver import PERIOD_S, DynpickDriver
from touchdown.backend.devices.dynpick.protocol import DynpickRecord, encode_record
from touchdown.backend.devices.force_torque.reader import WrenchStamper

FRAMED = (
    "dynpick", "leptrino", "robotiq-ft300", "bota", "optoforce", "wsg-binary", "wsg-gcl",
    "melfa-r3",
)  # fmt: skip
SHARES = (1e-3, 1e-2, 0.1, 0.3)
FRAMES, CLEAN, TRIALS = 400, 6, 20
LOST_FRAMES = 2
PIECES = (1, 7, 64, 10_000)
SENSITIVITIES = {"24.9": 24.9, "65": 65.0}
"""Counts for a newton of two sizes of the sensor without checksum."""
FLIPPED, MOST_STEP_N, LOAD_N, HELD, BESIDE = 20_000, 50.0, 80.0, 40, 4


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
                    chosen = [rng.choice(frames) for _ in range(FRAMES // TRIALS)]
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
    for number in range(FLIPPED):
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
        steps = np.flatnonzero(np.abs(np.diff(fz)) > MOST_STEP_N)
        # A step is believed once it has lasted for two samples: then it goes on.
        lone = sum(abs(fz[at + 2] - fz[at + 1]) > MOST_STEP_N for at in steps if at + 2 < len(fz))
        due = 2 * (FLIPPED // HELD) - 1
        ok = lone == 0 and abs(len(steps) - due) <= max(1, due // 500)
        told = f"{len(steps)} believed of {due} loads, of {BESIDE * FLIPPED} records"
        text = f"steps over 50 N believed that did not last, {name} counts for a newton"
        rows.append(Figure(text, int(lone), "", "0", ok, told))
    return rows

"""Damaged pictures of real gels: refused by the driver, refused by the tracker, or accepted with an
error.

Limits: no picture with lost packets is accepted, no accepted picture has a marker over 2 px off,
and of those between 0.2 and 2 px at most half of what two gates leave (docs/faults.md, C4). Also
dropped frames (C5) and gels refused at connection (C6).
"""

import tempfile
from dataclasses import replace
from functools import cache
from itertools import islice, permutations
from pathlib import Path

import cv2
import numpy as np

from tests.backend.devices.cameras.damage import GELSIGHT, KINDS, SCENES, outcomes
from tests.backend.runs.gel_bench import LOOKS, Gel, GelBench
from tests.bench.figures import Figure, at_least, at_most, failures, figure
from touchdown.backend.calibration.cameras import HELD_LIMIT_PX, fingerprint_distance_px
from touchdown.backend.config.hardware import GelsightSettings
from touchdown.backend.core.values import FloatArray
from touchdown.backend.devices.cameras.frames import PictureFilter
from touchdown.backend.sensing import measure_rest, read_pictures
from touchdown.backend.sensing.jpeg_damage import DamageCheckingTracker
from touchdown.backend.simulation.finger_camera import GelAppearance

MOST_OFF_PERCENT = {"cut off": 0.0, "one bit": 3.1, "64 bytes zeroed": 9.3, "1 KiB lost": 0.0}
# Pictures of a kind at 320 x 240 px, and at native size, which takes 20 times as long.
COUNT = {False: 1000, True: 200}
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

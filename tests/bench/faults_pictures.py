"""Damaged pictures of real gels: which the driver refuses, which the tracker, what is left wrong.

Limits: none of the lost packets accepted, no accepted picture with a marker over 2 px off, and of
those between 0.2 and 2 px at most half of what two gates leave (docs/faults.md, C4).
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from backend.config.hardware import GelsightSettings
from backend.devices.cameras.gate import Gate
from backend.sensing.checked import CheckedTracker
from backend.sensing.pictures import read_pictures
from tests.backend.devices.cameras.damage import GELSIGHT, KINDS, SCENES, outcomes
from tests.bench.registry import Figure, figure

MOST_OFF_PERCENT = {"cut off": 0.0, "one bit": 3.1, "64 bytes zeroed": 9.3, "1 KiB lost": 0.0}
COUNT = {False: 1000, True: 200}
"""Pictures of a kind at 320 x 240 px, and at native size, which takes 20 times as long."""
CLIPS = (*(clip for clip, _ in SCENES), "artificial_strawberry_exp2_camera_0.avi")
LIVE, NOISE_GREY = 10_000, 0.5


@figure("faults")
def damaged_pictures() -> list[Figure]:
    """What becomes of pictures damaged on their way."""
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
        tracker = CheckedTracker("left")
        for frame in read_pictures(GELSIGHT / clip):
            tracker.track(replace(frame, from_jpeg=True))
            count += 1
        refused += tracker.refused
    share = 100 * refused / count
    note = f"{refused} of {count}, in fast slip; never two in a row"
    name = "whole pictures of real clips that are refused"
    return [Figure(name, share, "%", "<= 1", share <= 1, note), _taken_for_frozen()]


def _taken_for_frozen() -> Figure:
    rng = np.random.default_rng(4)
    gate = Gate("left", "left", GelsightSettings(crop_fraction=0.0), 0.0)
    still = np.full((48, 64, 3), 90.0)
    for k in range(LIVE):
        noise = NOISE_GREY * rng.standard_normal(still.shape)
        gate.judge(0.04 * k, (still + noise).round().astype(np.uint8))
    name = f"live pictures taken for frozen, noise {NOISE_GREY} levels"
    return Figure(name, gate.invalid, "", "0", gate.invalid == 0, f"of {LIVE}")


assert set(KINDS) == set(MOST_OFF_PERCENT)

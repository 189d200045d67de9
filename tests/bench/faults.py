"""The fault campaign: what goes wrong on every device, and whether it ends as documented.

By hand-wound clock throughout: no figure depends on how busy the computer is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from tests.backend.devices import trials_camera, trials_gripper, trials_wrist
from tests.backend.devices.melfa import trials as trials_arm
from tests.bench import faults_collecting
from tests.bench.registry import Figure, figure

TRIALS: Sequence[tuple[str, Callable[[int], object], int]] = (
    ("arm", trials_arm.trial, 120),
    ("gripper, both protocols", trials_gripper.trial, 150),
    ("wrist sensors, seven makes", trials_wrist.trial, 180),
    ("tactile cameras", trials_camera.trial, 120),
    ("devices while collecting", faults_collecting.trial, 30),
)
LEAST = 500
FIRST = 10_000
"""Other seeds than those of the tests and of the group ``arm``."""


@figure("faults")
def faults_of_every_device() -> list[Figure]:
    """Random faults at random instants: how many did not end as documented."""
    rows, total, missed = [], 0, 0
    with ProcessPoolExecutor(2, get_context("spawn")) as pool:
        for device, trial, count in TRIALS:
            ended = list(pool.map(trial, range(FIRST, FIRST + count), chunksize=5))
            broken = [one for one in ended if one.broken]
            kinds = len({one.fault for one in ended})
            told = f"{count} faults of {kinds} kinds" + (f"; {broken[0]}" if broken else "")
            name = f"faults not ended as documented: {device}"
            rows.append(Figure(name, len(broken), "", "0", not broken, told))
            total, missed = total + count, missed + len(broken)
    note = "no unsafe command in the emulators' logs, no acknowledged episode lost"
    good = total >= LEAST and missed == 0
    rows.append(Figure("injected faults in all", total, "", f">= {LEAST}", good, note))
    return rows

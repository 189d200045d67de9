"""Peaks of presses, and contacts too stiff for their damping: the law of compliance by itself.

One axis against a spring, built apart from the driver (``contact_loop``); the law, the detector of
swings and the limits are the shipped ones. By hand-wound clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from tests.backend.devices.streamed.contact_loop import Plant
from tests.bench.registry import Figure, figure
from touchdown.backend.devices.protocols import RETREAT_MM, RETREAT_MM_S
from touchdown.backend.devices.streamed.compliance import (
    AT_REST,
    TRIP_N,
    AdmittanceLaw,
    LoopDelays,
    SwingDetector,
    admittance_law,
    deflect,
)

GAINS = (30.0, 30.0, 15.0)
SOFT_N, STIFF_N = 30.0, 100.0
"""Stiffness that the damping is made for, N/mm: the usual one, and that of a stiff contact."""
TRIPPED = math.inf
"""The published law swings there until the trip at 40 N."""
PEAKS: dict[tuple[float, float, float], dict[float, float]] = {
    (0.0035, SOFT_N, 2.0): {1: 2.4, 3: 4.8, 10: 10.4, 30: 17.3, 100: TRIPPED},
    (0.0035, STIFF_N, 2.0): {1: 2.4, 3: 5.0, 10: 11.5, 30: 20.2, 100: 27.9},
    (0.0071, SOFT_N, 2.0): {1: 2.4, 3: 4.9, 10: 11.0, 30: 18.4, 100: TRIPPED},
    (0.0071, STIFF_N, 2.0): {1: 2.5, 3: 5.2, 10: 12.5, 30: 22.7, 100: 32.0},
    (0.010, SOFT_N, 2.0): {1: 2.5, 3: 5.0, 10: 11.4, 30: 19.3, 100: TRIPPED},
    (0.010, STIFF_N, 2.0): {1: 2.5, 3: 5.3, 10: 13.1, 30: 24.6, 100: 34.9},
    (0.030, SOFT_N, 1.0): {1: 2.6, 3: 5.3, 10: 11.9, 30: 20.7, 100: TRIPPED},
    (0.030, STIFF_N, 1.0): {1: 2.6, 3: 5.6, 10: 13.9, 30: 27.0, 100: 38.8},
    (0.030, SOFT_N, 2.0): {1: 2.8, 3: 5.9, 10: 14.0, 30: 25.5, 100: TRIPPED},
}
"""Published peaks in N by cycle (s), design stiffness, speed (mm/s), and stiffness met (N/mm)."""
WITHIN, MOST_N, SWING_MOST_N = 0.10, 60.0, 40.0
STIFFER, CYCLES_S, DELAYS = (2.0, 3.0, 4.0, 5.0), (0.0035, 0.0071, 0.010), 12.0
SEEDS = range(3)


@dataclass
class _Press:
    peak_n: float = 0.0
    tripped: bool = False
    swung_s: float = math.inf
    """After the first touch; infinite where nothing was found to swing."""


def _pressed(
    law: AdmittanceLaw,
    loop: LoopDelays,
    stiff_n_mm: float,
    speed_mm_s: float,
    *,
    watched: bool,
    seed: int,
) -> _Press:
    """Press 1.5 mm beyond the detection for 4 s; draw back at the trip, freeze at a swing."""
    rng, plant, found = np.random.default_rng(seed), Plant(loop, 0.5), _Press()
    detector = SwingDetector(loop.delay_s)
    reference, goal, give, high, over = 0.5, -math.inf, AT_REST, 0, 0
    command, touched_s, up_mm = reference, math.inf, math.inf
    for k in range(round(4.0 / loop.cycle_s)):
        now_s = k * loop.cycle_s
        true_n = stiff_n_mm * max(-plant.place_mm, 0.0)
        if true_n > 0.0:
            touched_s = min(touched_s, now_s)
        found.peak_n = max(found.peak_n, true_n)
        felt = true_n + rng.normal(0.0, 0.1)
        high = high + 1 if felt > 1.0 else 0
        over = over + 1 if felt > TRIP_N else 0
        if goal == -math.inf and high >= 3:
            goal = reference - 1.5
        if over >= 2 and not found.tripped:
            found.tripped, up_mm = True, reference + RETREAT_MM
        if found.tripped:
            reference = min(reference + RETREAT_MM_S * loop.cycle_s, up_mm)
        elif found.swung_s == math.inf:
            reference = max(reference - speed_mm_s * loop.cycle_s, goal)
        if goal > -math.inf:
            give = deflect(law, give, np.array([0.0, 0.0, felt]))
            if watched and found.swung_s == math.inf and detector.feed(now_s, felt):
                found.swung_s = now_s - touched_s
                law = replace(law, damping=2.0 * law.damping, mass=2.0 * law.mass)
        command = reference + float(give.d_mm[2])
        plant.step(command)
    return found


@figure("faults")
def peaks_of_presses() -> list[Figure]:
    """Springs of 1 to 100 N/mm at each cycle: peaks beside the published, and the strongest."""
    off, strongest, swinging, where = 0.0, 0.0, 0.0, ""
    for (cycle_s, design, speed), row in PEAKS.items():
        loop = LoopDelays(cycle_s)
        law = admittance_law(loop, GAINS, design)
        for stiff, published in row.items():
            runs = [_pressed(law, loop, stiff, speed, watched=False, seed=s) for s in SEEDS]
            peak = float(np.median([run.peak_n for run in runs]))
            strongest = max(strongest, *(run.peak_n for run in runs))
            if published == TRIPPED:
                swinging = max(swinging, peak)
            elif abs(peak - published) > 0.15 and abs(peak / published - 1.0) > off:
                off = abs(peak / published - 1.0)
                where = f"{1e3 * cycle_s:.1f} ms, made for {design:.0f}, met {stiff} N/mm"
    ok = off <= WITHIN and strongest <= MOST_N
    told = f"strongest {strongest:.1f} N (limit 60); farthest at {where}; "
    told += f"{swinging:.1f} N where the published one trips"
    return [Figure("peaks of presses beside the published", 100 * off, "%", "<= 10", ok, told)]


@figure("faults")
def contacts_that_swing() -> list[Figure]:
    """Contacts 2 to 5 times as stiff as the damping is made for: when the swing is found."""
    slowest, strongest, silent, alarms = 0.0, 0.0, 0, 0
    for cycle_s in CYCLES_S:
        loop = LoopDelays(cycle_s)
        law = admittance_law(loop, GAINS, SOFT_N)
        for times in STIFFER:
            for seed in SEEDS:
                found = _pressed(law, loop, times * SOFT_N, 1.0, watched=True, seed=seed)
                strongest = max(strongest, found.peak_n)
                # Twice the design is stable still: its transient may be found, or die away.
                if found.swung_s < math.inf:
                    slowest = max(slowest, found.swung_s / loop.delay_s)
                else:
                    silent += times > STIFFER[0]
        for stiff in (1.0, 3.0, 8.0, 10.0, 30.0):
            for speed in (1.0, 2.0):
                found = _pressed(law, loop, stiff, speed, watched=True, seed=1)
                alarms += found.swung_s < math.inf
    ok = slowest <= DELAYS and strongest < SWING_MOST_N and silent == 0 and alarms == 0
    told = f"strongest {strongest:.1f} N (limit 40); {silent} not found, {alarms} false alarms"
    name = "contacts 2 to 5 times too stiff: swing found after the touch"
    return [Figure(name, slowest, "loop delays", "<= 12", ok, told)]

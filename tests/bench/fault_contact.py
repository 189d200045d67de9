"""Descents that meet nothing, and those that meet something too early. By hand-wound clocks."""

from __future__ import annotations

import itertools
import math
import threading
from contextlib import suppress

import numpy as np

from tests.backend.devices.emulated_arm import Rig
from tests.backend.rig.inline import InlineBench
from tests.bench.registry import Figure, figure
from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.events import EpisodeRecorded, Event, FaultRaised, PhaseEntered
from touchdown.backend.core.faults import TouchdownError
from touchdown.backend.core.streams import Stream
from touchdown.backend.core.values import FINGERS, Pose
from touchdown.backend.devices.guarded_devices import GuardedArm
from touchdown.backend.devices.interlock import Interlock
from touchdown.backend.devices.supervision import Supervision
from touchdown.backend.runs.requests import StackRequest

MISSES, EARLY = 10, 20
BACK_MM, ROSE_MM, SOON_MM, MOST_N = 0.1, (1.6, 2.6), 0.01, 60.0
START_MM, WANTED_MM, EARLY_MM, GEL_N_MM, ROUND_US = 80.0, 62.0, (5.0, 12.0), 8.0, 10_500


@figure("faults")
def descents_into_nothing(misses: int = MISSES) -> list[Figure]:
    """A press that ends its travel without a contact, in a whole run over the rig."""
    method = StackSettings()
    nowhere = {"max_travel_mm": 0.01, "start_height_mm": 3.0}
    probe = method.probe.model_copy(update=nowhere)
    bench = InlineBench(method.model_copy(update={"probe": probe}))
    facts: list[Event] = []
    began_mm: list[float] = []

    def hear(fact: Event) -> None:
        if isinstance(fact, PhaseEntered) and fact.phase == "approach":
            facts.clear()
            began_mm.append(height_mm())
        facts.append(fact)

    def height_mm() -> float:
        scene = bench.session._scene
        assert scene is not None
        return float(scene.stage.arm.pose(1.0).z_mm)

    bench.session.events.subscribe(hear)
    off_mm, presses, seeds = list[float](), 0, itertools.count()
    try:
        while len(off_mm) < misses:
            with suppress(TouchdownError):
                bench.session.run(StackRequest("pot", ("short",), next(seeds)))
            bench.session.reset()
            if "NO-CONTACT" not in {f.fault.code for f in facts if isinstance(f, FaultRaised)}:
                continue  # this board stood high enough
            off_mm.append(abs(height_mm() - began_mm[-1]))
            presses += sum(isinstance(f, EpisodeRecorded) for f in facts)
            presses += sum(isinstance(f, PhaseEntered) and f.phase == "press" for f in facts)
    finally:
        bench.close()
    worst = max(off_mm)
    told = f"{misses} runs of {next(seeds)}; the others met a contact"
    return [
        Figure("no contact: back to the start within", worst, "mm", "<= 0.1", worst <= BACK_MM,
               told),
        Figure("presses, or episodes, of those", presses, "", "0", presses == 0),
    ]  # fmt: skip


@figure("faults")
def contacts_too_early(count: int = EARLY) -> list[Figure]:
    """A board 5 to 12 mm too high is met by a move: how far the arm draws back, and how hard."""
    rng = np.random.default_rng(9)
    rose_mm, peak_n, broken = list[float](), list[float](), list[str]()
    for _ in range(count):
        early_mm, speed_mm_s = rng.uniform(*EARLY_MM), rng.uniform(5.0, 20.0)
        rose, peak, codes = _early(WANTED_MM + early_mm, speed_mm_s)
        rose_mm.append(rose)
        peak_n.append(peak)
        if codes != ["FT-TRIP"]:
            broken.append(f"{early_mm:.1f} mm, {speed_mm_s:.0f} mm/s: {codes}")
    low, high = min(rose_mm), max(rose_mm)
    well = not broken and low >= ROSE_MM[0] and high <= ROSE_MM[1]
    told = f"{count} descents; {low:.2f} to {high:.2f} mm" + "".join(f"; {b}" for b in broken[:2])
    hardest = max(peak_n)
    return [
        Figure("contact 5 to 12 mm early: drawn back by, least", low, "mm", "2 within the brake",
               well, told),
        Figure("the same: strongest force", hardest, "N", "<= 60", hardest <= MOST_N),
    ]  # fmt: skip


def _early(board_mm: float, speed_mm_s: float) -> tuple[float, float, list[str]]:
    """Move down on a board; return how far the arm rose again, the peak and what was told."""
    rig = Rig((0.0, 0.0, START_MM))
    rig.contact = lambda mm: np.array([0.0, 0.0, GEL_N_MM * max(board_mm - mm[2], 0.0)])
    interlock, now_s = Interlock(), rig.wires.clock.now_s
    arm = GuardedArm(rig.arm, interlock, now_s, lambda: 0.0)
    watch = Supervision(interlock, rig.wrench, {finger: Stream(finger, 4) for finger in FINGERS})
    arm.connect(1.0, threading.Event())
    rig.rest(0.1)
    # No cameras here: within the grace after a scene began nobody asks for their pictures.
    watch.begin(now_s() + 100.0)
    interlock.renew_lease(now_s())
    motion = arm.move_to(Pose(0.0, 0.0, WANTED_MM), speed_mm_s)
    lowest_mm, end_s = math.inf, now_s() + 30.0
    while not motion.done and now_s() < end_s:
        rig.wires.advance(ROUND_US)
        watch.check(now_s())
        lowest_mm = min(lowest_mm, float(rig.true_mm[2]))
    rig.rest(1.0)
    peak_n = float(rig.wrench.since(0).values[:, 2].max())
    return float(rig.true_mm[2]) - lowest_mm, peak_n, [f.code for f in interlock.faults]

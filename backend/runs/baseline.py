"""Pick-and-place: lower the piece until it touches and let go, without any test."""

from __future__ import annotations

import math

from backend.core.facts import PhaseEntered, Said
from backend.devices.interlock import ReleaseEvidence
from backend.runs.bench import Bench
from backend.runs.ending import Ending
from backend.runs.motions import MOVE_S, open_and_rise, rest, take_piece, zero_sensors
from backend.runs.outcome import after_release
from backend.runs.plan import Plan, Waiting, motion_done
from backend.runs.probe import press_command


def pick_and_place(bench: Bench) -> Plan[Ending]:
    """Release at the first place; what the paper compares with. Simulated benches only."""
    yield from take_piece(bench)
    yield from zero_sensors(bench, 1)
    yield PhaseEntered(bench.now_s(), "approach", 1)
    motion = bench.arm.press(press_command(bench))
    yield Waiting(lambda: motion.done or motion.onset_s is not None, 60.0, "contact")
    if motion.onset_s is None:
        motion.result()
    yield Said(bench.now_s(), "Pick and place: touched, now letting go without a test.")
    settings = bench.settings.release
    yield PhaseEntered(bench.now_s(), "unload", 1)
    unload = bench.arm.unload(settings.unload_n, bench.settings.probe.approach_mm_s)
    yield from motion_done(unload, MOVE_S, "the arm to unload")
    yield from rest(bench, settings.settle_s)
    yield PhaseEntered(bench.now_s(), "release", 1)
    width_mm = bench.gripper.status().width_mm
    yield from open_and_rise(bench, 1, _evidence(bench, width_mm), width_mm)
    return (yield from after_release(bench, 1))


def _evidence(bench: Bench, width_mm: float) -> ReleaseEvidence:
    now_s = bench.now_s()
    status = bench.gripper.status()
    return ReleaseEvidence(
        verdict_stable=False,
        verdict_of_last_probe=False,
        verdict_age_s=math.nan,
        margin_mm=math.nan,
        required_margin_mm=0.0,
        quality_accepted=False,
        slip_mm=0.0,
        press_n=bench.sensing.press_n(now_s, 0.1),
        wrench_age_s=0.0,
        wrench_age_limit_s=0.0,
        moved_mm=0.0,
        width_change_mm=status.width_mm - width_mm,
        holding=status.holding,
        approved=True,
    )

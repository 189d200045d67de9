"""Figures of two things that must say the same: batch and devices, judge and physics engine."""

from __future__ import annotations

import pytest

from tests.backend.one_press import CASES, RMS_LIMIT_PX, press_both_ways
from tests.backend.simulation.release_cases import SETS, ask_both
from tests.bench.registry import Figure, figure
from touchdown.backend.simulation.release_mujoco import (
    PAIR_BAND_MM,
    TOWER_BAND_MM,
    mujoco_available,
)


@figure("agreement")
def batch_against_devices() -> list[Figure]:
    """Marker rms over whole presses, noise off, equal mechanical draws."""
    rms_px = []
    for case in CASES:
        with pytest.MonkeyPatch.context() as patch:
            rms_px.append(press_both_ways(*case, patch).rms_px)
    worst_px, note = max(rms_px), f"worst of {len(rms_px)} presses; best {min(rms_px):.3f}"
    ok = worst_px <= RMS_LIMIT_PX
    target = f"<= {RMS_LIMIT_PX}"
    return [Figure("batch against devices, marker rms", worst_px, "px", target, ok, note)]


@figure("agreement")
def judge_against_engine() -> list[Figure]:
    """Random stacks on which exact judge and physics engine disagree, and how far from the edge."""
    if not mujoco_available():
        note = "needs the extra 'mujoco'"
        return [Figure("judge against MuJoCo", None, "", "0", None, note)]
    figures = []
    for name in SETS:
        asked = list(ask_both(name))
        unlike = [o for o in asked if o.unlike]
        beyond = sum(o.beyond for o in asked)
        band_mm = TOWER_BAND_MM if name == "three bodies" else PAIR_BAND_MM
        note = f"{len(asked)} cases, {len(unlike)} disagree"
        if unlike:
            far_mm = max(abs(o.verdict.margin_mm) for o in unlike)
            note += f", up to {far_mm:.3f} mm from the edge"
        text = f"judge against MuJoCo, {name}: beyond {band_mm} mm"
        figures.append(Figure(text, beyond, "cases", "0", beyond == 0, note))
    return figures

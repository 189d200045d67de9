"""Slip from the loading line, on springs with known slip."""

from __future__ import annotations

import math

import numpy as np
import pytest

from touchdown.backend.core.values import Recording
from touchdown.backend.sensing.slip import slip_since_loading

STIFFNESS_N_MM = 8.0
ONSET_S = 1.0
TOUCH_MM = 30.0


def pressed(noise_n: float = 0.1, depth_mm: float = 1.0) -> Recording:
    """A press of 1.5 s at constant speed and a hold, as the wrist and the arm report it."""
    t_s = np.arange(0.7, 3.1, 0.001)
    down_mm = depth_mm * np.clip((t_s - ONSET_S) / 1.5, 0.0, 1.0)
    wrench = np.zeros((len(t_s), 6))
    wrench[:, 2] = STIFFNESS_N_MM * down_mm
    wrench += noise_n * np.random.default_rng(1).standard_normal(wrench.shape)
    pose_t_s = np.arange(0.7, 3.1, 0.01)
    height = TOUCH_MM - depth_mm * np.clip((pose_t_s - ONSET_S) / 1.5, 0.0, 1.0)
    pose = np.column_stack([np.zeros((len(height), 2)), height])
    return Recording(t_s, wrench, (), (), pose_t_s, pose, np.zeros(6))


@pytest.mark.parametrize("slip_mm", [0.0, 0.1, 0.3, 0.8])
@pytest.mark.parametrize("press_n", [0.5, 1.0, 2.0])
def test_the_distance_between_the_lines_is_the_slip(slip_mm: float, press_n: float) -> None:
    height_mm = TOUCH_MM - press_n / STIFFNESS_N_MM - slip_mm
    found = slip_since_loading(pressed(), ONSET_S, height_mm, press_n)
    assert found == pytest.approx(slip_mm, abs=0.02)


def test_what_cannot_be_judged_is_nan() -> None:
    assert math.isnan(slip_since_loading(pressed(depth_mm=0.01), ONSET_S, 30.0, 1.0))
    assert math.isnan(slip_since_loading(pressed(), ONSET_S, 30.0, math.nan))
    blind = pressed()
    no_arm = Recording(
        blind.wrench_t_s, blind.wrench, (), (), np.zeros(0), np.zeros((0, 3)), np.zeros(6)
    )
    assert math.isnan(slip_since_loading(no_arm, ONSET_S, 30.0, 1.0))

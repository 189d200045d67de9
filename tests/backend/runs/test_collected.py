"""Labels are relative to the origin on both axes; signal excerpts keep their order."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.config.method import CollectSettings
from touchdown.backend.core.values import Episode, EpisodeQuality, Recording
from touchdown.backend.runs.collector import BottomOrigin, last_signal_excerpt, measure_offset


def test_the_label_is_where_the_arm_was_at_contact_seen_from_the_origin() -> None:
    """The arm moves by (3, -5, -2) mm/s; contact lies between two poses."""
    t_s = np.array([0.9, 1.0, 1.1])
    pose_mm = np.array([10.0, -4.0, 21.0]) + np.outer(t_s - 1.0, [3.0, -5.0, -2.0])
    recording = Recording(t_s, np.zeros((3, 6)), (), (), t_s, pose_mm, np.zeros(6))
    quality = EpisodeQuality(True, (), 0, 0.0, 0, 5.0, 0.0)
    observation = np.zeros((20, 258), np.float32)
    episode = Episode("e", "pot", observation, np.array([7.0, 9.0]), 1.04, quality, recording)
    settings = CollectSettings(arm_sigma_mm=0.02, grip_sigma_mm=0.03)
    found = measure_offset(episode, BottomOrigin(8.5, -1.25, 0.06), settings)
    assert found.offset_mm == pytest.approx((1.62, -2.95))
    assert found.contact_mm == pytest.approx(20.92)
    assert found.sigma_mm == pytest.approx(0.07)
    label = found.label()
    assert (label.x_um, label.y_um, label.theta_mdeg, label.sigma_um) == (1620, -2950, 0, 70)


def test_the_signals_of_a_probe_are_its_largest_shifts_and_tx_ty_fz() -> None:
    observation = np.zeros((20, 258), np.float32)
    observation[-1, [10, 70, 140, 200]] = 2.0, -3.0, -2.5, 1.5  # u, v of the left; of the right
    observation[-1, 252:] = 0.1, 0.2, 9.0, -0.04, 0.05, 0.06
    assert last_signal_excerpt(observation) == pytest.approx((-2.5, -3.0, -0.04, 0.05, 9.0))

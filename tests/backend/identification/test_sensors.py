"""Noise, drift, delays and compliance against made signals of known values."""

from dataclasses import replace

import numpy as np
import pytest

from tests.backend.identification.made import made_press
from touchdown.backend.core import MarkerField, Recording
from touchdown.backend.identification.estimates import mean_estimate, spread_estimate
from touchdown.backend.identification.recordings import RestRecording
from touchdown.backend.identification.sensors import (
    arm_compliance,
    delay_estimates,
    estimate_delays,
    flicker,
    identify_rest,
    quantum,
    walk_rate,
)


def test_the_rate_of_a_random_walk_lies_within_its_uncertainty():
    pulls = []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        walk = 0.02 * np.cumsum(rng.standard_normal((4000, 3)), axis=0) / np.sqrt(20.0)
        values = walk + 0.05 * rng.standard_normal(walk.shape)
        means = values.reshape(200, 20, 3).mean(axis=1)
        rate, sd = walk_rate(means, 0.05**2 / 20, 1.0)
        pulls.append((rate - 0.02) / sd)
    assert np.mean(np.abs(pulls) < 1.96) >= 0.9
    assert abs(np.mean(pulls)) < 0.5


@pytest.mark.parametrize(("wrench_s", "markers_s"), [(0.0, 0.0), (0.03, 0.02), (0.008, 0.06)])
def test_delays_are_recovered(wrench_s, markers_s):
    made = [made_press(k, wrench_late_s=wrench_s, markers_late_s=markers_s) for k in range(6)]
    estimates, taken = delay_estimates(estimate_delays(made))
    found = {e.key: e for e in estimates}
    assert found["delay.pose_wrench"].value == pytest.approx(wrench_s, abs=0.003)
    assert found["delay.wrench_markers"].value == pytest.approx(markers_s, abs=0.004)
    assert taken.markers_s == pytest.approx(wrench_s + markers_s, abs=0.005)


def test_the_stiffness_of_the_arm_follows_from_command_pose_and_force():
    def yielding(press):
        s = press.signals
        force = np.interp(s.pose_t_s, s.wrench_t_s, s.wrench[:, 2])
        command = s.pose_mm - np.stack([0 * force, 0 * force, force / 15.0], axis=1)
        return replace(press, signals=replace(s, command_mm=command))

    found = {e.key: e for e in arm_compliance([yielding(made_press(k)) for k in range(6)])}
    one = found["arm.stiffness_z"]
    assert one.low < 15.0 < one.high


def test_rest_gives_noise_timing_and_losses():
    rng = np.random.default_rng(3)
    t_s = np.arange(0.0, 60.0, 2e-3)
    wrench = rng.standard_normal((len(t_s), 6)) * np.repeat([0.07, 0.003], 3)
    fields = []
    for finger in ("left", "right"):
        for k in range(1500):
            if k % 100 == 7:
                continue
            moved = 0.04 * rng.standard_normal((63, 2))
            at = 0.04 * k + rng.uniform(-0.005, 0.005)
            fields.append(
                MarkerField(finger, k, at, moved, moved, np.zeros(63, np.uint8), 1.0, 0.0)
            )
    rest = Recording(t_s, wrench, tuple(fields), (), t_s[:2], np.zeros((2, 3)), np.zeros(6))
    levels = (np.full(20, 100.0), 100.0 * (1.0 + 0.01 * (-1.0) ** np.arange(20)))
    found = identify_rest(RestRecording((rest,), levels, lossless=True))
    true = {"wrist.white_n": 0.07, "wrist.white_nm": 0.003, "tactile.white_px": 0.04,
            "tactile.jitter_s": 0.005, "tactile.rate_hz": 25.0, "wrist.rate_hz": 500.0}  # fmt: skip
    for one in found.estimates:
        if one.key in true:
            assert one.value == pytest.approx(true[one.key], rel=0.03), one.key
    shares = {one.key: one.value for one in found.estimates}
    assert shares["tactile.drop_share"] == pytest.approx(0.01, abs=1e-3)
    assert shares["wrist.drift_n_sqrt_min"] < 0.01
    assert dict(found.facts)["flicker, right"].startswith("1.000 %")


def test_compressed_images_give_a_bound_only():
    assert flicker(np.full(20, 100.0), lossless=False).startswith("at least")
    assert "not recorded" in flicker(np.zeros(0), lossless=True)


def test_a_quantised_signal_shows_its_step():
    rng = np.random.default_rng(0)
    values = np.round(rng.standard_normal((5000, 1)) / 0.05) * 0.05
    assert quantum(values) == pytest.approx(0.05)
    assert quantum(rng.standard_normal((5000, 1))) == 0.0


def test_intervals_of_means_and_spreads_cover_the_truth():
    covered = np.zeros(2)
    for seed in range(400):
        rng = np.random.default_rng(seed)
        draws = 4.0 * (1.0 + 0.1 * rng.standard_normal(8))
        seen = draws + 0.1 * rng.standard_normal(8)
        mean = mean_estimate("grasp.shear_n_mm", seen, np.full(8, 0.1))
        spread = spread_estimate("spread.gel", seen / seen.mean() - 1.0, np.full(8, 0.025), 7)
        covered += (mean.low < 4.0 < mean.high, spread.low < 0.1 < spread.high)
    assert (covered / 400 >= 0.93).all()

"""Contact detection and back-dating against forces with a known onset."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.contact_onset import (
    OnsetDetector,
    OnsetRule,
    back_date_onset,
    detect_contact,
    force_over_baseline,
)

RULE = OnsetRule()
T_S = 1e-3 * np.arange(1200)
ONSET_S = 0.8


def ramp(slope_n_s: float, onset_s: float = ONSET_S):
    return slope_n_s * np.maximum(T_S - onset_s, 0.0)


def onset_of(force, t_s=T_S):
    over = force_over_baseline(np.atleast_2d(force))
    found = detect_contact(over)
    return found, back_date_onset(t_s, over, found)


@pytest.mark.parametrize("slope_n_s", [8.0, 10.0, 40.0])
def test_a_clean_ramp_is_dated_to_its_foot(slope_n_s) -> None:
    found, onset = onset_of(ramp(slope_n_s))
    assert onset[0] == pytest.approx(ONSET_S, abs=1e-9)
    crossing = np.flatnonzero(ramp(slope_n_s) > 1.0)[0]
    assert found[0] == crossing + 2


def test_a_very_soft_grasp_is_still_found() -> None:
    # At 4 N/s contact has crept into the baseline window by the time it is declared.
    found, onset = onset_of(ramp(4.0))
    assert T_S[found[0]] - ONSET_S > 0.25
    assert onset[0] == pytest.approx(ONSET_S, abs=5e-3)


def test_the_baseline_ends_200_ms_before_the_sample() -> None:
    force = np.zeros(600)
    force[100:300] = 5.0
    over = force_over_baseline(force)
    assert np.isnan(over[:400]).all()
    for i in (400, 450, 599):
        assert over[i] == pytest.approx(force[i] - force[i - 400 : i - 200].mean())


@pytest.mark.promise("S8")
def test_a_constant_load_and_a_slow_drift_are_no_contact() -> None:
    force = 14.7 + 0.5 * T_S
    found, onset = onset_of(force)
    assert found[0] == -1
    assert np.isnan(onset[0])


def test_two_high_samples_are_not_contact_three_are() -> None:
    for length, wanted in ((2, -1), (3, 702)):
        force = np.zeros(1200)
        force[700 : 700 + length] = 2.0
        assert onset_of(force)[0][0] == wanted


def test_noise_of_the_bench_neither_triggers_nor_biases_much() -> None:
    rng = np.random.default_rng(1)
    air = 0.1 * rng.standard_normal((50, 5000))
    assert (detect_contact(force_over_baseline(air)) == -1).all()
    pressed = ramp(10.0) + 0.1 * rng.standard_normal((400, 1200))
    over = force_over_baseline(pressed)
    found = detect_contact(over)
    error_s = back_date_onset(T_S, over, found) - ONSET_S
    assert (found >= 0).all()
    assert abs(error_s.mean()) < 2e-3
    assert error_s.std() < 6e-3


def test_rows_may_have_their_own_times() -> None:
    force = np.stack([ramp(10.0), ramp(6.0)])
    over = force_over_baseline(force)
    found = detect_contact(over)
    shifted = np.stack([T_S, T_S + 0.5])
    np.testing.assert_allclose(back_date_onset(shifted, over, found), [ONSET_S, ONSET_S + 0.5])


@pytest.mark.parametrize("chunk", [1, 7, 10, 400, 1200])
def test_the_stream_gives_what_the_whole_signal_gives(chunk) -> None:
    rng = np.random.default_rng(2)
    force = ramp(9.0) + 0.1 * rng.standard_normal(1200)
    found, onset = onset_of(force)
    detector = OnsetDetector(RULE)
    declared_at = None
    for start in range(0, 1200, chunk):
        part = slice(start, start + chunk)
        if detector.feed(T_S[part], force[part]):
            declared_at = start
            break
    assert declared_at == found[0] // chunk * chunk
    assert detector.detected_s == pytest.approx(T_S[found[0]])
    assert detector.onset_s == pytest.approx(onset[0], abs=1e-9)


def test_the_stream_stays_bounded_and_quiet_in_air() -> None:
    rng = np.random.default_rng(3)
    detector = OnsetDetector()
    for k in range(500):
        t_s = 1e-2 * k + 1e-3 * np.arange(10)
        assert not detector.feed(t_s, 14.7 + 0.1 * rng.standard_normal(10))
    assert detector.onset_s is None
    assert len(detector._force_n) <= 2 * RULE.lead


def test_a_sample_that_is_no_number_is_not_contact() -> None:
    force = ramp(10.0)
    force[600] = np.nan
    found, _ = onset_of(force)
    assert found[0] == -1

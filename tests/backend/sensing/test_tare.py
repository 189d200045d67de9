from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchdown.backend.core.faults import FaultError
from touchdown.backend.sensing.zeroing import Tare, TareLimits, gripper_payload, take_tare

AIR = np.array([0.1, 0.1, 0.1, 0.004, 0.004, 0.004])
T_S = np.arange(200) * 1e-3
PAYLOAD = gripper_payload(1.5, (0.0, 0.0, -60.0))


def air(seed: int, level: np.ndarray) -> np.ndarray:
    return level + AIR * np.random.default_rng(seed).standard_normal((200, 6))


def test_payload_of_the_gripper_is_its_weight() -> None:
    assert PAYLOAD[2] == pytest.approx(-14.71, abs=0.005)
    # 2 kg at 10 mm along x and -4 mm along y turn the sensor about +y and +x (r x F).
    turned = gripper_payload(2.0, (10.0, -4.0, -50.0))
    expected = np.cross([0.010, -0.004, -0.050], turned[:3])
    np.testing.assert_allclose(turned[3:], expected, atol=1e-12)
    np.testing.assert_allclose(turned[3:], (0.0785, 0.1961, 0.0), atol=1e-4)


def test_tare_removes_payload_piece_and_offset() -> None:
    level = PAYLOAD + np.array([0.2, -0.1, -0.3, 0.01, 0.0, -0.01])
    tare = take_tare(T_S, air(1, level), PAYLOAD)
    contact = np.array([0.8, 0.0, 7.7, 0.0, 0.09, 0.0])
    # The mean of 200 samples errs by sigma / sqrt(200); five of these hold for every channel.
    np.testing.assert_array_less(np.abs(tare.apply(level + contact) - contact), 5 * AIR / 14.1)
    np.testing.assert_allclose(tare.total, tare.payload + tare.offset)


def test_zero_tare_changes_nothing() -> None:
    values = np.arange(12.0).reshape(2, 6)
    np.testing.assert_array_equal(Tare.zero().apply(values), values)


def test_still_air_is_never_refused() -> None:
    for seed in range(100):
        take_tare(T_S, air(seed, PAYLOAD), PAYLOAD)


@pytest.mark.promise("S8")
def test_tare_while_touching_is_refused_100_times_of_100() -> None:
    touching = PAYLOAD + np.array([0.0, 0.0, 3.4, 0.0, 0.0, 0.0])
    for seed in range(100):
        with pytest.raises(FaultError, match="touches something"):
            take_tare(T_S, air(seed, touching), PAYLOAD)


def test_motion_noise_and_gaps_are_refused() -> None:
    moving = air(0, PAYLOAD)
    moving[:, 2] += np.linspace(0.0, 2.0, 200)
    with pytest.raises(FaultError, match="TARE-REFUSED"):
        take_tare(T_S, moving)
    shaking = air(0, PAYLOAD)
    shaking[:, 4] += 0.05 * np.sin(2 * np.pi * 50 * T_S)
    with pytest.raises(FaultError, match="noise"):
        take_tare(T_S, shaking)
    with pytest.raises(FaultError, match="too few"):
        take_tare(T_S[:100], air(0, PAYLOAD)[:100])
    with pytest.raises(FaultError, match="too few"):
        take_tare(np.zeros(0), np.zeros((0, 6)))


@given(
    row=st.integers(0, 199),
    channel=st.integers(0, 5),
    bad=st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_one_bad_sample_refuses(row: int, channel: int, bad: float) -> None:
    values = air(3, PAYLOAD)
    values[row, channel] = bad
    with pytest.raises(FaultError, match="not a finite number"):
        take_tare(T_S, values, PAYLOAD)


def test_limits_are_settings() -> None:
    noisy = air(4, PAYLOAD) + air(5, np.zeros(6))
    with pytest.raises(FaultError):
        take_tare(T_S, noisy, PAYLOAD, TareLimits(noise=(0.1, 0.004)))
    take_tare(T_S, noisy, PAYLOAD)

"""Drift of the wrist sensor on a manual clock: reported in time, and never without cause."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.backend.sensing.known_truth import GELSIGHT
from touchdown.backend.core import FaultError, MarkerField, RefusedError, TactileFrame
from touchdown.backend.sensing import (
    MarkerTracker,
    TactileReference,
    WrenchDrift,
    WrenchDriftEstimator,
    gripper_payload,
    read_pictures,
    take_reference,
)
from touchdown.backend.sensing.slip import fit_rigid
from touchdown.backend.sensing.zeroing import WARN_DRIFT_N, shape_change_px, take_tare

WEIGHT_N = np.array([0.3, -0.2, -15.2])
NOISE_N = 0.1


class Hanging:
    """A sensor of ``hz`` with a payload, read every ``read_s``."""

    def __init__(self, hz: float = 1000.0, seed: int = 1, read_s: float = 0.1) -> None:
        self.watch, self.now_s = WrenchDriftEstimator(), 0.0
        self._count, self._read_s, self._hz = round(hz * read_s), read_s, hz
        self._rng = np.random.default_rng(seed)
        self.error_n = np.zeros(3)
        self.named_at: list[tuple[float, float]] = []
        """When it was named, and the true drift then."""
        self._named = False

    def stand(self, seconds: float, n_per_s: float = 0.0, load_n: float = 0.0) -> None:
        for _ in range(round(seconds / self._read_s)):
            t_s = self.now_s + np.arange(1, self._count + 1) / self._hz
            self.now_s += self._read_s
            self.error_n = self.error_n + np.array([0.0, 0.0, n_per_s * self._read_s])
            force_n = WEIGHT_N + self.error_n + NOISE_N * self._rng.standard_normal((len(t_s), 3))
            force_n[:, 2] += load_n
            self.watch.feed(t_s, force_n)
            found = self.watch.drift()
            named = found is not None and found.named
            if named and not self._named:
                self.named_at.append((self.now_s, float(np.linalg.norm(self.error_n))))
            self._named = named

    def away(self, seconds: float, n_per_s: float = 0.0) -> None:
        self.watch.leave()
        self.now_s += seconds
        self.error_n = self.error_n + np.array([0.0, 0.0, n_per_s * seconds])


@pytest.mark.promise("S8")
@pytest.mark.parametrize(
    ("hz", "n_per_s"),
    [(100.0, 0.002), (100.0, 0.05), (1000.0, 0.05), (1000.0, -0.05), (100.0, -0.1)],
)
def test_a_drift_is_named_between_half_a_newton_and_one(n_per_s: float, hz: float) -> None:
    sensor = Hanging(hz)
    sensor.stand(8.0)
    sensor.stand(1.0 / abs(n_per_s), n_per_s)
    ((_, true_n),) = sensor.named_at
    assert WARN_DRIFT_N - 0.1 < true_n < 0.8


@pytest.mark.promise("S8")
def test_in_a_run_it_is_named_though_each_probe_tares() -> None:
    """Half a second of air before each probe, five seconds out of it."""
    sensor = Hanging()
    sensor.stand(2.0)
    while not sensor.named_at and sensor.now_s < 60.0:
        sensor.away(5.0, 0.05)
        sensor.stand(0.6, 0.05)
    assert sensor.named_at[0][1] < 1.0


@pytest.mark.promise("S8")
def test_what_is_touched_or_hung_on_is_a_load_and_no_drift() -> None:
    sensor = Hanging()
    sensor.stand(6.0)
    for load_n in (3.0, 0.4, -0.4, 12.0, 0.0) * 4:
        sensor.stand(1.0, load_n=load_n)
    assert sensor.watch.drift().moved_n < 0.1
    sensor.watch.reload()
    sensor.stand(3.0, load_n=-0.3)
    assert sensor.watch.drift().moved_n < 0.1, "another piece"
    assert not sensor.named_at


@pytest.mark.promise("S8")
def test_a_good_sensor_is_never_named_in_a_day_of_probes() -> None:
    """Air, a press out of it, air again: 24 hours, with the wandering of the simulated sensor."""
    rng = np.random.default_rng(8)
    watch, t_s, walk_n = WrenchDriftEstimator(), 0.0, np.zeros(3)
    worst_n = 0.0
    while t_s < 86_400.0:
        for _ in range(2):
            stamps = t_s + np.linspace(0.05, 0.5, 10)
            sigma_n = NOISE_N / np.sqrt(50.0)
            watch.feed(stamps, WEIGHT_N + walk_n + sigma_n * rng.standard_normal((10, 3)))
            t_s += 0.5
        watch.leave()
        t_s += 29.0
        walk_n = walk_n + 0.01 * np.sqrt(30.0 / 60.0) * rng.standard_normal(3)
        found = watch.drift()
        if found is not None:
            worst_n = max(worst_n, found.moved_n)
            assert not found.named
    assert 0.02 < worst_n < 0.5 * WARN_DRIFT_N


def test_the_word_is_taken_back_once_it_stands_and_comes_once() -> None:
    sensor = Hanging(100.0)
    sensor.stand(6.0)
    sensor.stand(14.0, 0.05)
    sensor.stand(250.0)
    assert sensor.watch.drift().named
    sensor.stand(120.0)
    assert not sensor.watch.drift().named
    assert len(sensor.named_at) == 1


def test_samples_that_are_no_numbers_are_left_out() -> None:
    watch = WrenchDriftEstimator()
    for k in range(600):
        t_s = 0.02 * k + np.array([0.01, 0.02])
        watch.feed(t_s, np.array([[np.nan] * 3, [0.0, 0.0, 1.0]]))
    assert watch.drift() == WrenchDrift(0.0, pytest.approx(watch.drift().over_s))


def test_the_words_of_a_drift() -> None:
    assert WrenchDrift(0.124, 42.2).words() == "drift 0.12 N in 42 s"
    assert WrenchDrift(0.124, 240.0).words() == "drift 0.12 N in 4 min"
    assert WrenchDrift(0.124, 240.0).text() == "0.124 N in 240.0 s"


ROW, COL = np.divmod(np.arange(63), 9)
GRID = np.stack([20 + 33.0 * COL, 18 + 32.0 * ROW], axis=1)


def made(
    position: np.ndarray, k: int = 0, *, hidden: int = 0, rest: np.ndarray | None = None
) -> MarkerField:
    state = np.zeros(63, np.uint8)
    state[:hidden] = 1
    moved = position - (GRID if rest is None else rest)
    return MarkerField("left", k, k / 25, position.copy(), moved.copy(), state, 1.0)


def still(count: int = 10, sigma: float = 0.03) -> list[MarkerField]:
    rng = np.random.default_rng(0)
    return [made(GRID + rng.normal(0, sigma, GRID.shape), k) for k in range(count)]


def test_reference_is_the_mean_with_the_noise_of_each_marker() -> None:
    fields = still(200)
    reference = take_reference(fields)
    np.testing.assert_allclose(reference.position_px, GRID, atol=0.01)
    np.testing.assert_allclose(reference.noise_px, 0.03, rtol=0.25)
    assert reference.frames == 200
    assert reference.t_s == fields[-1].t_s


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        (still(2), "frames"),
        ([*still(9), made(GRID, 9, hidden=1)], "markers"),
        ([made(GRID + 0.1 * k, k) for k in range(10)], "motion"),
    ],
)
def test_reference_is_refused(fields: list[MarkerField], reason: str) -> None:
    with pytest.raises(RefusedError) as refused:
        take_reference(fields)
    assert refused.value.reason == reason


def tracked(name: str) -> list[MarkerField]:
    image = next(read_pictures(GELSIGHT / name)).image
    tracker = MarkerTracker("left")
    return [tracker.track(TactileFrame("left", k, k / 25, image)) for k in range(10)]


@pytest.mark.promise("C7")
def test_a_pressed_gel_is_refused_against_the_stored_template() -> None:
    template = take_reference(tracked("nocontact_train_sensor.png"))
    with pytest.raises(RefusedError) as refused:
        take_reference(tracked("cuboid_10-2-284.png"), template)
    assert refused.value.reason == "contact"
    again = take_reference(tracked("nocontact_train_sensor.png"), template)
    np.testing.assert_allclose(again.position_px, template.position_px, atol=1e-9)


def test_moving_and_stretching_the_whole_grid_is_no_contact() -> None:
    stretch = np.array([[1.01, 0.02], [-0.02, 0.99]])
    moved = GRID @ stretch + [3.0, -2.0]
    assert shape_change_px(moved, GRID) == pytest.approx(0.0, abs=1e-9)
    template = TactileReference("left", 0.0, GRID.copy(), np.zeros(63), 10)
    take_reference([made(moved, k) for k in range(5)], template)


@pytest.mark.parametrize("turn", [-0.3, 0.002, 0.1])
def test_rigid_fit_finds_the_motion_it_was_made_of(turn: float) -> None:
    c, s = np.cos(turn), np.sin(turn)
    middle = GRID.mean(axis=0)
    moved = (GRID - middle) @ np.array([[c, s], [-s, c]]) + middle + [2.0, -1.0]
    motion = fit_rigid(GRID, moved - GRID)
    np.testing.assert_allclose(motion.shift_px, [2.0, -1.0], atol=1e-9)
    assert motion.turn_rad == pytest.approx(turn)
    assert motion.residual_px == pytest.approx(0.0, abs=1e-9)


def test_rigid_fit_leaves_shear_as_residual() -> None:
    gamma = 0.02
    shear = np.stack([gamma * (GRID[:, 1] - GRID[:, 1].mean()), np.zeros(63)], axis=1)
    # Simple shear is half turn and half pure shear: the residual is that of the pure half.
    x, y = (GRID - GRID.mean(axis=0)).T
    best = min(
        np.sqrt(((gamma * y + a * y) ** 2 + (a * x) ** 2).mean())
        for a in np.linspace(-0.02, 0.02, 4001)
    )
    assert fit_rigid(GRID, shear).residual_px == pytest.approx(best, rel=1e-3)


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


@pytest.mark.promise("S8")
def test_a_tare_is_refused_while_touching_and_never_in_still_air() -> None:
    touching = PAYLOAD + np.array([0.0, 0.0, 3.4, 0.0, 0.0, 0.0])
    for seed in range(100):
        take_tare(T_S, air(seed, PAYLOAD), PAYLOAD)
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

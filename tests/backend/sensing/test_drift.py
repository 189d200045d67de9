"""Drift of the wrist sensor on a manual clock: reported in time, and never without cause."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.sensing.zeroing import WARN_DRIFT_N, WrenchDrift, WrenchDriftEstimator

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

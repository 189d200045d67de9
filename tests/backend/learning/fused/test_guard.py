"""Guard: its martingale against a library, false and true alarms, and the state on disk."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.special import gammainc, gammaln

from touchdown.backend.config import bench_sha256, load_simulation
from touchdown.backend.core import InputError
from touchdown.backend.learning.fused import (
    ALARM,
    Guard,
    GuardCalibration,
    GuardFile,
    PowerMartingale,
    ScoreRanks,
    guard_path,
    load_fused,
    network_path,
    open_guard,
    signal_score,
)

P_VALUES = (0.03, 0.5, 0.9, 0.01, 0.2, 0.002, 0.7)
# Value after the last of P_VALUES of ``SimpleMixtureMartingale`` of online-cp 0.4.0 that starts
# before the first, second, ... of them.
LIBRARY = (
    18.220995691582274, 6.571376000181795, 10.255997035185933, 24.974692738622892,
    4.60502939798477, 4.828901766883799, 0.5651483355002701,
)  # fmt: skip


def mixture(p_values):
    """Integral of the power martingales over the power, in closed form."""
    n, load = len(p_values), -np.log(p_values).sum()
    log = load + gammaln(n + 1) + np.log(gammainc(n + 1, load)) - (n + 1) * np.log(load)
    return float(np.exp(log))


def test_the_martingale_agrees_with_a_library_and_its_closed_form():
    martingale = PowerMartingale()
    for p in P_VALUES:
        martingale.update(p)
    n = len(P_VALUES)
    starts = [mixture(P_VALUES[k:]) for k in range(n)]
    assert starts == pytest.approx(LIBRARY, rel=1e-9)
    expected = sum(s / ((k + 1) * (k + 2)) for k, s in enumerate(LIBRARY)) + 1 / (n + 1)
    assert martingale.value == pytest.approx(expected, rel=1e-9)


def test_the_next_value_is_expected_to_be_the_present_one():
    nodes, weights = np.polynomial.legendre.leggauss(160)
    for done in ((), (0.01,), (0.3, 0.02, 0.8)):
        ahead = []
        for p in 0.5 * (nodes + 1.0):
            martingale = PowerMartingale()
            for past in done:
                martingale.update(past)
            now = martingale.value
            martingale.update(float(p) ** 20)  # resolves the pole at 0
            ahead.append(martingale.value * 20.0 * p**19)
        assert 0.5 * weights @ ahead == pytest.approx(now, rel=2e-2)


def test_p_values_are_conservative_ranks_within_the_piece():
    ranks = ScoreRanks({"pot": (1.0, 2.0, 3.0, 4.0), "mug": (10.0, 20.0)})
    assert ranks.p_value("pot", 2.5) == 3 / 5
    assert ranks.p_value("pot", 2.5) == 4 / 6  # a tie counts as larger; the first one is known
    assert ranks.p_value("pot", 99.0) == 1 / 7
    assert ranks.p_value("mug", 15.0) == 2 / 3
    assert ranks.p_value("new", 15.0) == 2 / 7  # compared with the whole calibration


def sequence(rng, length, shift=0.0, calibrated=60):
    """Trials until the alarm on scores of three pieces, None without."""
    scale = {"pot": 1.0, "barrel": 2.0, "mug": 5.0}
    own = {name: tuple(size * rng.lognormal(size=calibrated)) for name, size in scale.items()}
    ranks, martingale = ScoreRanks(own), PowerMartingale()
    for k in range(length):
        piece = list(scale)[int(rng.integers(3))]
        score = scale[piece] * rng.lognormal(mean=shift)
        martingale.update(ranks.p_value(piece, score))
        if martingale.value >= ALARM:
            return k + 1
    return None


def test_false_alarms_are_rare_whatever_the_scores():
    rng = np.random.default_rng(5)
    ends = [sequence(rng, 200) for _ in range(150)]
    assert sum(end is not None for end in ends) <= 0.05 * len(ends)


def test_changed_signals_are_found_within_a_few_trials():
    rng = np.random.default_rng(6)
    ends = [sequence(rng, 20, shift=3.0) for _ in range(50)]
    assert sum(end is not None for end in ends) >= 45


def test_a_change_after_many_trials_is_found_too():
    rng = np.random.default_rng(7)
    guard = Guard(calibration(rng))
    for _ in range(300):
        guard.observe("pot", float(rng.lognormal()))
    assert not guard.withdrawn
    for _ in range(12):
        guard.observe("pot", 1e3)
    assert guard.withdrawn


def calibration(rng=None, bench="bench-v1"):
    rng = rng or np.random.default_rng(1)
    scores = {"pot": tuple(map(float, rng.lognormal(size=120)))}
    return GuardCalibration(
        bench=bench, bench_sha256=bench * 2, code="c", date="2026-01-01", scores=scores
    )


def test_signals_that_are_not_finite_have_the_largest_score():
    assert signal_score((1.0, 0.02)) == pytest.approx(3.0)
    largest = [signal_score(pair) for pair in ((np.nan, 0.0), (1.0, np.inf), (1e12, 0.0))]
    assert largest == [1e9] * 3


def test_an_alarm_stays_on_disk_until_a_reset_with_a_reason(tmp_path):
    path = tmp_path / "data" / "guard.json"
    guard = Guard(calibration(), path)
    words = [guard.describe()]
    for _ in range(8):
        guard.observe("pot", signal_score((np.nan, 0.0)))
        assert guard.save() == ""
        words.append(guard.describe())
        again = Guard(calibration(), path)
        assert (again.state, again.martingale.value) == (guard.state, guard.martingale.value)
    assert words[0] == "Signals look as in calibration (0 trials compared)."
    assert words[1] == "Signals look as in calibration (1 trial compared)."
    assert words[-1].startswith("Signals differ from calibration: each release is asked (since 2")
    assert any(first != last for first, last in pairwise(words))

    other = calibration(np.random.default_rng(2))
    assert Guard(other, path).withdrawn, "a new calibration does not clear an alarm"
    assert not Guard(other, path).state.observed
    with pytest.raises(InputError, match="reason"):
        guard.reset("  ")
    guard.reset("new gels, calibrated again")
    found = Guard(calibration(), path)
    assert (found.withdrawn, found.martingale.value) == (False, 1.0)
    (reset,) = found.state.resets
    assert reset[1:] == ("new gels, calibrated again", 8)


def test_a_damaged_state_is_refused_and_a_full_disk_is_told(tmp_path):
    path = tmp_path / "guard.json"
    path.write_text('{"observed": []}')
    with pytest.raises(InputError, match="damaged") as caught:
        Guard(calibration(), path)
    assert caught.value.where == str(path)
    (tmp_path / "file").write_text("")
    guard = Guard(calibration(), tmp_path / "file" / "guard.json")
    guard.observe("pot", 1.0)
    assert "cannot be written" in guard.save()
    before = guard.state
    with pytest.raises(InputError, match="cannot be written"):
        guard.reset("new gels")
    assert guard.state == before


def test_a_guard_is_that_of_its_network_and_bench(tmp_path):
    weights, states = tmp_path / "fused.safetensors", tmp_path / "guards"
    assert open_guard(weights, "w", "b", states) is None
    first, second = calibration(), calibration(bench="bench-v2")
    content = GuardFile(weights_sha256="w", benches=(first, second)).model_dump_json()
    guard_path(weights).write_text(content)
    assert open_guard(weights, "w", "b", states) is None
    guard = open_guard(weights, "w", second.bench_sha256, states)
    guard.observe("pot", 1.0)
    assert guard.save() == ""
    assert open_guard(weights, "w", second.bench_sha256, states).state == guard.state
    assert not open_guard(weights, "w", first.bench_sha256, states).state.observed
    with pytest.raises(InputError, match="another network"):
        open_guard(weights, "x", first.bench_sha256, states)


@pytest.mark.parametrize(("weights", "preset"), [("", "bench-v1"), ("any", "bench-v2")])
def test_the_shipped_networks_have_a_guard_on_their_bench(weights, preset, tmp_path):
    path, bench = network_path(weights), bench_sha256(load_simulation(None, preset))
    guard = open_guard(path, load_fused(path).card.weights_sha256, bench, tmp_path)
    for piece in ("pot", "barrel", "mushroom"):
        for _ in range(10):
            guard.observe(piece, 20.0)
    assert guard.withdrawn, "a field of which a fifth is of no typical form"

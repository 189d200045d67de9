"""Calibration of contact probabilities against closed forms and an optimiser of scipy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.special import expit, logit

from touchdown.backend.learning import PatchCalibration, fit_calibration, load_card
from touchdown.backend.learning.calibration import LOGIT_LIMIT, limited_logit
from touchdown.backend.learning.metrics import calibration_error, reliability
from touchdown.backend.placement import shipped_model


def drawn(
    prior: float, temperature: float, count: int = 60_000, seed: int = 3
) -> tuple[np.ndarray, np.ndarray]:
    """Predictions of a sensor with normal noise, overconfident by ``temperature``; the truth."""
    rng = np.random.default_rng(seed)
    truth = rng.random(count) < prior
    signal = rng.normal(np.where(truth, 0.7, -0.7), 1.0)
    exact = logit(prior) + 1.4 * signal  # log likelihood ratio of two unit normals at +-0.7
    return expit(temperature * exact)[:, None], truth[:, None]


def test_an_overconfident_sensor_gets_its_temperature_and_prior_back() -> None:
    fitted = fit_calibration(*drawn(0.3, 2.0))
    assert fitted.temperature == pytest.approx(2.0, rel=0.05)
    assert fitted.bias == pytest.approx(0.0, abs=0.05)
    assert fitted.prior == pytest.approx(0.3, abs=0.01)
    assert fitted.probes == 60_000


@pytest.mark.parametrize(("prior", "temperature"), [(0.2, 3.0), (0.5, 0.6), (0.8, 1.0)])
def test_the_fit_is_that_of_a_general_optimiser(prior: float, temperature: float) -> None:
    probability, truth = drawn(prior, temperature, 4000)
    z, y = limited_logit(probability).ravel(), truth.ravel().astype(float)

    def loss(x: np.ndarray) -> float:
        return float(np.mean(np.logaddexp(0.0, x[0] * z + x[1]) - y * (x[0] * z + x[1])))

    best = minimize(loss, (1.0, 0.0), method="Nelder-Mead", options={"xatol": 1e-9, "fatol": 1e-14})
    fitted = fit_calibration(probability, truth)
    assert (1.0 / fitted.temperature, fitted.bias) == pytest.approx(best.x, abs=1e-5)


def test_the_expected_calibration_error_falls_on_probes_that_were_not_fitted() -> None:
    fitted = fit_calibration(*drawn(0.35, 2.0))
    probability, truth = drawn(0.35, 2.0, seed=4)
    before, after = (
        calibration_error(reliability(p, truth))
        for p in (probability, fitted.posterior(probability))
    )
    assert before > 0.03
    assert after < 0.2 * before
    assert fitted.error_before == pytest.approx(before, abs=0.01)
    assert fitted.error_after == pytest.approx(after, abs=0.01)


def test_evidence_of_independent_probes_gives_the_posterior_of_bayes_rule() -> None:
    """Two readings of a sensor with P(1 | contact) = 0.8 and P(1 | none) = 0.3; prior 0.25."""
    prior, hit, false = 0.25, 0.8, 0.3
    said = {1: prior * hit, 0: prior * (1 - hit)}
    other = {1: (1 - prior) * false, 0: (1 - prior) * (1 - false)}
    single = {r: said[r] / (said[r] + other[r]) for r in (0, 1)}
    fitted = PatchCalibration(temperature=1.0, bias=0.0, prior=prior)
    for first in (0, 1):
        for second in (0, 1):
            both = np.array([single[first], single[second]])
            found = expit(fitted.prior_log_odds + fitted.evidence(both).sum())
            yes = said[first] * said[second] / prior
            no = other[first] * other[second] / (1 - prior)
            assert found == pytest.approx(yes / (yes + no), abs=1e-12)
    assert fitted.posterior(np.array([single[1]]))[0] == pytest.approx(single[1])


def test_certain_predictions_stay_finite() -> None:
    fitted = PatchCalibration(temperature=2.0, bias=0.0, prior=0.5)
    found = fitted.evidence(np.array([0.0, 1.0]))
    np.testing.assert_allclose(found, [-LOGIT_LIMIT / 2, LOGIT_LIMIT / 2])


@pytest.mark.parametrize(
    ("probability", "truth", "words"),
    [
        ([0.2, 0.7], [True, True], "with and without contact"),
        ([0.4, 0.4], [True, False], "do not vary"),
        ([0.2, 0.7], [False, True], "converge"),
        ([0.8, 0.7, 0.3, 0.2], [False, True, False, True], "do not increase"),
        ([np.nan, 0.7], [False, True], "finite"),
    ],
)
def test_probes_that_determine_no_calibration_are_refused(
    probability: list[float], truth: list[bool], words: str
) -> None:
    with pytest.raises(ValueError, match=words):
        fit_calibration(np.array(probability)[:, None], np.array(truth)[:, None])


@pytest.mark.parametrize("piece", ["pot", "barrel", "mushroom", "mug"])
def test_the_shipped_models_have_a_calibration(piece: str) -> None:
    own = shipped_model(piece)
    bench = own.parent / "bench-v1"
    cards: list[Path] = [own, *bench.glob(f"{piece}-ft*.safetensors"), *bench.glob(f"{piece}-tac*")]
    for path in cards:
        fitted = load_card(path).calibration
        assert fitted is not None
        assert fitted.error_after < 0.05

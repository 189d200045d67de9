"""Calibration of contact probabilities, for the fusion of several probes.

The logit of a probability is divided by a temperature and shifted by a bias, both fitted by
maximum likelihood on probes that the network was not trained on (temperature scaling: Guo et al.
2017, arXiv 1706.04599; with a bias: Alexandari et al. 2020, arXiv 1901.06852). The result is a
posterior under the share of points in contact in these probes, the prior. By Bayes' rule the
evidence of one probe is its posterior log odds minus those of the prior.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from touchdown.backend.core import FloatArray

# Probabilities are limited to 0.001 to 0.999 before the scaling [U].
LOGIT_LIMIT = math.log(999.0)
NEWTON_STEPS = 100
CONVERGED = 1e-9
FLAT = 1e-6  # logits that vary by less hold no information


class PatchCalibration(BaseModel):
    """Calibration of the contact probabilities of one network.

    Attributes
    ----------
    temperature : float
        Divisor of the logits; above 1 for an overconfident network.
    bias : float
        Added to the divided logits.
    prior : float
        Share of face points in contact, 0 to 1, of the probes of the fit.
    probes : int
        Number of probes of the fit.
    error_before, error_after : float
        Expected calibration error of these probes, 0 to 1, without and with the calibration.

    Examples
    --------
    >>> fitted = PatchCalibration(temperature=2.0, bias=0.0, prior=0.5)
    >>> fitted.evidence(np.array([0.5, 0.9])).round(3).tolist()
    [0.0, 1.099]
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False
    )
    temperature: Annotated[float, Field(gt=0, le=1000)]
    bias: float
    prior: Annotated[float, Field(gt=0, lt=1)]
    probes: int = 0
    error_before: float = 0.0
    error_after: float = 0.0

    @property
    def prior_log_odds(self) -> float:
        """Log odds of the prior."""
        return math.log(self.prior / (1.0 - self.prior))

    def evidence(self, probability: FloatArray) -> FloatArray:
        """Return the log likelihood ratio of contact, in nats, of each probability.

        The log odds after several independent probes are the prior's plus all evidence.
        """
        scaled = limited_logit(probability) / self.temperature + self.bias
        return np.asarray(scaled - self.prior_log_odds, dtype=np.float64)

    def posterior(self, probability: FloatArray) -> FloatArray:
        """Return the calibrated probability of each ``probability`` after a single probe."""
        return _sigmoid(self.prior_log_odds + self.evidence(probability))


def limited_logit(probability: NDArray[np.floating]) -> FloatArray:
    """Return the logits of probabilities, within ``LOGIT_LIMIT``."""
    with np.errstate(divide="ignore"):
        p = np.asarray(probability, dtype=np.float64)
        logit = np.clip(np.log(p) - np.log1p(-p), -LOGIT_LIMIT, LOGIT_LIMIT)
    return np.asarray(logit, dtype=np.float64)


def _sigmoid(log_odds: FloatArray) -> FloatArray:
    return np.asarray(0.5 + 0.5 * np.tanh(0.5 * log_odds))  # without overflow


def fit_calibration(
    probability: NDArray[np.floating], truth: NDArray[np.bool_]
) -> PatchCalibration:
    """Fit a calibration to predictions of probes that were not trained on.

    Parameters
    ----------
    probability : array (n, N)
        Predicted contact probabilities of the N face points of n probes.
    truth : array of bool (n, N)
        Points in contact.

    Returns
    -------
    PatchCalibration
        Calibration of maximum likelihood; its prior is the share of points in contact.

    Raises
    ------
    ValueError
        If the probes do not determine one: no or only points in contact, predictions that do not
        vary, separate contact perfectly, or grow as contact becomes less likely.

    """
    # Imported here so that a decision loads no metrics.
    from touchdown.backend.learning.metrics import calibration_error, reliability

    logits = limited_logit(probability).ravel()
    contact = np.asarray(truth, dtype=np.float64).ravel()
    if not logits.size or not np.isfinite(logits).all() or not 0.0 < contact.mean() < 1.0:
        raise ValueError("the probes need finite predictions, and points with and without contact")
    if np.ptp(logits) < FLAT:
        raise ValueError("the predictions do not vary")
    slope, bias = _logistic_regression(logits, contact)
    if not slope * 1000.0 >= 1.0:
        raise ValueError("the predictions do not increase with contact")
    fitted = PatchCalibration(
        temperature=1.0 / slope, bias=bias, prior=float(contact.mean()), probes=len(truth)
    )
    after = fitted.posterior(np.asarray(probability, dtype=np.float64))
    errors = (calibration_error(reliability(p, truth)) for p in (probability, after))
    before_error, after_error = (round(error, 5) for error in errors)
    return fitted.model_copy(update={"error_before": before_error, "error_after": after_error})


def _logistic_regression(logits: FloatArray, contact: FloatArray) -> tuple[float, float]:
    """Return slope and bias of maximum likelihood, by Newton's method with halved steps."""
    design = np.stack((logits, np.ones_like(logits)))
    weight = np.array([1.0, 0.0])
    loss = _mean_loss(weight @ design, contact)
    for _ in range(NEWTON_STEPS):
        p = _sigmoid(weight @ design)
        gradient = design @ (p - contact) / contact.size
        curvature = (design * (p * (1.0 - p))) @ design.T / contact.size
        try:
            step = np.linalg.solve(curvature, gradient)
        except np.linalg.LinAlgError:
            break
        if np.abs(step).max() < CONVERGED:
            return float(weight[0]), float(weight[1])
        while (lower := _mean_loss((weight - step) @ design, contact)) > loss:
            step *= 0.5
            if np.abs(step).max() < CONVERGED:
                return float(weight[0]), float(weight[1])
        weight, loss = weight - step, lower
    raise ValueError("the fit does not converge, as for predictions without any error")


def _mean_loss(log_odds: FloatArray, contact: FloatArray) -> float:
    return float(np.mean(np.logaddexp(0.0, log_odds) - contact * log_odds))

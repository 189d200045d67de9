"""Detection of contact onset in a press-force signal.

A sample shows contact when it exceeds the baseline by the threshold; contact is declared on the
third such sample in a row. The baseline is the mean of a 200 ms window that ends 200 ms before the
sample: a window that ended at the sample would contain the contact itself, and a soft grasp pressed
at 2 mm/s never rises 1 N above it. The onset is where a straight line through the rise meets zero.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core.values import FloatArray


@dataclass(frozen=True, slots=True)
class OnsetRule:
    """Parameters of contact detection; times in s, forces in N."""

    threshold_n: float = 1.0
    samples: int = 3
    window_s: float = 0.2
    gap_s: float = 0.2
    rise_n: float = 0.3
    smooth_s: float = 0.01
    rate_hz: float = 1000.0

    @property
    def lead(self) -> int:
        """Number of samples before the first that can be judged."""
        return round((self.window_s + self.gap_s) * self.rate_hz)


DEFAULT_RULE = OnsetRule()


def force_over_baseline(force_n: FloatArray, rule: OnsetRule = DEFAULT_RULE) -> FloatArray:
    """Return (..., n) force over the running baseline; NaN in the first ``rule.lead`` samples."""
    window = round(rule.window_s * rule.rate_hz)
    total = np.cumsum(force_n, axis=-1)
    total = np.concatenate([np.zeros((*total.shape[:-1], 1)), total], axis=-1)
    mean = (total[..., window:] - total[..., :-window]) / window
    over = np.full(force_n.shape, np.nan)
    judged = force_n.shape[-1] - rule.lead
    if judged > 0:
        over[..., rule.lead :] = force_n[..., rule.lead :] - mean[..., :judged]
    return over


def detect_contact(over_n: FloatArray, rule: OnsetRule = DEFAULT_RULE) -> NDArray[np.intp]:
    """Return (...) index of the sample at which contact is declared, -1 if it is not."""
    high = over_n > rule.threshold_n
    run = high.copy()
    for k in range(1, rule.samples):
        run[..., k:] &= high[..., :-k]
        run[..., :k] = False
    return np.where(run.any(axis=-1), run.argmax(axis=-1), -1)


def back_date_onset(
    t_s: FloatArray, over_n: FloatArray, detected: NDArray[np.intp], rule: OnsetRule = DEFAULT_RULE
) -> FloatArray:
    """Return (B,) onset times: the line through the rise before the detection, extended to zero.

    ``t_s`` (n,) or (B, n), ``over_n`` (B, n), ``detected`` (B,) indices. The rise begins after the
    last sample whose mean over ``rule.smooth_s`` is not above ``rule.rise_n``. NaN where
    nothing was detected; never later than the detection.
    """
    over = np.nan_to_num(over_n)
    index = np.arange(over.shape[-1])
    width = max(round(rule.smooth_s * rule.rate_hz), 1)
    total = np.concatenate([np.zeros((len(over), 1)), np.cumsum(over, axis=1)], axis=1)
    smooth = np.zeros_like(over)
    smooth[:, width - 1 :] = (total[:, width:] - total[:, :-width]) / width
    end = detected[:, None]
    low = (smooth <= rule.rise_n) & (index <= end)
    first = np.where(low, index, -1).max(axis=1) + 1
    first = np.minimum(first, np.maximum(detected - 2 * rule.samples, 0))
    weight = ((index >= first[:, None]) & (index <= end)).astype(np.float64)
    t = np.broadcast_to(t_s, over.shape)
    t_end = np.take_along_axis(t, np.maximum(end, 0), axis=1)
    return np.where(detected >= 0, _zero_of_line(t - t_end, over, weight) + t_end[:, 0], np.nan)


def _zero_of_line(t: FloatArray, force: FloatArray, weight: FloatArray) -> FloatArray:
    count = np.maximum(weight.sum(axis=1), 1.0)
    t_mean = (weight * t).sum(axis=1) / count
    f_mean = (weight * force).sum(axis=1) / count
    d_t = t - t_mean[:, None]
    slope = (weight * d_t * force).sum(axis=1) / np.maximum((weight * d_t * d_t).sum(axis=1), 1e-12)
    zero = t_mean - f_mean / np.maximum(slope, 1e-3)
    return np.asarray(np.clip(zero, t_mean - 0.5, 0.0), dtype=np.float64)


class OnsetDetector:
    """The same detection on a stream of samples."""

    def __init__(self, rule: OnsetRule = DEFAULT_RULE) -> None:
        self.rule = rule
        self.detected_s: float | None = None
        self.onset_s: float | None = None
        self._t_s = np.empty(0)
        self._force_n = np.empty(0)

    def feed(self, t_s: FloatArray, force_n: FloatArray) -> bool:
        """Add (n,) samples in order of time; return True once contact is declared."""
        if self.detected_s is not None:
            return True
        self._t_s = np.concatenate([self._t_s, t_s])
        self._force_n = np.concatenate([self._force_n, force_n])
        over = force_over_baseline(self._force_n, self.rule)
        found = detect_contact(over[None, :], self.rule)
        if found[0] >= 0:
            self.detected_s = float(self._t_s[found[0]])
            self.onset_s = float(back_date_onset(self._t_s, over[None, :], found, self.rule)[0])
            return True
        keep = 2 * self.rule.lead
        self._t_s, self._force_n = self._t_s[-keep:], self._force_n[-keep:]
        return False

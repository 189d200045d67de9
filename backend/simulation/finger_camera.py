"""When one finger's camera takes pictures, and what its markers look like then."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.config.simulation import TactileSettings
from backend.core.flow import MARKERS, FloatArray, ImageArray
from backend.simulation.optics import FingerOptics


@dataclass(frozen=True, slots=True)
class Shot:
    """One picture: number of the exposure (gaps are lost frames), time, (240, 320, 3) BGR image."""

    sequence: int
    t_us: int
    image: ImageArray


@dataclass(frozen=True, slots=True)
class Sight:
    """Markers of one finger over a cycle: (63, 2) px at its beginning and end, and (2,) bias."""

    before_px: FloatArray
    after_px: FloatArray
    bias_px: FloatArray


class FingerCamera:
    """Exposes at the camera's rate with jitter and drops; adds drift, bias and covering smears."""

    def __init__(self, settings: TactileSettings, optics: FingerOptics, seed: int) -> None:
        self._settings, self._optics = settings, optics
        self._rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, 3])))
        self._period_us = 1e6 / settings.rate_hz
        self._phase_us = float(self._rng.uniform(0.0, self._period_us))
        self._next, self._due_us = 0, 0
        self._last_us = 0
        self._drift_px = np.zeros(2)
        self._hidden_frames = np.zeros(MARKERS, dtype=np.intp)
        mean_length = 0.5 * (1 + settings.lost_frames)
        self._start_share = settings.lost_share / mean_length
        self._aim()

    def shots(
        self, start_us: int, end_us: int, sight: Sight, *, watched: bool = True
    ) -> list[Shot]:
        """Return the pictures taken in ``start_us < t <= end_us``; none unless ``watched``."""
        taken: list[Shot] = []
        while self._due_us <= end_us:
            t_us, sequence = self._due_us, self._next
            self._next += 1
            self._aim()
            hidden = self._step_noise(t_us)
            dropped = self._rng.random() < self._settings.drop_share
            if dropped or t_us <= start_us or not watched:
                continue
            share = (t_us - start_us) / (end_us - start_us)
            field = sight.before_px + share * (sight.after_px - sight.before_px)
            field = field + sight.bias_px + self._drift_px
            taken.append(Shot(sequence, t_us, self._optics.render(field, hidden)))
        return taken

    def _aim(self) -> None:
        """Set the time of the next exposure."""
        jitter = 1e6 * self._settings.jitter_s * self._rng.uniform(-1.0, 1.0)
        due = round(self._phase_us + self._next * self._period_us + jitter)
        self._due_us = max(due, self._due_us + 1)

    def _step_noise(self, t_us: int) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Move drift and losses on to ``t_us``; return which markers are covered."""
        gap_s = max(t_us - self._last_us, 0) * 1e-6
        self._last_us = t_us
        walk = self._settings.drift_px_sqrt_s * np.sqrt(gap_s)
        self._drift_px = self._drift_px + walk * self._rng.standard_normal(2)
        self._hidden_frames = np.maximum(self._hidden_frames - 1, 0)
        begins = self._rng.random(MARKERS) < self._start_share
        lengths = self._rng.integers(1, self._settings.lost_frames + 1, MARKERS)
        self._hidden_frames = np.where(begins, lengths, self._hidden_frames)
        return np.asarray(self._hidden_frames > 0)

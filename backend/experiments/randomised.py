"""Domain randomisation: training probes of which every mounting is a bench of its own.

Sizes of nuisances and laws of gel, grip, contact and friction are drawn anew for each mounting, in
wide ranges around the given bench. The bench itself is not touched, and nothing is asked on these.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from backend.config.simulation import SimulationSettings
from backend.experiments.nuisances import NUISANCES, scaled
from backend.experiments.recipes import TRAINING_BOTTOMS, paper_training
from backend.jobs.spec import JobSpec
from backend.learning.job import DeviceName

Collected = Literal["mountings", "randomised"]
"""As many mountings of the bench as it draws them; the same, each with its own sizes and laws."""
FIRST_SEED, OUTLINE_SEEDS = 7_000_000, 10_000
"""Of the mountings, far from the seeds of all tables; each outline has so many."""
PROBES, PROBES_PER_GRIP, GRIPS_PER_MOUNTING, EPOCHS = 2000, 5, 10, 30
SIZES = (0.5, 2.0)
"""Every nuisance is so many times as large as on the bench."""
LAWS: Mapping[str, tuple[float, float]] = {
    "grasp.shear_n_mm": (0.5, 2.0),
    "grasp.normal_n_mm": (0.5, 2.0),
    "grasp.torsion_nmm_rad": (0.5, 2.0),
    "grasp.limit_radius_mm": (0.6, 1.6),
    "grasp.hysteresis_share": (0.3, 5.0),
    "grasp.hysteresis_s": (0.1, 2.0),
    "face.foundation_range_n_mm3": (0.3, 10.0),
    "face.tangential_n_mm3": (0.5, 4.0),
    ".mu": (0.6, 1.5),
    ".mu_grip": (0.75, 2.0),
    "tactile.mm_per_px": (0.9, 1.3),
    "tactile.roll_off_mm": (0.6, 1.6),
    "tactile.dilation": (0.3, 3.0),
}
"""Range of the factor by which a value of the bench (``section.name``) is multiplied; both numbers
of a pair by the same. Chosen by hand, not fitted to anything. All factors are log-uniform."""
_DRAW = 993
"""Keeps these draws apart from those of the bench."""


def randomised(bench: SimulationSettings, seed: int) -> SimulationSettings:
    """Return the bench of the mounting ``seed``: the same for the same ``bench`` and seed."""
    rng = np.random.default_rng([seed, _DRAW])
    for nuisance in NUISANCES:
        bench = scaled(bench, nuisance, _factor(rng, SIZES))
    content = bench.model_dump(mode="json")
    for key, limits in LAWS.items():
        section, name = key.split(".")
        values, factor = content[section] if section else content, _factor(rng, limits)
        values[name] = _times(values[name], factor)
    return SimulationSettings.model_validate(content)


@dataclass(frozen=True, slots=True)
class RandomisedTraining:
    """Jobs of one model: ``probes`` over each training outline, then the paper's training.

    Every job of the collection is one mounting with settings of its own in its spec, so that it
    needs nothing else.
    """

    bench: SimulationSettings
    code: str
    piece: str
    collected: Collected
    inputs: str = "FT+Tac"
    probes: int = PROBES
    epochs: int = EPOCHS
    device: DeviceName = "auto"

    @property
    def name(self) -> str:
        """Name of the model in tables."""
        return f"{self.inputs} {self.collected}"

    def data(self) -> list[JobSpec]:
        """Return the collection, mounting by mounting."""
        size = PROBES_PER_GRIP * GRIPS_PER_MOUNTING
        return [
            self._mounting(FIRST_SEED + OUTLINE_SEEDS * k + first // size, bottom,
                           min(size, self.probes - first))
            for k, bottom in enumerate(TRAINING_BOTTOMS)
            for first in range(0, self.probes, size)
        ]  # fmt: skip

    def training(self) -> JobSpec:
        """Return the training."""
        settings = paper_training(self.inputs, self.epochs)
        params = {
            "piece": self.piece,
            "head": "patch",
            "training": settings.model_dump(mode="json"),
            "device": self.device,
        }
        return JobSpec("train", params, settings.seed, tuple(s.id for s in self.data()), self.code)

    def effort(self, spec: JobSpec) -> int:
        """Return how long a job takes compared with others (unit: that of ``asking.effort``)."""
        if spec.kind == "train":
            return math.ceil(self.probes * self.epochs / 20)
        return int(spec.params["episodes"]) // 2

    def _mounting(self, seed: int, bottom: str, episodes: int) -> JobSpec:
        bench = self.bench if self.collected == "mountings" else randomised(self.bench, seed)
        params = {
            "piece": self.piece,
            "bottom": bottom,
            "episodes": episodes,
            "probes_per_grip": PROBES_PER_GRIP,
            "grips_per_mounting": GRIPS_PER_MOUNTING,
            "bench": bench.model_dump(mode="json"),
        }
        return JobSpec("simulate", params, seed, (), self.code)


def _factor(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    low, high = np.log(limits)
    return float(np.exp(rng.uniform(low, high)))


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (int, float)):
        return factor * value
    return None if value is None else [factor * part for part in value]

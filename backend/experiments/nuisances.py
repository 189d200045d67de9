"""Nuisances of the simulated bench: quantities that differ between mountings, grippings and probes.

``scale_nuisance`` scales one of them, ``band_benches`` all at once by a Latin hypercube,
``randomise_bench`` the nuisances and the laws of gel, grip, contact and friction at random.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchdown.backend.config import SimulationSettings

FOUNDATION = "face.foundation_range_n_mm3"


@dataclass(frozen=True, slots=True)
class Nuisance:
    """A nuisance of the bench. ``keys``: settings scaled together; ``limit``: bound of draws."""

    name: str
    title: str
    keys: tuple[str, ...]
    limit: str = ""


# Quantities that differ between mountings, grippings or probes.
NUISANCES = (
    Nuisance("tilt", "Tilt of the board", ("spread.tilt_rad",), "0.02 rad"),
    Nuisance("grasp-offset", "Grasp offset", ("spread.grasp_offset_mm",), "2 mm"),
    Nuisance("yaw", "Rotation in the hand", ("spread.yaw_rad",)),
    Nuisance("foundation", "Range of the contact stiffness", (FOUNDATION,)),
    Nuisance("gel", "Gel stiffness", ("spread.gel",), "0.7 to 1.3"),
    Nuisance("hysteresis", "Gel hysteresis", ("grasp.hysteresis_share",)),
    Nuisance("grip-friction", "Friction in the grip", ("spread.mu_grip",), "0.35 to 1.1"),
    Nuisance("grip-force", "Grip force", ("spread.grip_force_n",), "4 to 15 N"),
    Nuisance("face-friction", "Friction of the faces", ("spread.mu",), "0.2 to 0.6"),
    Nuisance("label-error", "Error of the arm", ("spread.label_error_mm",), "0.3 mm"),
    Nuisance("print-offset", "Place of the bottom", ("spread.print_offset_mm",), "0.5 mm"),
    Nuisance("gain", "Tactile gain", ("spread.gain",), "0.8 to 1.2"),
    Nuisance("tactile-bias", "Tactile reference error", ("tactile.bias_px",), "1 px"),
    Nuisance("tactile-drift", "Tactile drift", ("tactile.drift_px_sqrt_s",)),
    Nuisance("tactile-noise", "Tactile white noise", ("tactile.white_px",)),
    Nuisance("lost", "Lost markers and frames", ("tactile.lost_share", "tactile.drop_share")),
    Nuisance("wrist-offset", "Wrist offset after tare", ("wrist.offset_n", "wrist.offset_nm")),
    Nuisance("wrist-noise", "Wrist white noise", ("wrist.white_n", "wrist.white_nm")),
    Nuisance("wrist-drift", "Wrist drift", ("wrist.drift_n_sqrt_min", "wrist.drift_nm_sqrt_min")),
)

# Those that bench-v1 does not draw.
LATER_NUISANCES = (
    Nuisance("reseat", "Re-seating in the grasp", ("spread.reseat_mm", "spread.pitch_rad")),
    Nuisance("flatness", "Faces out of flat", ("spread.face_tilt_rad", "spread.face_crown_rad")),
    Nuisance("com", "Centre of mass", ("spread.com_mm",), "2 mm"),
    Nuisance("pad-area", "Gripped area", ("spread.pad_area",), "factor 1.65"),
    Nuisance("wrist-yaw", "Yaw of the wrist sensor", ("spread.wrist_yaw_rad",)),
    Nuisance("wrist-lever", "Place of the wrist sensor", ("spread.wrist_lever_mm",)),
    Nuisance("cable", "Cable pull", ("spread.cable_n_mm",)),
    Nuisance("creep", "Gel creep", ("grasp.creep_share",)),
    Nuisance("release", "Disturbance at release", (".release_disturbance_mm",)),
)


def scale_nuisance(
    settings: SimulationSettings, nuisance: Nuisance, factor: float
) -> SimulationSettings:
    """Return the bench with one nuisance scaled by ``factor``.

    A log-uniform range keeps its middle. An absent range stays absent.
    """
    if factor == 1.0:
        return settings
    content = settings.model_dump(mode="json")
    for key in nuisance.keys:
        section, name = key.split(".")
        values = content[section] if section else content
        values[name] = _times(values.get(name, 0.0), factor)
    return SimulationSettings.model_validate(content)


BAND_SEED, BAND_FACTOR = 994, 2.0  # magnitudes from half to twice those of the bench


def band_benches(
    bench: SimulationSettings, count: int
) -> list[tuple[dict[str, float], SimulationSettings]]:
    """Return ``count`` benches around ``bench``, each with its factor of every nuisance by name.

    Factors are log-uniform from 1 / ``BAND_FACTOR`` to ``BAND_FACTOR``, a Latin hypercube over the
    nuisances that the bench draws; the same ones for the same ``count``.
    """
    # Imported here: scipy is slow to load.
    from scipy.stats.qmc import LatinHypercube

    content = bench.model_dump(mode="json")

    def drawn(key: str) -> bool:
        section, name = key.split(".")
        return bool((content[section] if section else content).get(name))

    chosen = [n for n in (*NUISANCES, *LATER_NUISANCES) if any(map(drawn, n.keys))]
    cube = LatinHypercube(len(chosen), seed=BAND_SEED).random(count)
    found = []
    for factors in (BAND_FACTOR ** (2.0 * cube - 1.0)).tolist():
        one = bench
        for nuisance, factor in zip(chosen, factors, strict=True):
            one = scale_nuisance(one, nuisance, factor)
        by_name = {n.name: f for n, f in zip(chosen, factors, strict=True)}
        found.append((by_name, one))
    return found


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (int, float)):
        return factor * value
    if value is None:
        return None
    low, high = np.log(value)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * factor
    return [float(np.exp(middle - half)), float(np.exp(middle + half))]


NUISANCE_FACTORS = (0.5, 2.0)  # range of the scale of every nuisance of a randomised bench
# Range of the log-uniform factor on a value of the bench (``section.name``); one factor for both
# numbers of a pair.
LAW_FACTORS: Mapping[str, tuple[float, float]] = {
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
_RNG_STREAM = 993  # separates these draws from those of the bench


def randomise_bench(bench: SimulationSettings, seed: int) -> SimulationSettings:
    """Return the randomised bench of the mounting ``seed``; reproducible for the same bench and
    seed.
    """
    rng = np.random.default_rng([seed, _RNG_STREAM])
    for nuisance in NUISANCES:
        bench = scale_nuisance(bench, nuisance, _factor(rng, NUISANCE_FACTORS))
    content = bench.model_dump(mode="json")
    for key, limits in LAW_FACTORS.items():
        section, name = key.split(".")
        values, factor = content[section] if section else content, _factor(rng, limits)
        value = values[name]
        number = isinstance(value, (int, float))
        values[name] = factor * value if number else value and [factor * v for v in value]
    return SimulationSettings.model_validate(content)


def _factor(rng: np.random.Generator, limits: tuple[float, float]) -> float:
    low, high = np.log(limits)
    return float(np.exp(rng.uniform(low, high)))

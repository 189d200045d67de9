"""Nuisances of the simulated bench: quantities that differ between mountings, grippings and probes.

``scale_nuisance`` scales one of them, ``band_benches`` all at once by a Latin hypercube.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from touchdown.backend.config import SimulationSettings, settings_with
from touchdown.backend.core import InputError, read_limited

FOUNDATION = "face.foundation_range_n_mm3"
# Settings of each nuisance, which are scaled together.
NUISANCES: Mapping[str, tuple[str, ...]] = {
    "tilt": ("spread.tilt_rad",),
    "grasp-offset": ("spread.grasp_offset_mm",),
    "yaw": ("spread.yaw_rad",),
    "foundation": (FOUNDATION,),
    "gel": ("spread.gel",),
    "hysteresis": ("grasp.hysteresis_share",),
    "grip-friction": ("spread.mu_grip",),
    "grip-force": ("spread.grip_force_n",),
    "face-friction": ("spread.mu",),
    "label-error": ("spread.label_error_mm",),
    "print-offset": ("spread.print_offset_mm",),
    "gain": ("spread.gain",),
    "tactile-bias": ("tactile.bias_px",),
    "tactile-drift": ("tactile.drift_px_sqrt_s",),
    "tactile-noise": ("tactile.white_px",),
    "lost": ("tactile.lost_share", "tactile.drop_share"),
    "wrist-offset": ("wrist.offset_n", "wrist.offset_nm"),
    "wrist-noise": ("wrist.white_n", "wrist.white_nm"),
    "wrist-drift": ("wrist.drift_n_sqrt_min", "wrist.drift_nm_sqrt_min"),
}

# Those that bench-v1 does not draw.
LATER_NUISANCES: Mapping[str, tuple[str, ...]] = {
    "reseat": ("spread.reseat_mm", "spread.pitch_rad"),
    "flatness": ("spread.face_tilt_rad", "spread.face_crown_rad"),
    "com": ("spread.com_mm",),
    "pad-area": ("spread.pad_area",),
    "wrist-yaw": ("spread.wrist_yaw_rad",),
    "wrist-lever": ("spread.wrist_lever_mm",),
    "cable": ("spread.cable_n_mm",),
    "creep": ("grasp.creep_share",),
    "release": (".release_disturbance_mm",),
}


def scale_nuisance(
    settings: SimulationSettings, keys: Sequence[str], factor: float
) -> SimulationSettings:
    """Return the bench with one nuisance, the settings ``keys``, scaled by ``factor``.

    A log-uniform range keeps its middle. An absent range stays absent.
    """
    if factor == 1.0:
        return settings
    content = settings.model_dump(mode="json")
    for key in keys:
        section, name = key.split(".")
        values = content[section] if section else content
        values[name] = _times(values.get(name, 0.0), factor)
    return SimulationSettings.model_validate(content)


RANGES_SEED = 993


def bench_within(
    bench: SimulationSettings, ranges: Mapping[str, Sequence[float]], seed: int
) -> SimulationSettings:
    """Return ``bench`` with the settings of ``ranges`` drawn uniformly from low to high."""
    rng = np.random.default_rng([seed, RANGES_SEED])
    drawn = {key: float(rng.uniform(low, high)) for key, (low, high) in sorted(ranges.items())}
    return settings_with(bench, drawn) if drawn else bench


RANGES_FIX = "Name the .json file that the identification wrote beside the bench file."


def read_ranges(path: Path) -> dict[str, list[float]]:
    """Return the ranges in the figures of an identification; raises ``InputError``."""
    try:
        found = json.loads(read_limited(path, 10_000_000, RANGES_FIX))["randomisation"]
        ranges = {str(key): [float(low), float(high)] for key, (low, high) in found.items()}
        if not all(0.0 <= high - low < math.inf for low, high in ranges.values()):
            raise ValueError
        return ranges
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("This file has no ranges.", str(path), RANGES_FIX) from error


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

    every = {**NUISANCES, **LATER_NUISANCES}
    chosen = {name: keys for name, keys in every.items() if any(map(drawn, keys))}
    cube = LatinHypercube(len(chosen), seed=BAND_SEED).random(count)
    found = []
    for factors in (BAND_FACTOR ** (2.0 * cube - 1.0)).tolist():
        one, by_name = bench, dict(zip(chosen, factors, strict=True))
        for name, keys in chosen.items():
            one = scale_nuisance(one, keys, by_name[name])
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

"""The nuisances of the simulated bench by name, and how to make one of them larger or smaller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from backend.config.simulation import SimulationSettings

FACTORS = (0.0, 0.5, 1.0, 2.0, 3.0)
FOUNDATION = "face.foundation_range_n_mm3"


@dataclass(frozen=True, slots=True)
class Nuisance:
    """``keys`` of the settings that grow together; ``limit``: where all draws end."""

    name: str
    title: str
    keys: tuple[str, ...]
    limit: str = ""


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
"""All that differs between mountings, grippings or probes. What is fixed (support friction, mean
frictions and stiffnesses, rates) is no nuisance."""


def scaled(settings: SimulationSettings, nuisance: Nuisance, factor: float) -> SimulationSettings:
    """Return the bench with one nuisance ``factor`` times as large.

    A log-uniform range keeps its middle. A range that is not there stays so.
    """
    if factor == 1.0:
        return settings
    content = settings.model_dump(mode="json")
    for key in nuisance.keys:
        section, name = key.split(".")
        content[section][name] = _times(content[section][name], factor)
    return SimulationSettings.model_validate(content)


def _times(value: Any, factor: float) -> Any:
    if isinstance(value, (int, float)):
        return factor * value
    if value is None:
        return None
    low, high = np.log(value)
    middle, half = 0.5 * (low + high), 0.5 * (high - low) * factor
    return [float(np.exp(middle - half)), float(np.exp(middle + half))]

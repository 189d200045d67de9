"""Properties of a bench on which the numbers of an observation depend.

A bench reports them and a model card records them, so that a model is used only where it fits.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, Literal

from touchdown.backend.config.method import Positive, Settings
from touchdown.backend.config.simulation import SimulationSettings

# Emulated: simulated physics behind the protocols and drivers of real devices.
BenchMode = Literal["", "simulated", "emulated", "hardware"]


class BenchDescription(Settings):
    """Description of one bench; "" and None mean unknown.

    ``sha256`` identifies sensors and grasp: positions, scales and stiffness. Noise, friction and
    spreads are not included.
    """

    mode: BenchMode = ""
    sha256: str = ""
    # Image scale of the left and the right finger.
    mm_per_px: tuple[Positive, Positive] | None = None
    ft_frame: str = ""  # reference frame of the wrench
    sensor_height_mm: Positive | None = None  # wrist sensor above the grasp pivot
    gels: tuple[str, str] | None = None  # serial numbers of the left and the right gel


@dataclass(frozen=True, slots=True)
class BenchIdentity:
    """Bench as named by a certificate of releases; ``sha256`` is "" for a bench that can have none.

    ``calibrations``: folder of a laboratory, None where the bench has none of its own.
    ``daily_check``: a release on a day without a daily check is asked.
    """

    name: str = ""
    sha256: str = ""
    calibrations: Path | None = None
    daily_check: bool = False


def describe_simulation(settings: SimulationSettings) -> BenchDescription:
    """Return the description of a simulated bench."""
    tactile, wrist, grasp = settings.tactile, settings.wrist, settings.grasp
    relevant = {
        "mm_per_px": tactile.mm_per_px,
        "pitch_mm": tactile.pitch_mm,
        "roll_off_mm": tactile.roll_off_mm,
        "frames_hz": tactile.rate_hz,
        "wrench_hz": wrist.rate_hz,
        "wrist_mm": wrist.height_mm,
        "wrist_rad": wrist.yaw_rad,
        "gel": [grasp.shear_n_mm, grasp.normal_n_mm, grasp.torsion_nmm_rad],
    }
    return BenchDescription(
        mode="simulated",
        sha256=sha256_of_json(relevant),
        mm_per_px=tactile.mm_per_px,
        ft_frame=wrist_frame(wrist.height_mm, wrist.yaw_rad),
        sensor_height_mm=wrist.height_mm,
    )


def bench_sha256(settings: SimulationSettings) -> str:
    """Return the SHA-256 of all settings; it identifies the bench in every result."""
    return sha256_of_json(settings.model_dump(mode="json"))


def wrist_frame(height_mm: float, yaw_rad: float) -> str:
    """Return the name of the reference frame of the wrench."""
    turned = f", turned {yaw_rad:g} rad" if yaw_rad else ""
    return f"environment on tool, sensor {height_mm:g} mm above the grasp pivot{turned}"


def sha256_of_json(values: Any) -> str:
    """Return the SHA-256 of JSON-ready values."""
    return sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()

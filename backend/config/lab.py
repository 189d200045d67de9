"""The lab file: which devices stand on a bench, where they answer, and how far they may go."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from backend.config.bench_facts import BenchFacts, digest, wrist_frame
from backend.config.hardware import HardwareSettings
from backend.config.lab_places import refuse_wrong_places
from backend.config.load import parse, read_toml
from backend.config.method import NonNegative, Positive, Settings
from backend.core.faults import InputError

VERSION = 1
Length = Annotated[float, Field(allow_inf_nan=False)]
LabKind = Literal["hardware", "emulated"]
NO_SIMULATION = frozenset({"version", "kind", "melfa", "wsg", "ft", "gelsight"})
"""A file with one of these keys is a lab file; settings of the simulated bench have none."""


class LimitSettings(Settings):
    """Limits of motion and force in the bench frame; no command is changed to fit, it is refused.

    The workspace is the part of the box that is within ``reach_mm`` of its vertical axis.
    """

    reach_mm: Positive = 150.0
    least_x_mm: Length = -150.0
    most_x_mm: Length = 150.0
    least_y_mm: Length = -150.0
    most_y_mm: Length = 150.0
    lowest_mm: Length = 0.0
    highest_mm: Length = 400.0
    speed_mm_s: Annotated[float, Field(gt=0, le=250)] = 50.0
    """250 mm/s is what standards call reduced speed."""
    contact_speed_mm_s: Positive = 2.0
    contact_n: Positive = 1.0
    press_n: Positive = 25.0
    trip_n: Positive = 40.0
    trip_at_once_n: Positive = 60.0
    trip_nm: Positive = 1.5
    probe_n: Positive = 30.0
    jog_mm_s: Positive = 50.0
    jog_guard_n: Positive = 15.0
    near_mm: NonNegative = 10.0
    recovery_mm_s: Positive = 5.0
    tilt_rad: Annotated[float, Field(gt=0, le=math.pi / 2)] = math.radians(15.0)
    turn_rad_s: Positive = math.radians(15.0)
    turn_clear_mm: NonNegative = 20.0
    wrench_age_s: Positive = 0.3
    frame_age_s: Positive = 0.5

    @model_validator(mode="after")
    def _in_order(self) -> LimitSettings:
        for low, high in ORDER:
            if not getattr(self, low) <= getattr(self, high):
                raise ValueError(f"'{low}' is above '{high}'")
        return self


ORDER = (
    ("least_x_mm", "most_x_mm"),
    ("least_y_mm", "most_y_mm"),
    ("lowest_mm", "highest_mm"),
    ("contact_speed_mm_s", "jog_mm_s"),
    ("recovery_mm_s", "jog_mm_s"),
    ("jog_mm_s", "speed_mm_s"),
    ("contact_n", "jog_guard_n"),
    ("jog_guard_n", "trip_n"),
    ("press_n", "trip_n"),
    ("probe_n", "trip_n"),
    ("trip_n", "trip_at_once_n"),
)
"""Pairs of limits of which the first must not be above the second."""


class MountingSettings(Settings):
    """What hangs below the wrist sensor, and where the sensor sits."""

    sensor_height_mm: Positive = 120.0
    """Sensor above the grasp pivot."""
    sensor_yaw_rad: Length = 0.0
    """What is left of its turn after ``ft.rotation``."""
    payload_kg: NonNegative = 1.5
    """Gripper and fingers."""
    payload_com_mm: tuple[Length, Length, Length] = (0.0, 0.0, 60.0)
    """Their centre of mass from the grasp pivot."""


class SerialNumbers(Settings):
    """Who must answer; empty: whoever does. Cameras are found by ``gelsight.*.serial`` anyway."""

    force_torque: str = ""
    gripper: str = ""
    arm: str = ""


class LabSettings(HardwareSettings):
    """One bench: its name, its limits, its devices (one table each)."""

    version: Literal[1]
    name: Annotated[str, Field(min_length=1, max_length=32)]
    """Stands in the window's frame and in every recording."""
    kind: LabKind
    piece: str = "pot"
    bottom: str = "short"
    """What is on the bench at the start, bottom-up and joined by + for a tower."""
    calibrations: str = "calibrations"
    """Folder of the calibrations, from the folder of this file."""
    limits: LimitSettings = LimitSettings()
    mounting: MountingSettings = MountingSettings()
    serials: SerialNumbers = SerialNumbers()


@dataclass(frozen=True, slots=True)
class Lab:
    """A lab file as it was read."""

    path: Path
    settings: LabSettings

    @property
    def calibrations(self) -> Path:
        """Folder of its calibrations."""
        return self.path.parent / self.settings.calibrations

    @property
    def facts(self) -> BenchFacts:
        """Return what the numbers of an observation depend on here."""
        settings = self.settings
        mounting, gelsight, ft = settings.mounting, settings.gelsight, settings.ft
        scale = 0.5 * (gelsight.mm_per_px_x + gelsight.mm_per_px_y)
        kept = {
            "name": settings.name,
            "ft": [ft.driver, ft.rotation, ft.sign],
            "mounting": mounting.model_dump(mode="json"),
            "gelsight": [gelsight.mm_per_px_x, gelsight.mm_per_px_y, gelsight.crop_fraction],
            "fingers": [f.model_dump(mode="json") for f in (gelsight.left, gelsight.right)],
        }
        return BenchFacts(
            mode=settings.kind,
            sha256=digest(kept),
            mm_per_px=(scale, scale),
            ft_frame=wrist_frame(mounting.sensor_height_mm, mounting.sensor_yaw_rad),
            sensor_height_mm=mounting.sensor_height_mm,
        )


def is_lab_file(path: Path) -> bool:
    """Whether ``path`` names devices, not a simulated bench; raises ``InputError`` as reading."""
    return bool(NO_SIMULATION & read_toml(path).keys())


def load_lab(path: Path) -> Lab:
    """Read a lab file; raises ``InputError`` naming file, key and reason."""
    settings = parse_lab(read_toml(path), path)
    refuse_wrong_places(settings, settings.kind, str(path))
    return Lab(path, settings)


def parse_lab(content: dict[str, Any], path: Path) -> LabSettings:
    """Return the settings of a lab file; raises ``InputError``, also for another version."""
    version = content.get("version")
    if version != VERSION or isinstance(version, bool):
        raise InputError(
            f"Bad value for 'version': {version!r} is not known here ({VERSION}).",
            str(path),
            f"Write 'version = {VERSION}', or use the Touchdown that wrote the file.",
        )
    return parse(LabSettings, content, str(path))

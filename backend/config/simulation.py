"""Settings of the simulated bench: physics, sensors, spreads, and named presets.

Defaults are those of preset ``mixed``. Values marked [U] are unconfirmed estimates.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from touchdown.backend.config.hardware import LAB_FILE_KEYS
from touchdown.backend.config.method import NonNegative, Positive, Settings, StackSettings
from touchdown.backend.config.toml_file import parse_settings, read_toml
from touchdown.backend.core import InputError

Share = Annotated[float, Field(ge=0, le=1)]
Friction = Annotated[float, Field(gt=0, le=10)]
Spread = Annotated[float, Field(ge=0, le=10)]  # relative standard deviation
Preset: TypeAlias = Literal["mixed", "quiet", "hard", "off", "realistic", "bench-v1", "bench-v2"]


class GraspSettings(Settings):
    """Compliant grasp of two fingers."""

    shear_n_mm: Positive = 4.0  # shear stiffness of one gel, x and z [U]
    normal_n_mm: Positive = 10.0  # normal stiffness of one gel [U]
    # Torsional stiffness of one gel about the jaw axis, N·mm/rad [U].
    torsion_nmm_rad: Positive = 128.0
    limit_radius_mm: Positive = 3.8  # lever of the frictional torque of one pad (limit surface)
    slip: bool = True  # pads slip at the limit surface; slip stays until the next grip
    hysteresis: bool = False  # one Maxwell branch per gel spring
    hysteresis_share: Share = 0.1  # stiffness of the Maxwell branch relative to the spring [U]
    hysteresis_s: Positive = 0.5  # relaxation time of the Maxwell branch [U]
    creep_share: Share = 0.0  # a second, slower Maxwell branch; 0: none
    creep_s: Positive = 5.0  # its relaxation time [U]
    # Width of the piece that the stiffness of a gel belongs to: the gripped area grows with the
    # root of the width (line contact, Johnson, Contact Mechanics, eq. 4.43). 0: equal for all.
    pad_width_mm: NonNegative = 0.0


class FaceSettings(Settings):
    """Contact of the two faces."""

    # Normal stiffness of the elastic foundation, a nuisance parameter [U].
    foundation_n_mm3: Positive = 20.0
    # If set, drawn log-uniformly per mounting instead.
    foundation_range_n_mm3: tuple[Positive, Positive] | None = None
    tangential_n_mm3: Positive = 16.0  # tangential stiffness before sliding [U]
    lattice_mm: Positive = 1.0
    # Points a side of each cell of the contact: 3 weighs a cell by its covered ninths and puts it
    # at their centre; 1 counts whole cells by their centres.
    subcells: Literal[1, 3, 5] = 1


class SupportSettings(Settings):
    """Bottoms that are not fixed to the table."""

    rocks: bool = False  # bottoms tip about their edge when the press leaves their base
    slides: bool = False  # bottoms slide when the lateral force exceeds friction, and stay there
    mu: Friction = 0.40  # friction of bottoms on the table and on each other [U]


class TactileSettings(Settings):
    """The two finger cameras."""

    # Image scale of left and right sensor; public values 0.058 to 0.071.
    mm_per_px: tuple[Positive, Positive] = (0.058, 0.058)
    pitch_mm: Positive = 1.9  # marker pitch of the 7x9 large-dot gel
    # Distance along x and z at which the strain rolls off outside the gripped patch [U].
    roll_off_mm: tuple[Positive, Positive] = (7.0, 6.0)
    dilation: Spread = 0.01  # growth of the field with the pad force [U]
    rate_hz: Positive = 25.0
    jitter_s: NonNegative = 0.005  # frame times are uniform within this of the regular grid
    drop_share: Share = 0.005
    white_px: NonNegative = 0.05  # white noise per frame, marker and axis, tracker included (batch)
    bias_px: NonNegative = 0.15  # reference error per probe, finger and axis; standard deviation
    drift_px_sqrt_s: NonNegative = 0.02  # random walk of the whole field per finger and axis
    lost_share: Share = 0.001  # share of lost marker-frames
    lost_frames: Annotated[int, Field(ge=1, le=10_000)] = (
        10  # losses last 1 to this many frames, uniformly
    )
    # A marker centre nearer to the image border is not seen (batch). The tracker loses a dot of 7.6
    # px radius about 8 px from the border.
    border_px: NonNegative = 8.0


class WristSettings(Settings):
    """Force/torque sensor and its payload."""

    rate_hz: Positive = 1000.0
    height_mm: Positive = 120.0  # sensor above the grasp pivot
    yaw_rad: float = 0.0  # rotation of the sensor relative to the gripper
    payload_kg: NonNegative = 1.5  # gripper and fingers
    # Their centre of mass relative to the grasp pivot [U].
    payload_com_mm: tuple[float, float, float] = (0.0, 0.0, 60.0)
    white_n: NonNegative = 0.1
    white_nm: NonNegative = 0.004
    offset_n: NonNegative = 0.2  # slow offset after tare per probe; standard deviation
    offset_nm: NonNegative = 0.008
    drift_n_sqrt_min: NonNegative = 0.01
    drift_nm_sqrt_min: NonNegative = 0.0004
    cable_height_mm: float = 0.0  # point where the cables pull, above the grasp pivot


class SpreadSettings(Settings):
    """Standard deviations of the nuisances drawn per mounting, grip or probe."""

    gel: Spread = 0.10
    mu_grip: Spread = 0.10
    grip_force_n: NonNegative = 0.3
    grasp_offset_mm: NonNegative = 0.5
    jig_mm: NonNegative = 0.1  # the same if the piece is taken from a jig
    yaw_rad: NonNegative = 0.0175  # In-hand rotation about the vertical, 1 degree
    gain: Spread = 0.05
    mu: Spread = 0.15
    label_error_mm: NonNegative = 0.05
    tilt_rad: NonNegative = 0.004
    print_offset_mm: NonNegative = 0.1
    # Per probe: the piece moves (along and across the pads) and pitches in the grasp.
    reseat_mm: NonNegative = 0.0
    pitch_rad: NonNegative = 0.0
    # Per day, which begins with each mounting: piece, wrist sensor and cables.
    face_tilt_rad: NonNegative = 0.0  # face against its nominal plane, per axis
    face_crown_rad: NonNegative = 0.0  # slope of a domed or hollow face at its rim
    com_mm: NonNegative = 0.0  # centre of mass against the entered one, per axis
    pad_area: Spread = 0.0  # gripped area of the gels, which depends on the piece; relative
    wrist_yaw_rad: NonNegative = 0.0
    wrist_lever_mm: NonNegative = 0.0  # position of the sensor against the pivot, per axis
    cable_n_mm: NonNegative = 0.0  # force of the cables per travel of the hand, each of 9 entries


class SurfaceSettings(Settings):
    """Touched faces that are not flat, drawn once a scene, in ``simulate`` once a mounting.

    The shares are those of inclined, stepped and domed faces; the others are flat. A bottom with a
    surface of its own keeps it.
    """

    tilted_share: Share = 0.0
    stepped_share: Share = 0.0
    domed_share: Share = 0.0
    # Largest inclination; uniform up to it, in any direction.
    tilt_rad: Annotated[float, Field(gt=0, le=0.0524)] = 0.0524
    # Largest step; uniform up to it, along a line through the face in any direction.
    step_mm: Annotated[float, Field(gt=0, le=1)] = 1.0
    # Least radius; the curvature is uniform up to its inverse.
    dome_mm: Annotated[float, Field(ge=200)] = 200.0

    @model_validator(mode="after")
    def _shares_fit(self) -> Self:
        if self.tilted_share + self.stepped_share + self.domed_share > 1.0 + 1e-9:
            raise ValueError("the shares of tilted, stepped and domed faces exceed 1 together")
        return self


class SimulationSettings(Settings):
    """Settings of the simulated bench. ``preset`` gives the defaults, other keys override them.

    Attributes
    ----------
    preset : {"mixed", "quiet", "hard", "off", "realistic", "bench-v1", "bench-v2"}
        Named set of nuisances.
    cycle_us : int
        Control cycle of the arm, microseconds.

    Examples
    --------
    >>> SimulationSettings(preset="quiet").preset
    'quiet'

    """

    preset: Preset = "mixed"
    cycle_us: Annotated[int, Field(gt=0, le=1_000_000)] = 10_000
    mu: Friction = 0.40  # mean face friction
    mu_grip: Friction = 0.80  # mean friction of gel on piece [U]
    # Shift of the centre of mass by opening fingers (sd); preset realistic: 0.5.
    release_disturbance_mm: NonNegative = 0.0
    grasp: GraspSettings = GraspSettings()
    face: FaceSettings = FaceSettings()
    support: SupportSettings = SupportSettings()
    tactile: TactileSettings = TactileSettings()
    wrist: WristSettings = WristSettings()
    spread: SpreadSettings = SpreadSettings()
    surface: SurfaceSettings = SurfaceSettings()

    @model_validator(mode="before")
    @classmethod
    def _start_from_preset(cls, given: Any) -> Any:
        if not isinstance(given, dict):
            return given
        preset = PRESETS.get(str(given.get("preset", "mixed")))
        return given if preset is None else _overlay(preset, given)

    @model_serializer(mode="wrap")
    def _without_later_defaults(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out flat faces, and keys of ``LATER_KEYS`` that are off here and in the preset.

        Benches from before these keys keep their hash.
        """
        content: dict[str, Any] = handler(self)
        if self.surface == SurfaceSettings():
            content.pop("surface", None)
        preset = PRESETS[self.preset]
        for section, names in LATER_KEYS.items():
            values = content.get(section, {})
            fields = type(getattr(self, section)).model_fields
            for name in names:
                off = fields[name].default
                if values.get(name) == off == preset.get(section, {}).get(name, off):
                    del values[name]
        return content


# Keys added after bench-v1 was frozen. Each does nothing at its default.
LATER_KEYS: dict[str, tuple[str, ...]] = {
    "grasp": ("creep_share", "creep_s", "pad_width_mm"),
    "face": ("subcells",),
    "wrist": ("cable_height_mm",),
    "spread": (
        "reseat_mm", "pitch_rad", "face_tilt_rad", "face_crown_rad", "com_mm", "pad_area",
        "wrist_yaw_rad", "wrist_lever_mm", "cable_n_mm",
    ),
}  # fmt: skip
_RESOURCES = Path(str(files("touchdown.resources")))
PRESETS: dict[str, dict[str, Any]] = {
    "mixed": {},
    **read_toml(_RESOURCES / "presets.toml"),
    # The paper's method performs here about as on its robot (docs/bench-v1.md); never changed.
    "bench-v1": read_toml(_RESOURCES / "benches" / "bench-v1.toml"),
    "bench-v2": read_toml(_RESOURCES / "benches" / "bench-v2.toml"),  # never changed
}


def load_simulation(file: Path | None = None, preset: str | None = None) -> SimulationSettings:
    """Return the settings of ``file`` (None: the defaults), merged into those of ``preset``.

    ``preset`` replaces the preset of the file. Raises ``InputError``.
    """
    content = {} if file is None else read_toml(file)
    refuse_other_kind(content, file, "file of a simulated bench")
    if preset is not None:
        content["preset"] = preset
    return parse_settings(SimulationSettings, content, str(file) if file else "--preset")


def refuse_other_kind(content: Mapping[str, Any], file: Path | None, needed: str) -> None:
    """Raise ``InputError`` if the keys of a file are those of another kind than ``needed``."""
    kinds = {
        "lab file": LAB_FILE_KEYS,
        "file of a simulated bench": SimulationSettings.model_fields.keys(),
        "file with settings of the method": StackSettings.model_fields.keys(),
    }
    for kind, keys in kinds.items():
        if content.keys() & keys and not content.keys() & kinds[needed]:
            raise InputError(f"This is a {kind}.", str(file), f"Name a {needed}.")


def _overlay(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        if isinstance(below, dict) and isinstance(value, dict):
            merged[key] = {**below, **value}
        elif isinstance(below, dict) and isinstance(value, Settings):
            merged[key] = {**below, **value.model_dump(exclude_unset=True)}
        else:
            merged[key] = value
    return merged


def settings_with(settings: SimulationSettings, values: Mapping[str, float]) -> SimulationSettings:
    """Return ``settings`` with ``values`` by key, such as ``tactile.mm_per_px.0``.

    Raises ``InputError`` for a key that is no number of a setting, or a value out of range.
    """
    content = settings.model_dump(mode="json")
    for key, value in values.items():
        *groups, last = key.split(".")
        place: Any = content
        try:
            for name in groups:
                place = place[name]
            where = int(last) if isinstance(place, list) else last
            if not isinstance(place[where], int | float):
                raise TypeError("no number")
            place[where] = value
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise InputError(
                "The bench has no such number.", key, "Name a setting of the bench."
            ) from error
    return parse_settings(SimulationSettings, content, "bench")

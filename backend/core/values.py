"""Value types of the data flow, in the order in which they arise. Start reading here.

sensor -> episode -> patch -> belief -> stability -> action. Values are frozen; their arrays are
read-only, so that recorder, event log and display may share one object without copy or lock.

Frames (bench-wide): ``O`` centre of the bottom contact surface, z up; ``F`` centre of the face of
the grasped piece, axes parallel to ``O``; ``G`` grasp pivot between the finger pads, y along the
closing axis of the jaws; ``W`` force/torque sensor above ``G``. Wrench sign: environment on the
tool, so that Fz > 0 while pressing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ImageArray = NDArray[np.uint8]
Finger = Literal["left", "right"]
FINGERS: tuple[Finger, Finger] = ("left", "right")

GRID_ROWS, GRID_COLS = 7, 9
MARKERS = GRID_ROWS * GRID_COLS
TACTILE_CHANNELS = 2 * 2 * MARKERS
WRENCH_CHANNELS = 6
CHANNELS = TACTILE_CHANNELS + WRENCH_CHANNELS


def read_only(array: NDArray[np.generic]) -> None:
    """Forbid writing to ``array`` (every frozen value does so with its own arrays)."""
    array.flags.writeable = False


class MarkerState(IntEnum):
    """What is known of one marker in one frame; the numbers are those of the episode file."""

    SEEN = 0
    INFERRED = 1
    LOST = 2


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the grasp pivot ``G``: position in the bench frame (mm) and rotation vector (rad)."""

    x_mm: float
    y_mm: float
    z_mm: float
    rx_rad: float = 0.0
    ry_rad: float = 0.0
    rz_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One tactile image. ``image``: (240, 320, 3) uint8, BGR; ``t_s`` bench clock at grab.

    ``from_jpeg``: it came over a wire as JPEG, so that it may be damaged unnoticed.
    """

    finger: Finger
    sequence: int
    t_s: float
    image: ImageArray
    from_jpeg: bool = False

    def __post_init__(self) -> None:
        read_only(self.image)


@dataclass(frozen=True, slots=True)
class MarkerField:
    """The 63 markers of one frame, row-major (index = row * 9 + column).

    ``position_px`` and ``displacement_px``: (63, 2) float64, u right and v down; displacement is
    from the reference (zero until there is one). ``state``: (63,) uint8 of ``MarkerState``.
    ``quality``: 0 (useless) .. 1 (all markers seen, smooth field). ``residual_px``: rms residual of
    the displacement field against a rigid 2-D motion.
    """

    finger: Finger
    sequence: int
    t_s: float
    position_px: FloatArray
    displacement_px: FloatArray
    state: NDArray[np.uint8]
    quality: float
    residual_px: float = 0.0

    def __post_init__(self) -> None:
        for array in (self.position_px, self.displacement_px, self.state):
            read_only(array)


@dataclass(frozen=True, slots=True)
class ScenePicture:
    """What the scene camera saw at ``t_s`` (bench clock). ``image``: (h, w, 3) uint8, BGR."""

    t_s: float
    image: ImageArray

    def __post_init__(self) -> None:
        read_only(self.image)


@dataclass(frozen=True, slots=True)
class Recording:
    """Native-rate signals of one probe, as they were sensed.

    ``wrench_t_s`` (n,), ``wrench`` (n, 6) in N and N·m, tared; ``fields`` and ``frames`` of both
    fingers in order of time; ``pose_t_s`` (m,), ``pose_mm`` (m, 3) of ``G``, measured;
    ``tare`` (6,) was subtracted. ``scene``: pictures of the scene camera, where there is one: while
    pressed, then after lifting. ``command_t_s`` (k,), ``command_mm`` (k, 3): where ``G`` was told
    to be, each from its instant on; empty where the arm does not say.
    """

    wrench_t_s: FloatArray
    wrench: FloatArray
    fields: tuple[MarkerField, ...]
    frames: tuple[TactileFrame, ...]
    pose_t_s: FloatArray
    pose_mm: FloatArray
    tare: FloatArray
    scene: tuple[ScenePicture, ...] = ()
    command_t_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    command_mm: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        for array in (
            self.wrench_t_s, self.wrench, self.pose_t_s, self.pose_mm, self.tare,
            self.command_t_s, self.command_mm,
        ):  # fmt: skip
            read_only(array)


@dataclass(frozen=True, slots=True)
class EpisodeQuality:
    """Whether an episode may be used, and why not.

    ``reasons`` is empty exactly if ``accepted``. ``skew_ms``: largest distance between a tick and
    the nearest tactile frame. ``inferred_share``: share of marker samples not seen at the ticks.
    """

    accepted: bool
    reasons: tuple[str, ...]
    dropped_frames: int
    inferred_share: float
    lost_markers: int
    skew_ms: float
    slip_mm: float


@dataclass(frozen=True, slots=True)
class Episode:
    """One probe as the method sees it, on the 10 Hz clock that starts at the contact onset.

    ``observation``: (20, 258) float32 = 252 marker displacements in px ([finger][axis][row][col],
    left first, u then v) and 6 wrench values (Fx Fy Fz in N, Tx Ty Tz in N·m).
    ``offset_mm``: (2,) commanded position of ``F`` in the bottom frame ``O`` (or in any frame fixed
    to the bottom; only differences matter to the belief).
    """

    episode_id: str
    piece: str
    observation: NDArray[np.float32]
    offset_mm: FloatArray
    onset_s: float
    quality: EpisodeQuality
    recording: Recording | None = None
    metadata: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        read_only(self.observation)
        read_only(self.offset_mm)


@dataclass(frozen=True, slots=True)
class ContactPatch:
    """Contact probability of every point of the grasped face.

    ``points_mm``: (N, 2) lattice points in ``F``; ``probability``: (N,) in 0..1.
    """

    points_mm: FloatArray
    probability: FloatArray

    def __post_init__(self) -> None:
        read_only(self.points_mm)
        read_only(self.probability)


@dataclass(frozen=True, slots=True)
class BeliefMap:
    """Log odds of support on a square grid fixed to the bottom.

    ``log_odds``: (ny, nx); cell (i, j) is centred at ``origin_mm + pitch_mm * (j, i)`` in ``O``.
    ``probes``: number of probes fused so far. ``covered``: (ny, nx) bool, touched by any probe.
    """

    log_odds: FloatArray
    covered: NDArray[np.bool_]
    origin_mm: tuple[float, float]
    pitch_mm: float
    probes: int

    def __post_init__(self) -> None:
        read_only(self.log_odds)
        read_only(self.covered)

    @property
    def probability(self) -> FloatArray:
        """(ny, nx) probability of support, 1 / (1 + exp(-L))."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.log_odds)), dtype=np.float64)

    def cell_centres_mm(self) -> FloatArray:
        """(ny, nx, 2) centres of the cells in ``O``."""
        ny, nx = self.log_odds.shape
        x = self.origin_mm[0] + self.pitch_mm * np.arange(nx)
        y = self.origin_mm[1] + self.pitch_mm * np.arange(ny)
        grid = np.meshgrid(x, y)
        return np.stack(grid, axis=-1)


class SupportKind(Enum):
    """How many confident support cells lie under the piece, as a named outcome."""

    NONE = "no confident support"
    POINT = "a single support point"
    LINE = "support along a line only"
    AREA = "support over an area"
    NO_ESTIMATE = "no estimate: the values are not finite"


@dataclass(frozen=True, slots=True)
class Stability:
    """Would the piece stand? ``margin_mm`` is signed: positive inside the hull.

    ``hull_mm``: (k, 2) counter-clockwise vertices in ``O`` (k = 0 for none, 1, 2 for degenerate
    supports). ``centre_mm``: projection of the centre of mass in ``O``. ``margin_mm`` is
    ``-inf`` without support and NaN without an estimate; NaN is never stable.
    """

    stable: bool
    margin_mm: float
    support: SupportKind
    hull_mm: FloatArray
    centre_mm: tuple[float, float]
    source: Literal["belief", "patch"]

    def __post_init__(self) -> None:
        read_only(self.hull_mm)


@dataclass(frozen=True, slots=True)
class PlaceAction:
    """What to do next: release here, shift and probe again, or give up; always with the reason.

    ``step_mm``: the shift really taken (zero unless ``kind`` is "shift"); ``target_mm``: where the
    policy would like to be in ``O``; ``clipped``: the step was shortened to the longest allowed.
    """

    kind: Literal["release", "shift", "give_up"]
    step_mm: tuple[float, float]
    target_mm: tuple[float, float] | None
    clipped: bool
    reason: str


class Outcome(Enum):
    """How one trial ended (`placed` is the only success)."""

    PLACED = "placed"
    FELL = "fell"
    KNOCKED_OVER = "knocked_over"
    GAVE_UP = "gave_up"
    ABORTED = "aborted"


@dataclass(frozen=True, slots=True)
class Fall:
    """Motion of the bodies after a release, for the animation.

    ``t_s``: (n,); ``pose``: (n, bodies, 7) = position in m and unit quaternion w x y z per body.
    """

    t_s: FloatArray
    pose: FloatArray
    names: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        read_only(self.t_s)
        read_only(self.pose)

"""Value types of the data flow, in the order in which they arise. Start reading here.

sensor -> episode -> patch -> belief -> stability -> action. Values are frozen and their arrays are
read-only, so that recorder, event log and display share one object without copy or lock.

Frames (bench-wide): ``O`` centre of the bottom contact surface, z up; ``F`` centre of the face of
the grasped piece, axes parallel to ``O``; ``G`` grasp pivot between the finger pads, y along the
closing axis of the jaws; ``W`` force/torque sensor above ``G``. Wrench sign: environment on the
tool, so that Fz > 0 while pressing.

"The paper" is Ota et al., Tactile Estimation of Extrinsic Contact Patch for Stable Placement
(ICRA 2024, arXiv 2309.14552); ``docs/method-choices.md`` lists the choices that it leaves open.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum, IntEnum
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core.faults import InputError

FloatArray = NDArray[np.float64]
ImageArray = NDArray[np.uint8]
Finger = Literal["left", "right"]
FINGERS: tuple[Finger, Finger] = ("left", "right")

GRID_ROWS, GRID_COLS = 7, 9
MARKERS = GRID_ROWS * GRID_COLS
TACTILE_CHANNELS = 2 * 2 * MARKERS
WRENCH_CHANNELS = 6
CHANNELS = TACTILE_CHANNELS + WRENCH_CHANNELS
TICKS = 20  # of an episode


def read_only(array: NDArray[np.generic]) -> None:
    """Make ``array`` read-only, as the arrays of every value type are."""
    array.flags.writeable = False


class BadValueError(InputError, ValueError):
    """Content that a value type cannot hold; readers of files report it as damage of the file."""


def _require(valid: bool, where: str, what: str, fix: str) -> None:
    if not valid:
        raise BadValueError(f"{where} {what}.", where, fix)


def _freeze(where: str, array: NDArray[np.generic], *shape: int | str, kinds: str = "fiu") -> None:
    """Make ``array`` read-only; raise ``InputError`` unless its shape and kind of dtype fit.

    A text in ``shape`` stands for any length.
    """
    found, dtype = getattr(array, "shape", ()), getattr(array, "dtype", type(array))
    fits = found == shape or (
        len(found) == len(shape)
        and all(n == m or isinstance(m, str) for n, m in zip(found, shape, strict=True))
    )
    if not fits or getattr(dtype, "kind", "") not in kinds or not isinstance(array, np.ndarray):
        what = f"has shape {found} and type {getattr(dtype, '__name__', dtype)}"
        kind = {"u": "uint8", "b": "bool"}.get(kinds, "float64")
        wanted = str(shape).replace("'", "")
        _require(False, where, what, f"Give an array of shape {wanted} and type {kind}.")
    array.flags.writeable = False


class MarkerState(IntEnum):
    """State of one marker in one frame; the numbers are those of the episode file.

    Attributes
    ----------
    SEEN
        Measured in this frame.
    INFERRED
        Not seen; interpolated from the other markers.
    LOST
        Not seen for more than 2 s; interpolated.

    """

    SEEN = 0
    INFERRED = 1
    LOST = 2


@dataclass(frozen=True, slots=True)
class Pose:
    """Pose of the grasp pivot ``G`` in the bench frame.

    Attributes
    ----------
    x_mm, y_mm, z_mm : float
        Position of ``G``, mm.
    rx_rad, ry_rad, rz_rad : float
        Rotation vector of the hand, rad; zero when the hand points straight down.

    Examples
    --------
    >>> Pose(0.0, 0.0, 40.0).rz_rad
    0.0

    """

    x_mm: float
    y_mm: float
    z_mm: float
    rx_rad: float = 0.0
    ry_rad: float = 0.0
    rz_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class TactileFrame:
    """One image of a finger camera.

    Attributes
    ----------
    finger : {"left", "right"}
        Finger that took the image.
    sequence : int
        Number of the exposure. A gap means dropped frames.
    t_s : float
        Bench clock at the exposure, s.
    image : ndarray, shape (240, 320, 3), uint8
        BGR levels; becomes read-only.
    from_jpeg : bool
        True if the image was transferred as JPEG and may contain undetected damage.

    Examples
    --------
    >>> frame = TactileFrame("left", 0, 0.0, np.zeros((240, 320, 3), np.uint8))
    >>> frame.image.flags.writeable
    False

    """

    finger: Finger
    sequence: int
    t_s: float
    image: ImageArray
    from_jpeg: bool = False
    made = True  # False for a ``LazyFrame`` that nobody has read

    def __post_init__(self) -> None:
        read_only(self.image)  # the tracker gives an unusable image quality 0


class LazyFrame(TactileFrame):
    """A frame whose image is made by ``make`` when it is first read, by any thread."""

    __slots__ = ("_make", "made")
    _make: Callable[[], ImageArray]

    def __init__(
        self, finger: Finger, sequence: int, t_s: float, make: Callable[[], ImageArray]
    ) -> None:
        super().__init__(finger, sequence, t_s, np.empty(0, np.uint8))
        object.__delattr__(self, "image")
        object.__setattr__(self, "_make", make)
        object.__setattr__(self, "made", False)

    def __getattr__(self, name: str) -> ImageArray:
        """Make the image: an attribute is missing until it is set."""
        if name != "image":
            raise AttributeError(name)
        image = self._make()
        read_only(image)
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "made", True)
        return image


@dataclass(frozen=True, slots=True)
class MarkerField:
    """The 63 markers of one frame, row-major (index = row * 9 + column).

    The displacements are the tactile signal of the method (paper, section III).

    Attributes
    ----------
    finger, sequence, t_s
        As in the ``TactileFrame``.
    position_px : ndarray, shape (63, 2), float64
        Marker centres in px of the 320 x 240 image, u right and v down.
    displacement_px : ndarray, shape (63, 2), float64
        Position minus reference position, px; zero without a reference.
    state : ndarray, shape (63,), uint8
        ``MarkerState`` of each marker.
    quality : float
        0 (useless) to 1 (all markers seen, smooth field).
    residual_px : float
        Rms residual of the displacements against a rigid motion in the image plane, px.

    Examples
    --------
    >>> rest = np.zeros((MARKERS, 2))
    >>> moved = rest + [0.0, -1.5]
    >>> field = MarkerField("left", 1, 0.04, rest, moved, np.zeros(MARKERS, np.uint8), 1.0)
    >>> int((field.state == MarkerState.SEEN).sum())
    63

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
        _freeze("MarkerField.position_px", self.position_px, MARKERS, 2)
        _freeze("MarkerField.displacement_px", self.displacement_px, MARKERS, 2)
        _freeze("MarkerField.state", self.state, MARKERS, kinds="u")


@dataclass(frozen=True, slots=True)
class ScenePicture:
    """One image of the scene camera.

    Attributes
    ----------
    t_s : float
        Bench clock at the exposure, s.
    image : ndarray, shape (h, w, 3), uint8
        BGR levels.

    """

    t_s: float
    image: ImageArray

    def __post_init__(self) -> None:
        _freeze("ScenePicture.image", self.image, "rows", "columns", 3, kinds="u")


@dataclass(frozen=True, slots=True)
class Recording:
    """Signals of one probe at their native rates.

    Attributes
    ----------
    wrench_t_s : ndarray, shape (n,)
        Times of the wrench samples, bench clock, s.
    wrench : ndarray, shape (n, 6)
        Fx, Fy, Fz in N and Tx, Ty, Tz in N·m at the sensor ``W``, tared; environment on tool.
    fields : tuple of MarkerField
        Marker fields of both fingers in order of time.
    frames : tuple of TactileFrame
        Images of both fingers in order of time.
    pose_t_s : ndarray, shape (m,)
        Times of the measured positions, s.
    pose_mm : ndarray, shape (m, 3)
        Measured position of ``G`` in the bench frame, mm.
    tare : ndarray, shape (6,)
        Wrench that was subtracted, N and N·m.
    scene : tuple of ScenePicture
        Images of the scene camera while pressed, then after lifting; empty without a camera.
    command_t_s : ndarray, shape (k,)
        Times of the commanded positions, s; empty if the arm does not report them.
    command_mm : ndarray, shape (k, 3)
        Commanded position of ``G`` from each time on, mm.

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
        _freeze("Recording.wrench_t_s", self.wrench_t_s, "samples")
        _freeze("Recording.wrench", self.wrench, len(self.wrench_t_s), WRENCH_CHANNELS)
        _freeze("Recording.pose_t_s", self.pose_t_s, "samples")
        _freeze("Recording.pose_mm", self.pose_mm, len(self.pose_t_s), 3)
        _freeze("Recording.command_t_s", self.command_t_s, "samples")
        _freeze("Recording.command_mm", self.command_mm, len(self.command_t_s), 3)
        _freeze("Recording.tare", self.tare, WRENCH_CHANNELS)


@dataclass(frozen=True, slots=True)
class EpisodeQuality:
    """Verdict on the use of an episode as an observation.

    Attributes
    ----------
    accepted : bool
        True if the episode may be used.
    reasons : tuple of str
        Reasons for a refusal; empty exactly if ``accepted``.
    dropped_frames : int
        Frames missing by their sequence numbers, both fingers.
    inferred_share : float
        Share of marker samples at the ticks that were not seen, 0 to 1.
    lost_markers : int
        Markers given up during the probe, both fingers.
    skew_ms : float
        Largest distance between a tick and the nearest tactile frame, ms.
    slip_mm : float
        Slip of the piece in the grasp, mm; NaN if it cannot be judged.

    """

    accepted: bool
    reasons: tuple[str, ...] = ()
    dropped_frames: int = 0
    inferred_share: float = 0.0
    lost_markers: int = 0
    skew_ms: float = 0.0
    slip_mm: float = np.nan


@dataclass(frozen=True, slots=True)
class Episode:
    """One probe on the 10 Hz clock that starts at the contact onset: the input of the model.

    T = 2 s at 10 Hz, 63 markers of two fingers and a wrench (paper, section III).

    Attributes
    ----------
    episode_id : str
        Digest of the content; equal probes have equal ids.
    piece : str
        Name of the grasped piece.
    observation : ndarray, shape (20, 258), float32
        Per tick 252 marker displacements in px, ordered [finger][axis][row][column], left first, u
        then v; then Fx, Fy, Fz in N and Tx, Ty, Tz in N·m. NaN where nothing was measured.
    offset_mm : ndarray, shape (2,), float64
        Commanded position of ``F`` in ``O``, mm, or in any frame fixed to the bottom: only
        differences enter the belief.
    onset_s : float, default: 0
        Back-dated time of first contact, bench clock, s.
    quality : EpisodeQuality, default: accepted
        Verdict on its use.
    recording : Recording or None
        Signals at their native rates, if kept.
    metadata : tuple of (str, str)
        Further facts by name.

    Examples
    --------
    >>> episode = Episode("0", "pot", np.zeros((20, 258), np.float32), np.zeros(2))
    >>> tactile = episode.observation[:, :TACTILE_CHANNELS].reshape(20, 2, 2, 7, 9)
    >>> wrench = episode.observation[:, TACTILE_CHANNELS:]
    >>> wrench.shape
    (20, 6)

    """

    episode_id: str
    piece: str
    observation: NDArray[np.float32]
    offset_mm: FloatArray
    onset_s: float = 0.0
    quality: EpisodeQuality = EpisodeQuality(True)
    recording: Recording | None = None
    metadata: tuple[tuple[str, str], ...] = ()

    def __post_init__(self) -> None:
        _freeze("Episode.observation", self.observation, TICKS, CHANNELS)
        _freeze("Episode.offset_mm", self.offset_mm, 2)
        finite = not self.quality.accepted or bool(np.isfinite(self.offset_mm).all())
        _require(finite, "Episode.offset_mm", "is not finite", "Give the position in mm.")


@dataclass(frozen=True, slots=True)
class ContactPatch:
    """Estimated contact probability at each point of the grasped face: the output of the model.

    The paper estimates the patch as a set of probabilities over the face (section III).

    Attributes
    ----------
    points_mm : ndarray, shape (N, 2), float64
        Lattice points of the face in ``F``, mm.
    probability : ndarray, shape (N,), float64
        Contact probability of each point, 0 to 1; NaN if the model gives none.

    Examples
    --------
    >>> patch = ContactPatch(np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([0.97, 0.2]))
    >>> patch.points_mm[patch.probability > 0.9].tolist()
    [[0.0, 0.0]]

    """

    points_mm: FloatArray
    probability: FloatArray

    def __post_init__(self) -> None:
        _freeze("ContactPatch.points_mm", self.points_mm, "points", 2)
        p, where = self.probability, "ContactPatch.probability"
        _freeze(where, p, len(self.points_mm))
        share = not bool(((p < 0.0) | (p > 1.0)).any())
        _require(share, where, "is not within 0 to 1", "NaN stands for no estimate.")


@dataclass(frozen=True, slots=True)
class BeliefMap:
    """Log odds of support on a square grid fixed to the bottom.

    The log odds of a cell are the sum of those of the fused probes, L = sum log(p / (1 - p)), the
    product of probabilities of the paper in log form.

    Attributes
    ----------
    log_odds : ndarray, shape (ny, nx), float64
        Cell (i, j) is centred at ``origin_mm + pitch_mm * (j, i)``; 0 means unknown.
    covered : ndarray, shape (ny, nx), bool
        True where the face of at least one probe was.
    origin_mm : tuple of float
        Centre of cell (0, 0) in ``O``, mm.
    pitch_mm : float
        Distance of the cells, mm.
    probes : int
        Number of fused probes.

    Examples
    --------
    >>> belief = BeliefMap(np.zeros((2, 3)), np.zeros((2, 3), bool), (-1.0, 0.0), 1.0, 0)
    >>> belief.probability[0, 0].item()
    0.5
    >>> belief.cell_centres_mm()[1, 2].tolist()
    [1.0, 1.0]

    """

    log_odds: FloatArray
    covered: NDArray[np.bool_]
    origin_mm: tuple[float, float]
    pitch_mm: float
    probes: int

    def __post_init__(self) -> None:
        _freeze("BeliefMap.log_odds", self.log_odds, "rows", "columns")
        _freeze("BeliefMap.covered", self.covered, *self.log_odds.shape, kinds="b")
        numbers = not bool(np.isnan(self.log_odds).any())
        _require(numbers, "BeliefMap.log_odds", "holds NaN", "Give 0 where nothing is known.")
        where = "BeliefMap.pitch_mm"
        _require(self.pitch_mm > 0, where, "is not positive", "Give the distance of cells in mm.")

    @property
    def probability(self) -> FloatArray:
        """(ny, nx) probability of support, 1 / (1 + exp(-L))."""
        return np.asarray(1.0 / (1.0 + np.exp(-self.log_odds)), dtype=np.float64)

    def cell_centres_mm(self) -> FloatArray:
        """(ny, nx, 2) centres of the cells in ``O``."""
        ny, nx = self.log_odds.shape
        x = self.origin_mm[0] + self.pitch_mm * np.arange(nx)
        y = self.origin_mm[1] + self.pitch_mm * np.arange(ny)
        return np.stack(np.meshgrid(x, y), axis=-1)


class SupportKind(Enum):
    """Shape of the confident support below the piece."""

    NONE = "no confident support"
    POINT = "a single support point"
    LINE = "support along a line only"
    AREA = "support over an area"
    NO_ESTIMATE = "no estimate: the values are not finite"


@dataclass(frozen=True, slots=True)
class Stability:
    """Estimated stability of the piece if it were released here.

    Stable if the projected centre of mass lies in the convex hull of the points with a contact
    probability above 0.9 (paper, section III).

    Attributes
    ----------
    stable : bool
        True if the piece would stand.
    margin_mm : float
        Signed distance of the centre of mass to the edge of the hull, mm, positive inside; ``-inf``
        without support, NaN without an estimate. NaN is never stable.
    support : SupportKind
        Shape of the support.
    hull_mm : ndarray, shape (k, 2), float64
        Counter-clockwise vertices in ``O``, mm; k = 0 without support, 1 or 2 if degenerate.
    centre_mm : tuple of float
        Projection of the centre of mass in ``O``, mm.
    source : {"belief", "patch"}
        Estimate that was judged.

    Examples
    --------
    >>> square = np.array([[-4.0, -4.0], [4.0, -4.0], [4.0, 4.0], [-4.0, 4.0]])
    >>> Stability(True, 4.0, SupportKind.AREA, square, (0.0, 0.0), "belief").support.value
    'support over an area'

    """

    stable: bool
    margin_mm: float
    support: SupportKind
    hull_mm: FloatArray
    centre_mm: tuple[float, float]
    source: Literal["belief", "patch"]

    def __post_init__(self) -> None:
        _freeze("Stability.hull_mm", self.hull_mm, "vertices", 2)
        judged = not (self.stable and math.isnan(self.margin_mm))
        _require(judged, "Stability.stable", "is True without a margin", "NaN is never stable.")


@dataclass(frozen=True, slots=True)
class PlaceAction:
    """Next action of the policy: release, shift and probe again, ask the operator, or give up.

    Attributes
    ----------
    kind : {"release", "shift", "ask", "give_up"}
        Action.
    step_mm : tuple of float
        Commanded shift in x and y, mm, at most 3 mm long (paper, section III); zero unless ``kind``
        is "shift".
    target_mm : tuple of float or None
        Position in ``O`` at which the policy aims, mm.
    clipped : bool
        True if the step was shortened to the longest allowed.
    reason : str
        Reason, as one sentence.

    Examples
    --------
    >>> PlaceAction("shift", (3.0, 0.0), (7.5, 0.0), True, "The support is to the right.").clipped
    True

    """

    kind: Literal["release", "shift", "ask", "give_up"]
    step_mm: tuple[float, float]
    target_mm: tuple[float, float] | None
    clipped: bool
    reason: str


class Outcome(Enum):
    """End of a trial; ``PLACED`` is the only success.

    Attributes
    ----------
    PLACED
        The piece stands.
    FELL
        The piece fell after the release.
    KNOCKED_OVER
        A probe or move knocked over the bottoms.
    GAVE_UP
        The policy, or the operator it asked, ended the trial without a release.
    ASKED
        A question to the operator was not answered; nothing was released.
    ABORTED
        Stop, fault or cancel.

    Examples
    --------
    >>> Outcome("placed") is Outcome.PLACED
    True

    """

    PLACED = "placed"
    FELL = "fell"
    KNOCKED_OVER = "knocked_over"
    GAVE_UP = "gave_up"
    ASKED = "asked"
    ABORTED = "aborted"


@dataclass(frozen=True, slots=True)
class Fall:
    """Motion of the bodies after a release, for the animation.

    Attributes
    ----------
    t_s : ndarray, shape (n,)
        Times since the release, s.
    pose : ndarray, shape (n, bodies, 7)
        Position in m (x, y, z) and unit quaternion (w, x, y, z) of each body.
    names : tuple of str
        Names of the bodies.

    """

    t_s: FloatArray
    pose: FloatArray
    names: tuple[str, ...] = field(default=())

    def __post_init__(self) -> None:
        _freeze("Fall.t_s", self.t_s, "frames")
        _freeze("Fall.pose", self.pose, len(self.t_s), "bodies", 7)

"""Episodes in edit: label, edit, scene pictures."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from touchdown.backend.annotations import (
    NO_LABEL,
    Dataset,
    EpisodeEntry,
    Label,
    Pair,
    Revision,
    Source,
)
from touchdown.backend.core import FINGERS, Episode, FloatArray, ImageArray, InputError, MarkerField
from touchdown.backend.episodes import HOMOGRAPHY_KEY, CompressedEpisode
from touchdown.backend.geometry import rotated
from touchdown.backend.placement import OffsetFit
from touchdown.backend.sensing import Homography, observe_offset
from touchdown.widgets.plots import WrenchTrace
from touchdown.widgets.views import FilmTrack, PictureOutline, Reel, SceneShot, latest

LIMIT_UM = 99_990  # largest displacement that can be typed or nudged
NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)"
TYPED = re.compile(rf"\s*({NUMBER})\s*,\s*({NUMBER})\s*(?:,\s*({NUMBER})\s*)?")


@dataclass(frozen=True, slots=True)
class LabelDraft:
    """``base`` is the stored revision; ``label`` and ``source`` are what would be saved."""

    base: Revision
    label: Label
    source: Source

    @classmethod
    def of(cls, head: Revision) -> LabelDraft:
        """Start with the stored label."""
        return cls(head, head.label, head.source)

    @classmethod
    def blank(cls, head: Revision) -> LabelDraft:
        """Start without a label, for an unbiased opinion."""
        return cls(replace(head, label=NO_LABEL, source="human"), NO_LABEL, "human")

    @property
    def changed(self) -> bool:
        """True if there is something to save."""
        return self.label != self.base.label

    @property
    def offset_mm(self) -> tuple[float, float] | None:
        """The displacement, None without one."""
        if self.label.x_um is None or self.label.y_um is None:
            return None
        return self.label.x_um / 1e3, self.label.y_um / 1e3

    @property
    def sigma_mm(self) -> float:
        """The standard uncertainty, 0 if unknown."""
        return (self.label.sigma_um or 0) / 1e3

    @property
    def yaw_rad(self) -> float:
        """The rotation of the face."""
        return math.radians((self.label.theta_mdeg or 0) / 1e3)

    def nudged(self, dx_um: int, dy_um: int) -> LabelDraft:
        """Move by whole µm; without a displacement, start at the centre of the bottom."""
        return self._at((self.label.x_um or 0) + dx_um, (self.label.y_um or 0) + dy_um)

    def placed(self, x_mm: float, y_mm: float) -> LabelDraft:
        """Move to a position."""
        return self._at(round(x_mm * 1e3), round(y_mm * 1e3))

    def estimated(self, x_mm: float, y_mm: float, sigma_mm: float, source: Source) -> LabelDraft:
        """Use a model's estimate with its uncertainty."""
        moved = self._at(round(x_mm * 1e3), round(y_mm * 1e3))
        return replace(
            moved, label=replace(moved.label, sigma_um=round(sigma_mm * 1e3)), source=source
        )

    def trusted(self, sigma_mm: float) -> LabelDraft:
        """Set the person's uncertainty."""
        return replace(self, label=replace(self.label, sigma_um=round(sigma_mm * 1e3)))

    def _at(self, x_um: int, y_um: int) -> LabelDraft:
        x, y = (min(max(value, -LIMIT_UM), LIMIT_UM) for value in (x_um, y_um))
        theta = self.label.theta_mdeg or 0
        base = self.base.label
        if base.is_set and (x, y, theta) == (base.x_um, base.y_um, base.theta_mdeg or 0):
            # Moved back to the start: the source stays unchanged.
            return LabelDraft.of(self.base)
        # The uncertainty of another person does not apply.
        sigma = self.label.sigma_um if self.source == "human" else None
        return replace(self, label=Label(x, y, theta, sigma), source="human")


def parse_displacement(text: str) -> tuple[float, float, float | None]:
    """Return x, y and optional sigma in mm from "x,y" or "x,y,sigma". Raises ``ValueError``."""
    match = TYPED.fullmatch(text)
    if match is None:
        raise ValueError("Type x,y in mm, such as 1.5,-2 (or x,y,uncertainty).")
    x, y = float(match[1]), float(match[2])
    sigma = float(match[3]) if match[3] is not None else None
    if max(abs(x), abs(y)) * 1e3 > LIMIT_UM:
        raise ValueError("No displacement is larger than 99.99 mm.")
    if sigma is not None and not 0.001 <= sigma <= 20:
        raise ValueError("An uncertainty lies between 0.001 and 20 mm.")
    return x, y, sigma


def as_float_pair(offset_mm: FloatArray) -> tuple[float, float]:
    """Return a (2,) displacement as a pair."""
    x, y = offset_mm.tolist()
    return float(x), float(y)


@dataclass(frozen=True, slots=True)
class SceneObservation:
    """``images``: pressed, then lifted. ``place``: the face in the first, None if not seen."""

    images: tuple[ImageArray, ...]
    board: Homography
    place: OffsetFit | None

    @property
    def bytes(self) -> int:
        """Size of the pictures in memory."""
        return sum(image.nbytes for image in self.images)


def scene_observation(episode: Episode, pair: Pair, face: FloatArray) -> SceneObservation | None:
    """Return what the scene camera recorded, None without picture or calibration."""
    text = dict(episode.metadata).get(HOMOGRAPHY_KEY)
    if episode.recording is None or not episode.recording.scene or text is None:
        return None
    try:
        board = Homography.parse(text)
    except InputError:
        return None
    images = tuple(picture.image for picture in episode.recording.scene)
    seen = observe_offset(images[0], board, face, episode.offset_mm)
    place = None if seen is None else OffsetFit(as_float_pair(seen.offset_mm), seen.sigma_mm)
    return SceneObservation(images, board, place)


def scene_shots(
    scene: SceneObservation | None,
    edit: LabelDraft,
    outlines: tuple[FloatArray, FloatArray],
    *,
    hidden: bool,
) -> Sequence[SceneShot]:
    """Return the pictures with outlines of face and bottom; observed ones unless ``hidden``."""
    if scene is None:
        return ()
    face, bottom = outlines
    marks = [PictureOutline("bottom", scene.board.to_px(bottom))]
    if edit.offset_mm is not None:
        placed = rotated(face, edit.yaw_rad) + np.asarray(edit.offset_mm)
        marks.append(PictureOutline("label", scene.board.to_px(placed)))
    if scene.place is not None and not hidden:
        marks.append(
            PictureOutline("scene", scene.board.to_px(face + np.asarray(scene.place.offset_mm)))
        )
    # After lifting, only the bottom is in the plane of the board.
    return [SceneShot(scene.images[0], tuple(marks))] + [
        SceneShot(image, tuple(marks[:1])) for image in scene.images[1:]
    ]


Outlines = tuple[FloatArray, FloatArray]
MAX_OUTLINES = 16
# Number of decoded pictures kept per finger.
KEPT_PICTURES, PICTURE_BYTES = 2, 3 * 240 * 320
CURSOR_S = 2.0  # an episode is first shown at the end of the press


@dataclass(frozen=True, slots=True)
class ModelLabel:
    """Estimate of the models; ``spread_mm`` is the spread between them.

    ``weights``: hashes of the models, joined by ``+``.
    """

    fit: OffsetFit
    weights: str
    spread_mm: float = 0.0

    @property
    def source(self) -> str:
        """Source under which such a label is stored."""
        return f"model:{self.weights}"


# Returns the model's estimate of an episode, None without a model of its piece.
PrelabelFunction = Callable[[Episode, Pair], ModelLabel | None]


@dataclass(frozen=True, slots=True)
class LabelItem:
    """Unchanging data of an episode in edit; ``bytes`` is its size in memory."""

    entry: EpisodeEntry
    episode: Episode
    pair: Pair
    face: FloatArray
    bottom: FloatArray
    reel: Reel
    trace: WrenchTrace | None
    model: ModelLabel | None
    bytes: int
    scene: SceneObservation | None = None
    # Revision judged by the other episodes of its pair, and its ``doubt``.
    doubt: tuple[str, float] | None = None

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last time to show, relative to the contact onset."""
        if self.trace is None or not len(self.trace.t_s):
            return 0.0, 2.0
        return float(self.trace.t_s[0]), float(self.trace.t_s[-1])


def item_reader(dataset: Dataset, prelabel: PrelabelFunction) -> Callable[[str], LabelItem]:
    """Return a function that reads an episode of ``dataset``. Any thread may call it."""
    outlines = lru_cache(MAX_OUTLINES)(pair_outlines)

    def read(uuid: str) -> LabelItem:
        entry = dataset.entry(uuid)
        film = dataset.film(uuid)
        pair = dataset.geometry.pair(entry.geometry)
        item = make_item(entry, film, pair, prelabel(film.episode, pair), outlines(pair))
        first, last = item.span_s
        for track in item.reel.values():
            index = latest(track.picture_t_s, min(max(CURSOR_S, first), last))
            if index >= 0:
                track.picture(index)
        return replace(item, doubt=dataset.scores.of_revision("doubt", uuid))

    return read


def pair_outlines(pair: Pair) -> Outlines:
    """Return the outlines (k, 2) of face and bottom. Views identify a pair by these arrays."""
    return pair.face.path(96), pair.bottom.path(96)


def make_item(
    entry: EpisodeEntry,
    film: CompressedEpisode,
    pair: Pair,
    model: ModelLabel | None,
    outlines: Outlines,
) -> LabelItem:
    """Build an item from recorded data; times are relative to the contact onset."""
    episode, recording = film.episode, film.episode.recording
    trace, fields = None, {finger: tuple[MarkerField, ...]() for finger in FINGERS}
    if recording is not None:
        trace = WrenchTrace(recording.wrench_t_s - episode.onset_s, recording.wrench)
        fields = {f: tuple(x for x in recording.fields if x.finger == f) for f in FINGERS}
    reel = {
        finger: FilmTrack(
            film.pictures[finger].t_s - episode.onset_s,
            lru_cache(KEPT_PICTURES)(film.pictures[finger].picture),
            np.array([x.t_s for x in fields[finger]]) - episode.onset_s,
            fields[finger],
        )
        for finger in FINGERS
    }
    numbers = 0 if recording is None else recording.wrench.nbytes + recording.pose_mm.nbytes
    per_field = sum(len(x) for x in fields.values()) * 3 * 1024
    scene = scene_observation(episode, pair, pair.face.polygon(96))
    return LabelItem(
        entry, episode, pair, *outlines, reel, trace, model,
        film.bytes + numbers + per_field + len(FINGERS) * KEPT_PICTURES * PICTURE_BYTES
        + (0 if scene is None else scene.bytes), scene,
    )  # fmt: skip

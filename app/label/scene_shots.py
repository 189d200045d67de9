"""The pictures of the scene camera as the label page shows them, and what was measured in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.label.edit import Edit, as_pair
from backend.catalogue.geometry import Pair
from backend.core.faults import InputError
from backend.core.flow import Episode, FloatArray, ImageArray
from backend.objects.shapes import turned
from backend.placement.offset_fit import OffsetFit
from backend.sensing.board import Homography
from backend.sensing.slip_picture import seen_place
from widgets.scene_shot import Outline, SceneShot

HOMOGRAPHY = "scene_homography"


@dataclass(frozen=True, slots=True)
class SceneEvidence:
    """``images``: pressed, then lifted; ``place`` of the face in the first, None if not seen."""

    images: tuple[ImageArray, ...]
    board: Homography
    place: OffsetFit | None

    @property
    def bytes(self) -> int:
        """Size of the pictures in memory."""
        return sum(image.nbytes for image in self.images)


def scene_of(episode: Episode, pair: Pair, face: FloatArray) -> SceneEvidence | None:
    """Return what the scene camera tells of an episode, None without picture or calibration."""
    text = dict(episode.metadata).get(HOMOGRAPHY)
    if episode.recording is None or not episode.recording.scene or text is None:
        return None
    try:
        board = Homography.parse(text)
    except InputError:
        return None
    images = tuple(picture.image for picture in episode.recording.scene)
    seen = seen_place(images[0], board, face, episode.offset_mm)
    place = None if seen is None else OffsetFit(as_pair(seen.offset_mm), seen.sigma_mm)
    return SceneEvidence(images, board, place)


def shots_of(
    scene: SceneEvidence | None,
    edit: Edit,
    outlines: tuple[FloatArray, FloatArray],
    *,
    hidden: bool,
) -> Sequence[SceneShot]:
    """Return the pictures with the outlines (face, bottom) of the label; what was seen, unless
    ``hidden``.
    """
    if scene is None:
        return ()
    face, bottom = outlines
    marks = [Outline("bottom", scene.board.to_px(bottom))]
    if edit.offset_mm is not None:
        placed = turned(face, edit.yaw_rad) + np.asarray(edit.offset_mm)
        marks.append(Outline("label", scene.board.to_px(placed)))
    if scene.place is not None and not hidden:
        marks.append(Outline("scene", scene.board.to_px(face + np.asarray(scene.place.offset_mm))))
    # After lifting the face is above the board: only the bottom lies in its plane.
    return [SceneShot(scene.images[0], tuple(marks))] + [
        SceneShot(image, tuple(marks[:1])) for image in scene.images[1:]
    ]

"""Positions on the board from the picture of the scene camera.

The board is the plane of the touched face (z = 0 of the bench frame). Four bright dots at known
positions on it determine the homography: one picture of the bench is the whole calibration.

A piece that slipped, or was gripped off its nominal position, has an offset unknown to the arm.
While it is pressed its face lies in the plane of the board, so that the homography maps the front
rim of the face exactly. Only that rim is used; the rest of the outline is hidden by the piece.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from touchdown.backend.core import FloatArray, ImageArray, InputError, parse_json, read_only
from touchdown.backend.geometry import BOARD_DOTS_MM

MIN_DOT_AREA_PX = 20
BRIGHT = 230  # dots are magenta: blue and red at least this, green at most ``255 - BRIGHT``
MAX_RESIDUAL_PX = 2.0
MIN_TILT = 0.02  # smallest foreshortening that determines the focal length
_FIX = "Show all four dots to the camera, evenly lit, and calibrate again."


@dataclass(frozen=True, slots=True)
class Homography:
    """``matrix`` (3, 3): board mm to image px (right, down); ``residual_px``: rms of its fit."""

    matrix: FloatArray
    residual_px: float

    def __post_init__(self) -> None:
        read_only(self.matrix)

    def to_px(self, board_mm: ArrayLike) -> FloatArray:
        """Return (n, 2) px of board points (n, 2) in mm."""
        return _apply_homography(self.matrix, board_mm)

    def text(self) -> str:
        """Return the form stored in episodes."""
        return json.dumps({"matrix": self.matrix.tolist(), "residual_px": self.residual_px})

    @classmethod
    def parse(cls, text: str) -> Homography:
        """Return the homography of a ``text``; raises ``InputError``."""
        try:
            content = parse_json(text)
            matrix = np.array(content["matrix"], dtype=np.float64).reshape(3, 3)
            residual_px = float(content["residual_px"])
        except (ValueError, TypeError, KeyError) as error:
            raise InputError(f"The homography is damaged: {error}.", "scene", _FIX) from error
        if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix)) < 1e-12:
            raise InputError("The homography is singular.", "scene", _FIX)
        return cls(matrix, residual_px)


def locate_camera(
    board: Homography, size_px: tuple[int, int]
) -> tuple[float, FloatArray, FloatArray] | None:
    """Return focal length in px, axes (3, 3) and centre (3,) in mm of the camera of ``board``.

    The columns of the axes are right, down and ahead; the principal point is the centre of the
    picture. None where the camera looks straight down, which leaves the focal length open. Source:
    Zhang, A flexible new technique for camera calibration, IEEE PAMI 22 (2000), eq. 3 and 4.
    """
    h = board.matrix.copy()
    h[:2] -= np.outer(0.5 * np.array(size_px), h[2])
    # The axes of the board are orthogonal and of one length: two equations for 1 / f².
    first, second = h[:2, 0], h[:2, 1]
    a = np.array([first @ second, first @ first - second @ second])
    b = np.array([h[2, 0] * h[2, 1], h[2, 0] ** 2 - h[2, 1] ** 2])
    if not (np.hypot(*a) > MIN_TILT * (first @ first) and a @ b < 0.0):
        return None
    focal_px = math.sqrt(float(a @ a / -(a @ b)))
    h[2] *= focal_px
    h *= math.copysign(2.0, h[2, 2]) / np.linalg.norm(h[:, :2], axis=0).sum()
    u, _, v = np.linalg.svd(np.column_stack([h[:, 0], h[:, 1], np.cross(h[:, 0], h[:, 1])]))
    axes = np.asarray((u @ v).T)
    return focal_px, axes, np.asarray(-axes @ h[:, 2])


def fit_homography(board_mm: FloatArray, image_px: FloatArray) -> Homography:
    """Fit (n, 2) board points to (n, 2) image points, n >= 4, by the normalised linear method.

    Source: Hartley and Zisserman, Multiple View Geometry, algorithm 4.2. Raises ``InputError`` for
    points on a line.
    """
    if len(board_mm) < 4:
        raise InputError(f"{len(board_mm)} points are too few.", "scene", _FIX)
    to, back = _normaliser(board_mm), _normaliser(image_px)
    source, target = _apply_homography(to, board_mm), _apply_homography(back, image_px)
    rows = []
    for (x, y), (u, v) in zip(source, target, strict=True):
        rows.append([-x, -y, -1, 0, 0, 0, u * x, u * y, u])
        rows.append([0, 0, 0, -x, -y, -1, v * x, v * y, v])
    _, strength, vectors = np.linalg.svd(np.array(rows))
    if not strength[7] > 1e-9 * strength[0]:
        raise InputError("The points lie on a line.", "scene", _FIX)
    matrix = np.linalg.inv(back) @ vectors[-1].reshape(3, 3) @ to
    matrix = matrix / matrix[2, 2]
    errors = _apply_homography(matrix, board_mm) - image_px
    return Homography(matrix, float(np.sqrt((errors**2).sum(axis=1).mean())))


def calibrate_scene_camera(image: ImageArray) -> Homography:
    """Find the four dots in a picture (h, w, 3) and fit; raises ``InputError``.

    The dots are identified by their order around their centre; the lowest left one in the picture
    is the lower left one of the board.
    """
    bright = (image[..., 0] >= BRIGHT) & (image[..., 2] >= BRIGHT)
    bright &= image[..., 1] <= 255 - BRIGHT
    count, labels = cv2.connectedComponents(bright.astype(np.uint8))
    spots = [np.argwhere(labels == k)[:, ::-1] for k in range(1, count)]
    found = [spot.mean(axis=0) for spot in spots if len(spot) >= MIN_DOT_AREA_PX]
    if len(found) != len(BOARD_DOTS_MM):
        raise InputError(f"{len(found)} dots are seen instead of four.", "scene camera", _FIX)
    fitted = fit_homography(BOARD_DOTS_MM, _in_order(np.array(found)))
    if not fitted.residual_px <= MAX_RESIDUAL_PX:
        what = f"The dots are {fitted.residual_px:.1f} px off their places."
        raise InputError(what, "scene camera", _FIX)
    return fitted


def _in_order(places_px: FloatArray) -> FloatArray:
    """Return the four dots counter-clockwise on the board, lower left first."""
    from_middle = places_px - places_px.mean(axis=0)
    turned = np.arctan2(-from_middle[:, 1], from_middle[:, 0])
    around = places_px[np.argsort(turned)]
    first = int(np.argmin(around[:, 0] - around[:, 1]))
    return np.roll(around, -first, axis=0)


def _normaliser(points: FloatArray) -> FloatArray:
    """Return the (3, 3) similarity that maps points to mean 0 and mean distance sqrt 2."""
    middle = points.mean(axis=0)
    spread = float(np.hypot(*(points - middle).T).mean()) or 1.0
    scale = np.sqrt(2.0) / spread
    return np.array(
        [[scale, 0.0, -scale * middle[0]], [0.0, scale, -scale * middle[1]], [0.0, 0.0, 1.0]]
    )


def _apply_homography(matrix: FloatArray, points: ArrayLike) -> FloatArray:
    given = np.asarray(points, dtype=np.float64).reshape(-1, 2)
    mapped = np.column_stack([given, np.ones(len(given))]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


REACH_MM = 4.0  # the rim is searched this far on both sides of its expected position
STEP_MM = 0.1
RIM_POINTS = 96
INNER_PART = 0.4  # part of the face that gives the colour of the piece
MIN_COLOUR_SPREAD = 12.0  # colours nearer than this (of 255) are equal
# The rim is visible where its outward normal points down in the image by this share.
FRONT_SHARE = 0.35
# An upright piece covers this share of the points this far behind its far rim.
BEHIND_MM, MIN_BEHIND_SHARE = 1.0, 0.6
MIN_EDGE_POINTS = 12
FIT_ROUNDS = 6
MAX_EDGE_ERROR_MM = 0.5  # edges farther from the fitted rim are outliers
# Smallest uncertainty: edge, image compression, and fit of the board (measured, see tests).
FLOOR_MM = 0.12


@dataclass(frozen=True, slots=True)
class ObservedOffset:
    """Observed ``offset_mm`` (2,) of the face in ``O``, and its standard uncertainty per axis."""

    offset_mm: FloatArray
    sigma_mm: float

    def __post_init__(self) -> None:
        read_only(self.offset_mm)


def observe_offset(
    image: ImageArray, board: Homography, face_mm: FloatArray, near_mm: FloatArray
) -> ObservedOffset | None:
    """Return the offset of the face, None if its rim is not found.

    ``image`` (h, w, 3) BGR while pressed; ``face_mm`` (k, 2): outline of the face about its centre,
    counter-clockwise; ``near_mm`` (2,): initial displacement, within 4 mm of the true one. The
    camera must be upright and the piece must have a distinct colour.
    """
    rim, outward = _even_rim(face_mm)
    like = _colour_match(image, board, INNER_PART * face_mm + near_mm)
    at: FloatArray = np.array(near_mm, dtype=np.float64)
    found = None
    for turn in range(FIT_ROUNDS):
        found = _fit(like, board, rim, outward, at, REACH_MM if turn < 2 else 1.0)
        if found is None:
            return None
        at = at + found[0]
    assert found is not None
    _, sigma_mm = found
    if not math.dist(at, near_mm) <= REACH_MM or not _is_upright(like, board, rim + at, outward):
        return None
    one_mm = board.to_px(np.array([at, at + np.array([1.0, 0.0])]))
    board_mm = board.residual_px / math.dist(*one_mm.tolist())
    return ObservedOffset(at, math.hypot(sigma_mm, board_mm, FLOOR_MM))


def _even_rim(face_mm: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return evenly spaced points (n, 2) on the outline and their outward normals (n, 2)."""
    closed = np.concatenate([face_mm, face_mm[:1]])
    edges = np.diff(closed, axis=0)
    length = np.concatenate([[0.0], np.cumsum(np.hypot(*edges.T))])
    s = (np.arange(RIM_POINTS) + 0.5) * length[-1] / RIM_POINTS
    edge = np.clip(np.searchsorted(length, s, side="right") - 1, 0, len(edges) - 1)
    points = np.column_stack([np.interp(s, length, closed[:, axis]) for axis in range(2)])
    along = edges[edge] / np.linalg.norm(edges[edge], axis=1, keepdims=True)
    return points, np.column_stack([along[:, 1], -along[:, 0]])


def _colour_match(
    image: ImageArray, board: Homography, inner_mm: FloatArray
) -> NDArray[np.float32]:
    """Return (h, w) similarity of each pixel to the colour of the piece, 0..1."""
    mask = np.zeros(image.shape[:2], dtype=np.uint8)
    cv2.fillPoly(mask, [np.rint(board.to_px(inner_mm)).astype(np.int32)], 1)
    colours = image[mask.astype(bool)].astype(np.float32)
    if not len(colours):
        return np.zeros(image.shape[:2], dtype=np.float32)
    middle = np.median(colours, axis=0)
    usual = np.median(np.linalg.norm(colours - middle, axis=1))
    spread = max(3.0 * float(usual), MIN_COLOUR_SPREAD)
    apart = np.linalg.norm(image.astype(np.float32) - middle.astype(np.float32), axis=2)
    return np.asarray(np.clip(1.5 - 0.5 * apart / spread, 0.0, 1.0), dtype=np.float32)


def _fit(
    like: NDArray[np.float32],
    board: Homography,
    rim: FloatArray,
    outward: FloatArray,
    at: FloatArray,
    reach_mm: float,
) -> tuple[FloatArray, float] | None:
    """Return the step (2,) to the observed edges, and its standard uncertainty per axis."""
    steps = np.arange(-reach_mm, reach_mm + STEP_MM / 2, STEP_MM)
    place = rim + at
    front = board.to_px(place + outward) - board.to_px(place)
    shown = front[:, 1] > FRONT_SHARE * np.linalg.norm(front, axis=1)
    place, normal = place[shown], outward[shown]
    if len(place) < MIN_EDGE_POINTS:
        return None
    lines = place[:, None] + steps[None, :, None] * normal[:, None]
    px = board.to_px(lines.reshape(-1, 2)).astype(np.float32).reshape(len(place), len(steps), 2)
    profile = np.asarray(cv2.remap(like, px[..., 0], px[..., 1], cv2.INTER_LINEAR), np.float64)
    edge = _edges(profile, steps)
    known = np.isfinite(edge)
    return _solve(normal[known], edge[known])


def _is_upright(
    like: NDArray[np.float32], board: Homography, rim: FloatArray, outward: FloatArray
) -> bool:
    """Return True if the piece extends behind its far rim; a flat face does not."""
    out = board.to_px(rim + BEHIND_MM * outward)
    far = (out - board.to_px(rim))[:, 1]
    behind = out[far <= np.quantile(far, 0.25)].astype(np.float32)
    seen = cv2.remap(like, behind[:, :1], behind[:, 1:], cv2.INTER_LINEAR)
    return bool((np.asarray(seen) >= 0.5).mean() >= MIN_BEHIND_SHARE)


def _edges(profile: FloatArray, steps: FloatArray) -> FloatArray:
    """Return (n,) last exit of each profile from the piece, NaN if there is none."""
    inside = profile >= 0.5
    last = inside.shape[1] - 1 - np.argmax(inside[:, ::-1], axis=1)
    good = inside.any(axis=1) & (last < inside.shape[1] - 1)
    row, last = np.arange(len(profile)), np.minimum(last, inside.shape[1] - 2)
    here, after = profile[row, last], profile[row, last + 1]
    part = (here - 0.5) / np.where(here > after, here - after, 1.0)
    return np.where(good, steps[last] + part * STEP_MM, np.nan)


def _solve(normal: FloatArray, edge: FloatArray) -> tuple[FloatArray, float] | None:
    """Return the least-squares step for edges (n,) along normals (n, 2) without outliers."""
    step: FloatArray = np.zeros(2)
    kept = np.ones(len(edge), dtype=bool)
    for _ in range(3):
        if int(kept.sum()) < MIN_EDGE_POINTS:
            return None
        step = np.asarray(np.linalg.lstsq(normal[kept], edge[kept], rcond=None)[0], np.float64)
        rest = np.abs(edge - normal @ step)
        kept = rest <= max(3.0 * float(np.median(rest)), MAX_EDGE_ERROR_MM)
    weight = normal[kept].T @ normal[kept]
    if not np.linalg.cond(weight) < 1e3:
        return None
    rms = float(np.sqrt((rest[kept] ** 2).mean()))
    return step, rms * math.sqrt(float(np.trace(np.linalg.inv(weight))) / 2)

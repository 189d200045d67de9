"""Rendered picture of the scene camera: board with dots, tower, and the piece above it.

A pinhole camera without distortion; bodies are drawn as prisms, with their holes; fingers and arm
are left out.
"""

from __future__ import annotations

import cv2
import numpy as np

from touchdown.backend import geometry
from touchdown.backend.core import FloatArray, ImageArray
from touchdown.backend.simulation.ground_truth import Scene

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 640, 480, 760.0
EYE_MM = np.array([-70.0, -130.0, 150.0])
LOOKS_AT_MM = np.array([0.0, 0.0, 4.0])
BOARD_MM = 60.0
TABLE, BOARD, DOT = (60, 56, 52), (148, 152, 150), (255, 0, 255)
BOTTOM, PIECE = (96, 120, 178), (168, 132, 84)
SHADE = 0.72
FRACTION_BITS = 4  # corners are drawn to 1/16 px


def camera_matrix() -> FloatArray:
    """Return the (3, 4) projection of bench mm to px."""
    ahead = LOOKS_AT_MM - EYE_MM
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right = right / np.linalg.norm(right)
    turn = np.stack([right, np.cross(ahead, right), ahead])
    inner = np.array(
        [[FOCAL_PX, 0.0, 0.5 * WIDTH_PX], [0.0, FOCAL_PX, 0.5 * HEIGHT_PX], [0.0, 0.0, 1.0]]
    )
    return np.asarray(inner @ np.column_stack([turn, -turn @ EYE_MM]))


def render_scene(
    scene: Scene, offset_mm: tuple[float, float], yaw_rad: float, height_mm: float
) -> ImageArray:
    """Return (480, 640, 3) BGR with the face at ``offset_mm`` and ``height_mm``."""
    image = np.full((HEIGHT_PX, WIDTH_PX, 3), TABLE, dtype=np.uint8)
    _board(image)
    top = scene.bottoms.bodies[-1]
    base_mm = 0.0
    for body in reversed(scene.bottoms.bodies):
        base_mm -= body.height_mm
    for body in scene.bottoms.bodies:
        at_mm = (body.at_mm[0] - top.at_mm[0], body.at_mm[1] - top.at_mm[1])
        upper = body.upper or body.lower
        if body.fixed:
            # A face on the board itself; its body is below.
            _fill(image, _placed(upper, at_mm, 0.0), 0.0, BOTTOM)
            continue
        _prism(image, (_placed(body.lower, at_mm, 0.0), base_mm),
               (_placed(upper, at_mm, 0.0), base_mm + body.height_mm), BOTTOM)  # fmt: skip
        base_mm += body.height_mm
    piece = scene.piece
    upper = piece.upper or piece.lower
    _prism(image, (_placed(piece.face, offset_mm, yaw_rad), height_mm),
           (_placed(upper, offset_mm, yaw_rad), height_mm + piece.height_mm), PIECE)  # fmt: skip
    return image


def _board(image: ImageArray) -> None:
    """Draw board and dots in the plane of the touched face."""
    corners = BOARD_MM * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    _fill(image, corners, 0.0, BOARD)
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    ring = geometry.BOARD_DOT_RADIUS_MM * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    for dot in geometry.BOARD_DOTS_MM:
        _fill(image, dot + ring, 0.0, DOT)


def _placed(outline: geometry.Outline, at_mm: tuple[float, float], yaw_rad: float) -> FloatArray:
    return np.asarray(geometry.rotated(outline.path(64), yaw_rad) + at_mm)


def _prism(
    image: ImageArray,
    low: tuple[FloatArray, float],
    high: tuple[FloatArray, float],
    colour: tuple[int, int, int],
) -> None:
    """Draw the silhouette between two outlines, and the upper one lighter on top.

    The sides of ends with holes, notches or several parts are drawn one by one.
    """
    shade = (int(SHADE * colour[0]), int(SHADE * colour[1]), int(SHADE * colour[2]))
    lows, highs = (geometry.rings_of(_px(*end)) for end in (low, high))
    convex = len(lows) == 1 and cv2.isContourConvex(lows[0].astype(np.float32))
    if not convex and [len(ring) for ring in lows] == [len(ring) for ring in highs]:
        for foot, head in zip(lows, highs, strict=True):
            around = np.arange(len(foot)) - 1
            for side in np.stack([foot, foot[around], head[around], head], axis=1):
                _paint(image, [side], shade)
        _fill(image, *low, shade)
    else:
        both = np.concatenate([*lows, *highs]).astype(np.float32)
        _paint(image, [cv2.convexHull(both).reshape(-1, 2).astype(np.float64)], shade)
    _fill(image, *high, colour)


def _fill(
    image: ImageArray, outline_mm: FloatArray, z_mm: float, colour: tuple[int, int, int]
) -> None:
    _paint(image, geometry.rings_of(_px(outline_mm, z_mm)), colour)


def _px(outline_mm: FloatArray, z_mm: float) -> FloatArray:
    """Return (n, 2) px of an outline (n, 2) at height ``z_mm``; rows of NaN stay."""
    count = len(outline_mm)
    points = np.column_stack([outline_mm, np.full(count, z_mm), np.ones(count)])
    mapped = points @ camera_matrix().T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def _paint(image: ImageArray, rings_px: list[FloatArray], colour: tuple[int, int, int]) -> None:
    """Fill the rings (k, 2) by the odd-even rule."""
    fixed = [np.rint(ring * (1 << FRACTION_BITS)).astype(np.int32) for ring in rings_px]
    cv2.fillPoly(image, [f.reshape(-1, 1, 2) for f in fixed], colour, cv2.LINE_8, FRACTION_BITS)

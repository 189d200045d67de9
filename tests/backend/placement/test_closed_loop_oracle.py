"""With a perfect estimator the loop of belief, stability and policy must nearly always place.

The truth is shapely's, not the product's: a failure here is a bug in the logic, not in a model.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from shapely import contains_xy
from shapely.affinity import translate
from shapely.geometry import Point, Polygon, box

from touchdown.backend.config.method import StackSettings
from touchdown.backend.core.values import ContactPatch
from touchdown.backend.placement.strategies import GraspedPiece, PaperStrategy, ProbeObservation
from touchdown.backend.placement.support_tower import XY

FACE_RADIUS_MM = {"mushroom": 12.7, "barrel": 10.6, "pot": 7.5, "mug": 10.0}
COM_MM = {"mug": (1.7, -0.9)}
"""Of the others the centre of mass is over the middle of the face."""
BOTTOMS = {
    "short": Point(0, 0).buffer(10.0, 64),
    "long": Point(0, 0).buffer(9.0, 64),
    "circle15": Point(0, 0).buffer(7.5, 64),
    "circle25": Point(0, 0).buffer(12.5, 64),
    "square15": box(-7.5, -7.5, 7.5, 7.5),
    "hex20": Polygon(
        [(10 * math.cos(a * math.pi / 3), 10 * math.sin(a * math.pi / 3)) for a in range(6)]
    ),
    "rect12x28": box(-6, -14, 6, 14),
}


def lattice(radius_mm: float) -> np.ndarray:
    axis = np.arange(-20.0, 21.0)
    points = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return points[np.hypot(points[:, 0], points[:, 1]) <= radius_mm + 1e-9]


def exact_margin_mm(piece: str, bottom: Polygon, at: XY) -> float:
    face = translate(Point(0, 0).buffer(FACE_RADIUS_MM[piece], 64), *at)
    support = face.intersection(bottom)
    if support.area < 1e-6:
        return -math.inf
    com = COM_MM.get(piece, (0.0, 0.0))
    hull, centre = support.convex_hull, Point(at[0] + com[0], at[1] + com[1])
    distance = hull.exterior.distance(centre)
    return distance if hull.contains(centre) else -distance


def random_start(rng: np.random.Generator, piece: str, bottom: Polygon) -> XY:
    """A start as the issue draws it: overlap at least 6 mm², margin at most -0.2 mm."""
    radius_mm = FACE_RADIUS_MM[piece]
    reach = radius_mm + 14.0
    while True:
        x, y = rng.uniform(-reach, reach, 2)
        face = translate(Point(0, 0).buffer(radius_mm, 64), x, y)
        overlap = face.intersection(bottom).area
        if overlap >= 6.0 and exact_margin_mm(piece, bottom, (x, y)) <= -0.2:
            return float(x), float(y)


def run_once(
    piece: str, bottom: str, rng: np.random.Generator, settings: StackSettings
) -> tuple[str, int, float]:
    """Return how the loop ended, its probes, and the exact margin at the end."""
    shape = BOTTOMS[bottom]
    here = random_start(rng, piece, shape)
    face = lattice(FACE_RADIUS_MM[piece])
    reasoner = PaperStrategy(GraspedPiece(COM_MM.get(piece, (0.0, 0.0)), 30.0), settings, here)
    unread = np.zeros((20, 258), np.float32)
    for probe in range(1, settings.policy.max_probes + 2):
        truth = contains_xy(shape, face[:, 0] + here[0], face[:, 1] + here[1])
        patch = ContactPatch(face.copy(), truth.astype(np.float64))
        action = reasoner.conclude(ProbeObservation(unread, patch, here)).action
        if action.kind != "shift":
            return action.kind, probe, exact_margin_mm(piece, shape, here)
        assert math.hypot(*action.step_mm) <= settings.policy.longest_step_mm + 1e-9
        here = (here[0] + action.step_mm[0], here[1] + action.step_mm[1])
    raise AssertionError("the loop does not end")


@pytest.mark.parametrize("piece", FACE_RADIUS_MM)
def test_perfect_estimates_place(piece: str) -> None:
    rng = np.random.default_rng(7)
    starts = 15
    endings = [
        run_once(piece, bottom, rng, StackSettings()) for bottom in BOTTOMS for _ in range(starts)
    ]
    placed = [e for e in endings if e[0] == "release"]
    assert all(margin >= -0.5 for _, _, margin in placed)
    assert len(placed) >= 0.99 * len(endings), [e for e in endings if e[0] != "release"]

"""Exact static analysis of a stack of rigid bodies.

At every interface k the weighted centre of mass of all bodies above must lie inside the convex hull
of the overlap of the faces that meet there; for k = 0 inside the hull of the base of the lowest
body. The condition is necessary and sufficient for a serial stack under gravity with enough
friction. A ring is thus stable over its hole. Only the topmost body can rest on a face that is not
flat (``surfaces``).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf

import numpy as np

from touchdown.backend.core import FloatArray, InputError
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import Outline, Point, rotated
from touchdown.backend.geometry.surfaces import FLAT, PieceOnSurface, Surface

TOO_CLOSE_MM = 0.2  # smaller margins are displayed but not scored


@dataclass(frozen=True, slots=True)
class Body:
    """One placed body. ``lower`` and ``upper``: its ends; ``upper`` None carries nothing.

    ``at_mm``: centre of its faces in the frame of the tower; ``yaw_rad``: rotation about it.
    ``com_xy_mm`` is in the body's own frame. A ``fixed`` body cannot move. ``surface``: heights of
    the upper end; the lower end is flat.
    """

    name: str
    lower: Outline
    upper: Outline | None
    height_mm: float
    mass_g: float
    com_height_mm: float
    com_xy_mm: Point = (0.0, 0.0)
    at_mm: Point = (0.0, 0.0)
    yaw_rad: float = 0.0
    fixed: bool = False
    surface: Surface = FLAT

    @property
    def centre_mm(self) -> FloatArray:
        """(2,) projection of its centre of mass in the frame of the tower."""
        own = rotated(np.asarray(self.com_xy_mm, dtype=np.float64), self.yaw_rad)
        return np.asarray(own + np.asarray(self.at_mm, dtype=np.float64), dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Tower:
    """Bodies from the lowest up.

    Raises ``InputError`` if a body above the lowest is fixed, or one below the topmost has no upper
    face; ValueError without bodies.
    """

    bodies: tuple[Body, ...]

    def __post_init__(self) -> None:
        if not self.bodies:
            raise ValueError("a tower needs a body")
        for below, body in pairwise(self.bodies):
            where = f"{body.name} on {below.name}"
            if body.fixed:
                what = f"'{body.name}' is fixed to the table: nothing can lie below it."
                fix = "Put it lowest."
                raise InputError(what, where, fix)
            if below.upper is None:
                what = f"'{below.name}' carries nothing: it has no flat upper end."
                fix = "Choose another piece below."
                raise InputError(what, where, fix)
        for body in self.bodies[:-2]:
            if not body.surface.flat:
                what = f"'{body.name}' is not flat: only the held piece can be put on it."
                fix = "Choose a flat bottom below others."
                raise InputError(what, f"tower on {body.name}", fix)

    def with_top(self, body: Body) -> Tower:
        """Return the tower with one more body on top."""
        return Tower((*self.bodies, body))


@dataclass(frozen=True, slots=True)
class TowerVerdict:
    """Signed margin of each interface, lowest first.

    ``inf`` under a fixed body, ``-inf`` if two faces do not overlap.
    """

    margins_mm: tuple[float, ...]

    @property
    def margin_mm(self) -> float:
        """The smallest margin, which decides."""
        return min(self.margins_mm)

    @property
    def stands(self) -> bool:
        """True if the stack stands."""
        return self.margin_mm > 0.0


def judge_tower(
    tower: Tower, disturbance_mm: Point = (0.0, 0.0), mu: float = inf, *, sign_only: bool = False
) -> TowerVerdict:
    """Return the margin of each interface of ``tower``.

    ``disturbance_mm``: effect of the opening fingers, as a shift of the top body's centre of mass.
    ``mu``: friction of a face that is not flat. ``sign_only``: the margin on such a face, whose
    search takes time, is infinite.
    """
    bodies = tower.bodies
    masses = np.array([body.mass_g for body in bodies])
    centres = np.array([body.centre_mm for body in bodies])
    centres[-1] += disturbance_mm
    resting_mm, shift_mm = _rest_on_surface(tower, centres[-1], mu, sign_only=sign_only)
    centres[-1] += shift_mm
    margins: list[float] = []
    for k, body in enumerate(bodies):
        if body.fixed:
            margins.append(float("inf"))
            continue
        if resting_mm is not None and k == len(bodies) - 1:
            margins.append(resting_mm)
            continue
        load = masses[k:] @ centres[k:] / masses[k:].sum()
        margins.append(float(outlines.signed_distances_mm(load, interface_overlap(tower, k))))
    return TowerVerdict(tuple(margins))


def _rest_on_surface(
    tower: Tower, centre_mm: FloatArray, mu: float, *, sign_only: bool
) -> tuple[float | None, FloatArray]:
    """Return how the topmost body rests on a face that is not flat.

    ``centre_mm`` (2,): its centre of mass while upright. Returns the margin, None on a flat face,
    and the motion (2,) of the centre of mass on the way to rest, zero if it does not rest.
    """
    if len(tower.bodies) < 2 or tower.bodies[-2].surface.flat:
        return None, np.zeros(2)
    below, body = tower.bodies[-2:]
    placed = piece_on_surface(tower, mu)
    own = rotated(centre_mm - np.asarray(below.at_mm), -below.yaw_rad)
    slope = placed.rest_slope(own)
    shift = np.zeros(2) if slope is None else -body.com_height_mm * rotated(slope, below.yaw_rad)
    if sign_only:
        return (-inf if slope is None else inf), shift
    return placed.margin_mm(own), shift


def piece_on_surface(tower: Tower, mu: float = inf) -> PieceOnSurface:
    """Return the topmost body of a tower over the face below it, in the frame of that face."""
    below, body = tower.bodies[-2:]
    assert below.upper is not None
    x, y = rotated(np.subtract(body.at_mm, below.at_mm), -below.yaw_rad).tolist()
    turn = body.yaw_rad - below.yaw_rad
    return PieceOnSurface.over(
        body.lower, (x, y), turn, below.upper, below.surface, body.com_height_mm, mu
    )


def interface_overlap(tower: Tower, k: int) -> outlines.EdgeSegments:
    """Return the edge of the hull of the overlap under body ``k`` (its own base for k = 0)."""
    body = tower.bodies[k]
    below = tower.bodies[k - 1] if k else None
    if below is None or below.upper is None:
        return outlines.polygon_edges(body.lower.placed(body.at_mm, body.yaw_rad))
    return outlines.contact_edges(
        body.lower, body.at_mm, body.yaw_rad, below.upper, below.at_mm, below.yaw_rad
    )

"""Exact static analysis of a stack of flat-faced rigid bodies.

At every interface k the weighted centre of mass of all bodies above must lie inside the convex hull
of the overlap of the faces that meet there; for k = 0 inside the hull of the base of the lowest
body. The condition is necessary and sufficient for a serial stack under gravity with enough
friction. A ring is thus stable over its hole.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from touchdown.backend.core import FloatArray, InputError
from touchdown.backend.geometry import outlines
from touchdown.backend.geometry.outlines import Outline, Point, rotated

TOO_CLOSE_MM = 0.2  # smaller margins are displayed but not scored

FLOOR = "table"


@dataclass(frozen=True, slots=True)
class Body:
    """One placed body. ``lower`` and ``upper``: its flat ends; ``upper`` None carries nothing.

    ``at_mm``: centre of its faces in the frame of the tower; ``yaw_rad``: rotation about it.
    ``com_xy_mm`` is in the body's own frame. A ``fixed`` body cannot move.
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
                raise InputError(
                    f"'{body.name}' is fixed to the table: nothing can lie below it.",
                    where,
                    "Put it lowest.",
                )
            if below.upper is None:
                raise InputError(
                    f"'{below.name}' carries nothing: it has no flat upper end.",
                    where,
                    "Choose another piece below.",
                )

    def with_top(self, body: Body) -> Tower:
        """Return the tower with one more body on top."""
        return Tower((*self.bodies, body))


@dataclass(frozen=True, slots=True)
class TowerVerdict:
    """Signed margin of each interface, lowest first.

    ``inf`` under a fixed body, ``-inf`` if two faces do not overlap. ``interfaces``: their names.
    """

    margins_mm: tuple[float, ...]
    interfaces: tuple[str, ...]

    @property
    def margin_mm(self) -> float:
        """The smallest margin, which decides."""
        return min(self.margins_mm)

    @property
    def weakest(self) -> str:
        """The interface with the smallest margin, such as "pot on short"."""
        return self.interfaces[self.margins_mm.index(self.margin_mm)]

    @property
    def stands(self) -> bool:
        """True if the stack stands."""
        return self.margin_mm > 0.0

    @property
    def too_close(self) -> bool:
        """True if the margin is too small to be scored either way."""
        return abs(self.margin_mm) < TOO_CLOSE_MM


def judge_tower(tower: Tower, disturbance_mm: Point = (0.0, 0.0)) -> TowerVerdict:
    """Return the margin of each interface of ``tower``.

    ``disturbance_mm``: effect of the opening fingers, as a shift of the top body's centre of mass.
    """
    bodies = tower.bodies
    masses = np.array([body.mass_g for body in bodies])
    centres = np.array([body.centre_mm for body in bodies])
    centres[-1] += disturbance_mm
    margins: list[float] = []
    names: list[str] = []
    for k, body in enumerate(bodies):
        below = bodies[k - 1].name if k else FLOOR
        names.append(f"{body.name} on {below}")
        if body.fixed:
            margins.append(float("inf"))
            continue
        load = masses[k:] @ centres[k:] / masses[k:].sum()
        margins.append(float(outlines.signed_distances_mm(load, interface_overlap(tower, k))))
    return TowerVerdict(tuple(margins), tuple(names))


def interface_overlap(tower: Tower, k: int) -> outlines.EdgeSegments:
    """Return the edge of the hull of the overlap under body ``k`` (its own base for k = 0)."""
    body = tower.bodies[k]
    below = tower.bodies[k - 1] if k else None
    if below is None or below.upper is None:
        return outlines.polygon_edges(body.lower.placed(body.at_mm, body.yaw_rad))
    return outlines.contact_edges(
        body.lower, body.at_mm, body.yaw_rad, below.upper, below.at_mm, below.yaw_rad
    )

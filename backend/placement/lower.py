"""The interfaces below the touched one, as learned fusion counts them.

Its network says how far points lie within the touched face. Where the middle of that face is
follows from many points at once; the tower that was entered stands below that middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi, sqrt

import numpy as np

from backend.core.flow import FloatArray
from backend.learning.fused.forward import Inset
from backend.objects.shapes import Outline, circle, inset_mm
from backend.placement.below import Below, normal_draws

XY = tuple[float, float]
AROUND_MM = 10.0
"""The middle is looked for so far around the point that is expected to lie deepest."""
EDGE_MM = 4.0
"""Points so near the edge tell by how much the middle may be off: their inset moves with it."""
NUDGE_MM = 0.05
REFINED = 4
LEAST_SD_MM = 0.3
"""Nothing is trusted to be nearer than this."""


@dataclass(frozen=True, slots=True)
class Middle:
    """The middle of the touched face, ``at_mm``, known within ``sigma_mm`` along x and along y."""

    at_mm: XY
    sigma_mm: float

    def standing(self, face_mm: XY) -> str:
        """Say where the piece will stand: what an entry needs when the next one comes on top."""
        x, y = np.subtract(face_mm, self.at_mm)
        return f"It stands {x:+.1f}, {y:+.1f} mm from the middle, sigma {self.sigma_mm:.1f} mm."

    def drawn(self) -> FloatArray:
        """Return (k, 2) places where it may be, spread evenly: the same ones every time."""
        return np.asarray(np.asarray(self.at_mm) + self.sigma_mm * normal_draws(1)[:, 0])


@dataclass(frozen=True, slots=True)
class Lower:
    """What ``below`` leaves, wherever its uppermost face has its middle."""

    below: Below
    middle: Middle

    def insets_mm(self, points_mm: FloatArray) -> FloatArray:
        """Return (k, n): how far within the weakest support below the load lies, for each draw.

        ``points_mm`` (n, 2): the piece's centre of mass, in the frame of the middle.
        """
        relative = points_mm - self.middle.drawn()[:, None]
        return self.below.insets_mm(relative).reshape(-1, len(points_mm))


def holding(top: Inset, lower: Lower | None, centre_mm: XY, least_mm: FloatArray) -> FloatArray:
    """Return (n,) how likely the load lies more than each of ``least_mm`` (n,) within all supports.

    ``top``: how far the centre of mass, at ``centre_mm``, lies within the touched face. With a
    ``lower`` part at least so likely, whatever the interfaces have in common: ways to fall add up.
    """
    repeated = Inset(*(np.repeat(part, len(least_mm), axis=0) for part in top.parts()))
    reached = repeated.exceeds(least_mm)
    if lower is None:
        return reached
    insets = np.sort(lower.insets_mm(np.array([centre_mm])).ravel())
    falls = np.searchsorted(insets, least_mm, side="right") / len(insets)
    return np.asarray(np.maximum(reached - falls, 0.0), dtype=np.float64)


def middle_of(over: Inset, points_mm: FloatArray, face: Outline) -> Middle:
    """Return where the middle of the touched ``face`` is, from insets ``over`` points (n, 2) in mm.

    The middle fits the expected insets best; how much they vary near the edge tells how well it is
    known.
    """
    expected, variance = over.expected_mm(), over.variance_mm2()
    weight = 1.0 / np.maximum(variance, LEAST_SD_MM**2)
    start = points_mm[int(expected.argmax())]
    steps = np.arange(-AROUND_MM, AROUND_MM + 1.0)
    around = start + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    misfit = (inset_mm(face, points_mm - around[:, None]) - expected) ** 2 @ weight
    at = around[int(np.argmin(misfit))]
    for _ in range(REFINED):
        slope = _slope(face, points_mm - at)
        off = expected - inset_mm(face, points_mm - at)
        normal = (slope * weight[:, None]).T @ slope + LEAST_SD_MM**2 * np.eye(2)
        at = at + np.linalg.solve(normal, (slope * weight[:, None]).T @ off)
    inset = inset_mm(face, points_mm - at)
    near = np.abs(inset) <= EDGE_MM
    varies = (variance + (expected - inset) ** 2)[near]
    sigma_mm = sqrt(float(varies.mean())) if near.any() else AROUND_MM
    return Middle((float(at[0]), float(at[1])), max(sigma_mm, LEAST_SD_MM))


def _slope(face: Outline, relative: FloatArray) -> FloatArray:
    """Return (n, 2): by how much the inset grows as the middle moves along x and along y."""
    moved = [NUDGE_MM * np.eye(2)[axis] for axis in range(2)]
    ways = [inset_mm(face, relative - m) - inset_mm(face, relative + m) for m in moved]
    return np.asarray(np.stack(ways, axis=-1) / (2.0 * NUDGE_MM), dtype=np.float64)


def disc_of(over: Inset, cell_mm2: float) -> Outline:
    """Return a disc as large as the cells of ``over`` that rather lie within the touched face."""
    within = float((over.expected_mm() > 0.0).sum())
    return circle(2.0 * sqrt(max(within, 1.0) * cell_mm2 / pi))

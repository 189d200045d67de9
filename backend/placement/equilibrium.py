"""Static equilibrium of a piece on points of contact.

Convex hull of few points, signed distance to its edge, centre of pressure from the wrist wrench,
resting contact at an offset.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import FloatArray, SupportKind, read_only
from touchdown.backend.geometry import TOO_CLOSE_MM, Outline, rotated, true_patch

ON_EDGE_MM = 1e-9  # rounding tolerance of an edge

Point = tuple[float, float]


def convex_hull(points: NDArray[np.number]) -> FloatArray:
    """Return the (k, 2) counter-clockwise corners of the hull of ``points`` (n, 2).

    k is 0 for no point, 1 for one position, 2 for collinear points. No three corners are collinear.
    Exact for integer coordinates below 2**25, so the map passes cell indices rather than lengths.
    Andrew's monotone chain (Inf. Process. Lett. 9 (1979) 216).
    """
    chain = _column_ends(np.asarray(points, dtype=np.float64).reshape(-1, 2))
    if len(chain) < 3:
        return np.array(chain, dtype=np.float64).reshape(-1, 2)
    lower = _half(chain)
    upper = _half(chain[::-1])
    return np.array(lower[:-1] + upper[:-1], dtype=np.float64)


def signed_margin_mm(hull: FloatArray, point: Point) -> float:
    """Return the signed distance of ``point`` to the edge of ``hull``, positive inside.

    ``hull`` (k, 2) is counter-clockwise. A point or line has no inside, so the result is never
    positive. Returns -inf without support (k = 0).
    """
    if not len(hull):
        return -math.inf
    start = hull
    edge = np.roll(hull, -1, axis=0) - start
    to_point = np.asarray(point, dtype=np.float64) - start
    squared = np.maximum((edge**2).sum(axis=1), np.finfo(np.float64).tiny)
    along = np.clip((to_point * edge).sum(axis=1) / squared, 0.0, 1.0)
    nearest = to_point - along[:, None] * edge
    distance = float(np.hypot(nearest[:, 0], nearest[:, 1]).min())
    if len(hull) < 3:
        return -distance
    left_of = edge[:, 0] * to_point[:, 1] - edge[:, 1] * to_point[:, 0]
    return distance if bool((left_of >= 0).all()) else -distance


def inside_hull(hull: FloatArray, points: FloatArray) -> NDArray[np.bool_]:
    """Return True for ``points`` (..., 2) in the hull or on its edge.

    ``hull`` (k, 2) counter-clockwise with k >= 3; all False for a smaller hull.
    """
    if len(hull) < 3:
        return np.zeros(points.shape[:-1], dtype=np.bool_)
    edge = np.roll(hull, -1, axis=0) - hull
    normal = np.stack((edge[:, 1], -edge[:, 0])) / np.hypot(edge[:, 0], edge[:, 1])
    reach = (hull * normal.T).sum(axis=1)
    return np.asarray((points @ normal <= reach + ON_EDGE_MM).all(axis=-1), dtype=np.bool_)


def _column_ends(points: FloatArray) -> list[Point]:
    """Sort by x, then y, and keep the two ends of each column, which contain all corners."""
    if not len(points):
        return []
    ordered = points[np.lexsort((points[:, 1], points[:, 0]))]
    new_column = np.concatenate(([True], ordered[1:, 0] != ordered[:-1, 0]))
    ends = new_column | np.concatenate((new_column[1:], [True]))
    kept = ordered[ends]
    distinct = np.concatenate(([True], (kept[1:] != kept[:-1]).any(axis=1)))
    return [(float(x), float(y)) for x, y in kept[distinct]]


def _half(chain: Sequence[Point]) -> list[Point]:
    """Return one chain of the hull, with left turns only."""
    half: list[Point] = []
    for point in chain:
        while len(half) >= 2 and _turn(half[-2], half[-1], point) <= 0:
            half.pop()
        half.append(point)
    return half


def _turn(a: Point, b: Point, c: Point) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def support_kind(hull: FloatArray) -> SupportKind:
    """Return the kind of support of a ``hull`` (k, 2): none, point, line or area."""
    kinds = (SupportKind.NONE, SupportKind.POINT, SupportKind.LINE, SupportKind.AREA)
    return kinds[min(len(hull), 3)]


@dataclass(frozen=True, slots=True)
class RestingContact:
    """Contact of the face at one offset, in the bottom frame ``O``.

    ``points_mm`` (N, 2) and ``touching`` (N,): lattice of the face; ``hull_mm`` (k, 2) of the
    points in contact, counter-clockwise; ``centre_mm``: centre of mass; ``margin_mm``: signed,
    positive inside the hull, ``-inf`` without contact.
    """

    points_mm: FloatArray
    touching: NDArray[np.bool_]
    hull_mm: FloatArray
    centre_mm: tuple[float, float]
    margin_mm: float
    support: SupportKind

    def __post_init__(self) -> None:
        for array in (self.points_mm, self.touching, self.hull_mm):
            read_only(array)

    @property
    def stable(self) -> bool:
        """True if the centre of mass lies inside the hull or on its edge."""
        return self.support is SupportKind.AREA and self.margin_mm >= 0

    @property
    def too_close(self) -> bool:
        """True if the margin is too small for a verdict."""
        return abs(self.margin_mm) < TOO_CLOSE_MM


def resting_contact(
    points_mm: FloatArray,
    com_xy_mm: tuple[float, float],
    bottom: Outline,
    offset_mm: tuple[float, float],
    yaw_rad: float = 0.0,
) -> RestingContact:
    """Return the contact of a face on a bottom.

    Parameters
    ----------
    points_mm : ndarray, shape (N, 2)
        Lattice of the face in frame ``F``.
    com_xy_mm : tuple of float
        Centre of mass in frame ``F``.
    bottom : Outline
        Bottom face, centred at the origin of frame ``O``.
    offset_mm : tuple of float
        Offset of the face in frame ``O``.
    yaw_rad : float
        Rotation of the face, counter-clockwise.

    Returns
    -------
    RestingContact
        Contact points, hull and margin in frame ``O``.

    Raises
    ------
    ValueError
        If offset or rotation are not finite.

    Examples
    --------
    >>> from touchdown.backend.geometry import circle, face_points
    >>> face, bottom = circle(20.0), circle(30.0)
    >>> resting_contact(face_points(face), (0.0, 0.0), bottom, (8.0, 0.0)).stable
    True
    >>> resting_contact(face_points(face), (0.0, 0.0), bottom, (18.0, 0.0)).stable
    False

    """
    if not all(map(math.isfinite, (*offset_mm, yaw_rad))):
        raise ValueError("the displacement is not finite")
    touching = true_patch(points_mm, offset_mm, bottom, yaw_rad)
    shift = np.asarray(offset_mm)
    hull = rotated(convex_hull(points_mm[touching]), yaw_rad) + shift
    centre = rotated(np.asarray([com_xy_mm], dtype=np.float64), yaw_rad)[0] + shift
    at = (float(centre[0]), float(centre[1]))
    support = support_kind(hull)
    placed = rotated(points_mm, yaw_rad) + shift
    return RestingContact(placed, touching, hull, at, signed_margin_mm(hull, at), support)


# Below this press force the quotient is noise (F/T offset 0.2 N) and the centre is NaN.
LEAST_PRESS_N = 0.5
FIRST_TICK, LAST_TICKS = 0, slice(-4, None)
LEAST_RISE_N = 2.0  # smallest increase of the press force for a centre of pressure


def centre_of_pressure_mm(
    wrench: FloatArray, lever_mm: float, least_press_n: float = LEAST_PRESS_N
) -> FloatArray:
    """Return the centre of pressure in the face plane, (..., 2) mm from the axis through ``G``.

    ``wrench`` (..., 6) in N and N·m at the sensor, tared; ``lever_mm`` is the height of the sensor
    above the face (grip height + sensor above ``G``). The lateral forces act on that lever and
    must be taken out (method 14, item 3; bench-physics 4):

        x = -(Ty + h Fx) / Fz,   y = (Tx - h Fy) / Fz

    NaN where the piece is not pressed by at least ``least_press_n``.
    """
    fx, fy, fz = wrench[..., 0], wrench[..., 1], wrench[..., 2]
    tx_nmm, ty_nmm = 1e3 * wrench[..., 3], 1e3 * wrench[..., 4]
    press = np.where(fz >= least_press_n, fz, np.nan)
    x = -(ty_nmm + lever_mm * fx) / press
    y = (tx_nmm - lever_mm * fy) / press
    return np.stack((x, y), axis=-1)


def pressed_at_mm(wrench: FloatArray, lever_mm: float) -> FloatArray:
    """Return (2,) the centre of pressure of a press in ``F``, without slow sensor errors.

    ``wrench`` (20, 6) in N and N·m at the sensor, ``lever_mm`` above the face. The offset left by
    the tare (several mm of centre) is the same at all ticks; the increase from the first tick to
    the last ones does not contain it. NaN if the force hardly increases.
    """
    growth = wrench[LAST_TICKS].mean(axis=0) - wrench[FIRST_TICK]
    return centre_of_pressure_mm(growth, lever_mm, LEAST_RISE_N)

"""Face contact: elastic foundation on the true overlap, sliders with memory for friction.

Source: bench reference 3.3 and 3.4. With the constant height r_z of the face below the pivot the
six motions q act on the face through three in the plane (p, t, rotation about z) and three out of
it (q_z, rot_x, rot_y); all sums over cells are moments of {1, x, y, x², xy, y²}.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray

TINY = 1e-12


@dataclass(frozen=True, slots=True)
class Cells:
    """Overlap cells of B probes, packed to the widest of them (n), absent ones with area 0.

    ``x``, ``y`` (B, n): lever arms r_x, r_y from the pivot, mm; ``gap_mm`` z0 (B, n);
    ``normal``, ``tangential`` (B, n): stiffness k a in N/mm; ``basis`` (B, n, 6); ``r_z`` (B,);
    ``mu`` (B, 1); ``count`` (B,): number of overlap cells.
    """

    x: FloatArray
    y: FloatArray
    gap_mm: FloatArray
    normal: FloatArray
    tangential: FloatArray
    basis: FloatArray
    r_z: FloatArray
    mu: FloatArray
    count: NDArray[np.intp]

    def take(self, index: NDArray[np.intp]) -> Cells:
        """Return the probes ``index``."""
        return Cells(
            self.x[index],
            self.y[index],
            self.gap_mm[index],
            self.normal[index],
            self.tangential[index],
            self.basis[index],
            self.r_z[index],
            self.mu[index],
            self.count[index],
        )


@dataclass(frozen=True, slots=True)
class Touch:
    """Motion (mm) and forces (N) of the cells at one trial, all (B, n); their resultant (B, 6)."""

    u_x: FloatArray
    u_y: FloatArray
    normal_n: FloatArray
    pull_x: FloatArray
    pull_y: FloatArray
    size: FloatArray
    share: FloatArray
    wrench: FloatArray

    def take(self, rows: NDArray[np.intp]) -> Touch:
        """Return the probes ``rows``."""
        return Touch(*(getattr(self, name)[rows] for name in self.__slots__))

    def put(self, rows: NDArray[np.intp], by: Touch) -> None:
        """Overwrite the probes ``rows``."""
        for name in self.__slots__:
            getattr(self, name)[rows] = getattr(by, name)


def pack(points_mm: FloatArray, inside: NDArray[np.bool_]) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Move the cells that are ``inside`` (B, N) to the front; return (B, n, 2) and which exist."""
    count = inside.sum(axis=1)
    width = max(int(count.max(initial=0)), 1)
    order = np.argsort(~inside, axis=1, kind="stable")[:, :width]
    packed = np.take_along_axis(points_mm, order[..., None], axis=1)
    return packed, np.arange(width) < count[:, None]


def surface_motion(cells: Cells, q: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return u_x, u_y, u_z (B, n) of every cell."""
    p = (q[:, 0] + q[:, 4] * cells.r_z)[:, None]
    t = (q[:, 1] - q[:, 3] * cells.r_z)[:, None]
    u_x = p - q[:, 5:6] * cells.y
    u_y = t + q[:, 5:6] * cells.x
    u_z = q[:, 2:3] + q[:, 3:4] * cells.y - q[:, 4:5] * cells.x
    return u_x, u_y, u_z


def touch(cells: Cells, anchor: FloatArray, q: FloatArray) -> Touch:
    """Return the cell forces for motion ``q`` (B, 6) with slider anchors ``anchor`` (2, B, n)."""
    u_x, u_y, u_z = surface_motion(cells, q)
    normal_n = cells.normal * np.maximum(cells.gap_mm - u_z, 0.0)
    pull_x = cells.tangential * (u_x - anchor[0])
    pull_y = cells.tangential * (u_y - anchor[1])
    size = np.sqrt(pull_x * pull_x + pull_y * pull_y)
    share = np.minimum(1.0, cells.mu * normal_n / np.maximum(size, TINY))
    forces = np.empty((len(q), 3, normal_n.shape[1]))
    np.multiply(pull_x, -share, out=forces[:, 0])
    np.multiply(pull_y, -share, out=forces[:, 1])
    forces[:, 2] = normal_n
    sums = forces @ cells.basis[:, :, :3]
    f_x, f_y, f_z = sums[:, 0, 0], sums[:, 1, 0], sums[:, 2, 0]
    wrench = np.empty((len(q), 6))
    wrench[:, 0], wrench[:, 1], wrench[:, 2] = f_x, f_y, f_z
    wrench[:, 3] = sums[:, 2, 2] - cells.r_z * f_y
    wrench[:, 4] = cells.r_z * f_x - sums[:, 2, 1]
    wrench[:, 5] = sums[:, 1, 1] - sums[:, 0, 2]
    return Touch(u_x, u_y, normal_n, pull_x, pull_y, size, share, wrench)


def tangent(cells: Cells, now: Touch) -> FloatArray:
    """Return d(wrench)/dq (B, 6, 6), the unsymmetric friction-normal coupling included."""
    slides = now.share < 1.0
    touching = now.normal_n > 0.0
    direction_x = now.pull_x / np.maximum(now.size, TINY)
    direction_y = now.pull_y / np.maximum(now.size, TINY)
    stiff = -cells.tangential * now.share
    along = np.where(slides, stiff, 0.0)
    rows = np.empty((len(cells.x), 6, cells.x.shape[1]))
    rows[:, 0] = stiff - along * direction_x * direction_x
    rows[:, 1] = -along * direction_x * direction_y
    rows[:, 2] = stiff - along * direction_y * direction_y
    coupling = np.where(slides & touching, cells.mu * cells.normal, 0.0)
    rows[:, 3] = coupling * direction_x
    rows[:, 4] = coupling * direction_y
    rows[:, 5] = np.where(touching, -cells.normal, 0.0)
    return _assemble(rows @ cells.basis, cells.r_z)


def _assemble(m: FloatArray, r_z: FloatArray) -> FloatArray:
    """Assemble the (B, 6, 6) matrix from the moments ``m`` (B, 6 rows, 6 basis functions)."""
    one, x, y, xx, xy, yy = range(6)
    d_xx, d_xy, d_yy, c_x, c_y, d_n = (m[:, k] for k in range(6))
    j = np.zeros((len(m), 6, 6))
    j[:, 0, 0], j[:, 1, 1] = d_xx[:, one], d_yy[:, one]
    j[:, 0, 1] = j[:, 1, 0] = d_xy[:, one]
    j[:, 0, 5] = j[:, 5, 0] = d_xy[:, x] - d_xx[:, y]
    j[:, 1, 5] = j[:, 5, 1] = d_yy[:, x] - d_xy[:, y]
    j[:, 5, 5] = d_xx[:, yy] - 2.0 * d_xy[:, xy] + d_yy[:, xx]
    j[:, 0, 2], j[:, 0, 3], j[:, 0, 4] = c_x[:, one], c_x[:, y], -c_x[:, x]
    j[:, 1, 2], j[:, 1, 3], j[:, 1, 4] = c_y[:, one], c_y[:, y], -c_y[:, x]
    j[:, 5, 2] = c_y[:, x] - c_x[:, y]
    j[:, 5, 3] = c_y[:, xy] - c_x[:, yy]
    j[:, 5, 4] = c_x[:, xy] - c_y[:, xx]
    j[:, 2, 2], j[:, 3, 3], j[:, 4, 4] = d_n[:, one], d_n[:, yy], d_n[:, xx]
    j[:, 2, 3] = j[:, 3, 2] = d_n[:, y]
    j[:, 2, 4] = j[:, 4, 2] = -d_n[:, x]
    j[:, 3, 4] = j[:, 4, 3] = -d_n[:, xy]
    lever = r_z[:, None]
    # From face to pivot motions: p = q_x + r_z rot_y, t = q_y - r_z rot_x
    j[:, :, 4] += lever * j[:, :, 0]
    j[:, :, 3] -= lever * j[:, :, 1]
    j[:, 4, :] += lever * j[:, 0, :]
    j[:, 3, :] -= lever * j[:, 1, :]
    return j


def moved_anchor(cells: Cells, now: Touch) -> FloatArray:
    """Return the anchors (2, B, n) after the step: dragged where sliding, free where lifted."""
    back = now.share / np.maximum(cells.tangential, TINY)
    return np.stack([now.u_x - back * now.pull_x, now.u_y - back * now.pull_y])

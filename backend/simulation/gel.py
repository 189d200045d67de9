"""Marker displacement on both pads from the elastic strain of the gel.

Source: bench reference 5. Marker order is row-major, row 0 on top and column 0 on the left of the
image as displayed; the right camera looks the other way, so that its u axis points along -X.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray


@dataclass(frozen=True, slots=True)
class Gel:
    """Linear map from pad motion to image: ``map`` (2 fingers, 4, 63 * 2) in px.

    Its four inputs are e_x (mm), e_z (mm), e_θ (rad) and N / F_g - 1. ``rest_px`` (2, 63, 2): the
    straight rest grid in the 320x240 image.
    """

    map: FloatArray
    rest_px: FloatArray

    def displacement_px(
        self, strain: FloatArray, normal_n: FloatArray, grip_force_n: FloatArray
    ) -> FloatArray:
        """Return (..., 2, 63, 2) px. ``strain`` (..., 2, 3), ``normal_n`` (..., 2).

        ``grip_force_n`` must broadcast against ``normal_n[..., 0]``.
        """
        inputs = np.concatenate(
            [strain, (normal_n / np.asarray(grip_force_n)[..., None] - 1.0)[..., None]], axis=-1
        )
        field = (inputs[..., None, :] @ self.map)[..., 0, :]
        return np.asarray(field.reshape(*strain.shape[:-1], MARKERS, 2), dtype=np.float64)


def build_gel(
    mm_per_px: tuple[float, float],
    pitch_mm: float = 1.9,
    roll_off_mm: tuple[float, float] = (7.0, 6.0),
    dilation: float = 0.01,
) -> Gel:
    """Return the gel of two sensors with image scales ``mm_per_px`` (left, right)."""
    row, column = np.divmod(np.arange(MARKERS), GRID_COLS)
    z = (GRID_ROWS // 2 - row) * pitch_mm
    maps, rests = [], []
    for scale, facing in zip(mm_per_px, (1.0, -1.0), strict=True):
        x = facing * (column - GRID_COLS // 2) * pitch_mm
        phi = np.exp(-((x / roll_off_mm[0]) ** 4) - (z / roll_off_mm[1]) ** 4)
        nothing = np.zeros(MARKERS)
        d_x = np.stack([phi, nothing, z * phi, dilation * x])
        d_z = np.stack([nothing, phi, -x * phi, dilation * z])
        maps.append(np.stack([facing * d_x, -d_z], axis=-1).reshape(4, 2 * MARKERS) / scale)
        rests.append(np.stack([160.0 + facing * x / scale, 120.0 - z / scale], axis=-1))
    return Gel(np.stack(maps), np.stack(rests))

"""Marker displacement of the second world: the gel as an elastic half-space.

Each pad is gripped over a round patch. The piece moves that patch of the surface as one; outside,
the surface follows as a half-space does (on the bench: a flat top with a steep roll-off).
Closed forms for incompressible gel: traction of a sliding punch (Johnson, Contact Mechanics,
3.7), torsion of a patch (Reissner and Sagoci), and gel pressed out sideways.
"""

from __future__ import annotations

import numpy as np

from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.simulation.gel import Gel

PATCH_MM = 5.0
"""Radius of the gripped patch [U]."""
POISSON = 0.5


def shear_field(x_mm: FloatArray, z_mm: FloatArray, patch_mm: float) -> FloatArray:
    """Return (n, 2) displacement (x, z) of the points for a patch moved by 1 along x."""
    r = np.maximum(np.hypot(x_mm, z_mm), 1e-9)
    inside = r <= patch_mm
    share = np.where(inside, 1.0, patch_mm / r)
    tail = POISSON * share * np.sqrt(1.0 - share**2)
    cos, sin = x_mm / r, z_mm / r
    scale = 2.0 / (np.pi * (2.0 - POISSON))
    along = (2.0 - POISSON) * np.arcsin(share) + tail * (cos**2 - sin**2)
    across = tail * 2.0 * cos * sin
    return np.asarray(scale * np.stack([along, across], axis=-1))


def torsion_share(r_mm: FloatArray, patch_mm: float) -> FloatArray:
    """Return (n,) rotation of the surface at the radii, for a patch turned by 1."""
    share = np.minimum(1.0, patch_mm / np.maximum(r_mm, 1e-9))
    turned = np.arcsin(share) - share * np.sqrt(1.0 - share**2)
    return np.asarray(2.0 / np.pi * turned)


def build_half_space_gel(
    mm_per_px: tuple[float, float], pitch_mm: float, dilation: float, patch_mm: float = PATCH_MM
) -> Gel:
    """Return the gel of two sensors; same inputs and marker order as ``simulation.gel``."""
    row, column = np.divmod(np.arange(MARKERS), GRID_COLS)
    z = (GRID_ROWS // 2 - row) * pitch_mm
    maps, rests = [], []
    for scale, facing in zip(mm_per_px, (1.0, -1.0), strict=True):
        x = facing * (column - GRID_COLS // 2) * pitch_mm
        along_x = shear_field(x, z, patch_mm)
        along_z = shear_field(z, x, patch_mm)[:, ::-1]
        r = np.hypot(x, z)
        turned = torsion_share(r, patch_mm)[:, None] * np.stack([z, -x], axis=-1)
        # What leaves the patch crosses every circle round it: 1/r outside.
        out = dilation * np.minimum(1.0, (patch_mm / np.maximum(r, 1e-9)) ** 2)
        pressed = out[:, None] * np.stack([x, z], axis=-1)
        field = np.stack([along_x, along_z, turned, pressed])
        to_image = np.array([facing, -1.0]) / scale
        maps.append((field * to_image).reshape(4, 2 * MARKERS))
        rests.append(np.stack([160.0 + facing * x / scale, 120.0 - z / scale], axis=-1))
    return Gel(np.stack(maps), np.stack(rests))

"""Everything one probe of the simulated bench depends on, batched over B probes."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray


@dataclass(frozen=True, slots=True)
class Conditions:
    """True physical parameters and sensor errors of B probes (leading dimension B everywhere).

    Grasp: ``shear_n_mm``, ``normal_n_mm`` (N/mm) and ``torsion_nmm`` (N·mm/rad) are those of one
    finger; ``width_mm`` between the pads; ``robot_n_mm`` (B, 3); ``grip_height_mm`` pivot above
    the face; ``grasp_offset_mm`` (B, 2) = (g_x, g_z): the face sits at commanded minus g_x.
    Contact: ``mu``, ``foundation_n_mm3``, ``tangential_n_mm3``, ``tilt_rad`` (B, 2).
    Hysteresis: ``alpha`` (0: off) and ``relax_s``. ``slips`` switches grip slip.
    Position: ``print_offset_mm`` (B, 2) of the bottom, ``label_error_mm`` (B, 2) of the arm.
    Sensors: ``gain`` (B, 2) per finger; ``bias_px`` (B, 2, 2) finger, axis; ``ft_offset`` (B, 6)
    in N and N·m.
    """

    shear_n_mm: FloatArray
    normal_n_mm: FloatArray
    torsion_nmm: FloatArray
    width_mm: FloatArray
    robot_n_mm: FloatArray
    grip_height_mm: FloatArray
    grip_force_n: FloatArray
    mu_grip: FloatArray
    limit_radius_mm: FloatArray
    slips: NDArray[np.bool_]
    grasp_offset_mm: FloatArray
    yaw_rad: FloatArray
    alpha: FloatArray
    relax_s: FloatArray
    mu: FloatArray
    foundation_n_mm3: FloatArray
    tangential_n_mm3: FloatArray
    tilt_rad: FloatArray
    print_offset_mm: FloatArray
    label_error_mm: FloatArray
    gain: FloatArray
    bias_px: FloatArray
    ft_offset: FloatArray

    @property
    def count(self) -> int:
        """Number of probes B."""
        return len(self.mu)

    def take(self, index: NDArray[np.intp]) -> Conditions:
        """Return the probes ``index``."""
        return Conditions(**{f.name: getattr(self, f.name)[index] for f in fields(self)})


def true_offset_mm(
    commanded_mm: FloatArray, conditions: Conditions, slip: FloatArray | None = None
) -> FloatArray:
    """Return (B, 2) true displacement of the face in ``O`` for the ``commanded_mm`` (B, 2).

    The grasp offset moves the piece (not only the lever arm), the print offset moves the bottom,
    the label error is the arm's own. ``slip`` (B, 2, 3): what has slipped in the hand moves it too.
    """
    shift = conditions.label_error_mm - conditions.print_offset_mm
    moved = commanded_mm + shift
    moved[:, 0] -= conditions.grasp_offset_mm[:, 0]
    if slip is not None:
        moved[:, 0] += slip[:, :, 0].mean(axis=1)
    return np.asarray(moved, dtype=np.float64)

"""Check where the bottom is: feel its edges on both sides, the centre lies between them.

The moment of a press would need no search, but the tilt of a board of 0.2 degrees shifts the centre
of pressure by several mm; whether there is a contact at all depends on the outlines alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.core.facts import OriginChecked
from backend.core.flow import FloatArray
from backend.runs.bench import Bench
from backend.runs.collected import Origin
from backend.runs.plan import Plan
from backend.runs.touching import RESOLUTION_MM, edge_mm, find_height


@dataclass(frozen=True, slots=True)
class Check:
    """``residual_mm`` (2,): felt centre of the bottom minus the origin; standard uncertainty.

    The uncertainty holds resolution, arm, and the piece in this very grasp.
    """

    residual_mm: FloatArray
    sigma_mm: float

    @property
    def agrees(self) -> bool:
        """Whether the residual is within three standard uncertainties on both axes."""
        return bool(np.abs(self.residual_mm).max() <= 3.0 * self.sigma_mm)


def check_origin(bench: Bench, origin: Origin) -> Plan[Check]:
    """Touch with the held piece at known displacements around all four edges.

    Raises ``RefusedError`` "ORIGIN-FAR" if an edge is too far off.
    """
    centre = np.array([origin.x_mm, origin.y_mm])
    contact_mm = yield from find_height(bench, centre)
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    reach = np.add(bench.piece.face.half_extents_mm, bench.outline.half_extents_mm)
    for axis in range(2):
        edges = []
        for side in (-1.0, 1.0):
            edge = yield from edge_mm(bench, centre, axis, side * float(reach[axis]), start_mm)
            edges.append(edge)
        centre[axis] += 0.5 * (edges[0] + edges[1])
    collect = bench.settings.collect
    touch = math.hypot(RESOLUTION_MM / math.sqrt(12.0), collect.arm_sigma_mm) / math.sqrt(2.0)
    check = Check(centre - (origin.x_mm, origin.y_mm), math.hypot(touch, collect.grip_sigma_mm))
    x_mm, y_mm = check.residual_mm.tolist()
    yield OriginChecked(bench.now_s(), (x_mm, y_mm), check.sigma_mm, check.agrees)
    return check

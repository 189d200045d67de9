"""Feel a bottom whose place is known, grip by grip: where the face then sits in the hand."""

from __future__ import annotations

import numpy as np

from backend.calibration.estimate import Estimate
from backend.calibration.tool import GRIPS, estimate_tool
from backend.core.facts import Progress
from backend.core.flow import FloatArray
from backend.runs.bench import Bench
from backend.runs.calibrate_board import felt_edge
from backend.runs.jig import pick, put_back
from backend.runs.plan import Checkpoint, Plan
from backend.runs.requests import CalibrateRequest
from backend.runs.touching import find_height

SIDES = ((0, -1.0), (0, 1.0), (1, -1.0), (1, 1.0))
STEPS = GRIPS * len(SIDES)


def measure_tool(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    """Return the centre of the face from the axis of the tool."""
    bottom = np.array(request.origin_mm)
    felt = []
    for grip in range(GRIPS):
        yield from pick(bench)
        contact_mm = yield from find_height(bench, bottom)
        start_mm = contact_mm + bench.settings.probe.start_height_mm
        centre = yield from _felt_centre(bench, bottom, start_mm, grip)
        felt.append(centre)
        yield from put_back(bench)
    yield Progress(bench.now_s(), STEPS, STEPS, "done")
    sigma_mm = bench.settings.collect.origin_sigma_mm
    return estimate_tool(bottom, sigma_mm, np.stack(felt))


def _felt_centre(bench: Bench, bottom: FloatArray, start_mm: float, grip: int) -> Plan[FloatArray]:
    """Return where the hand stands with the face over the centre of the bottom (2,)."""
    between = np.zeros(2)
    for at, (axis, side) in enumerate(SIDES):
        yield Checkpoint()
        yield Progress(bench.now_s(), grip * len(SIDES) + at, STEPS, f"grip {grip + 1} of {GRIPS}")
        edge = yield from felt_edge(bench, bottom, (axis, side, 0.0), start_mm)
        between[axis] += 0.5 * edge.at_mm
    return between

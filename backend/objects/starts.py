"""Where trials begin and where data is collected: offsets drawn uniformly, then accepted or not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from backend.core.faults import InputError
from backend.core.flow import FloatArray
from backend.objects.shapes import Outline
from backend.objects.surface import overlap_area_mm2
from backend.objects.tower import Body, Tower, judge

MIN_OVERLAP_MM2 = 6.0
"""Smallest overlap of a start or a training probe (the issue and bench-physics, section 10)."""

START_MARGIN_MM = -0.2
"""A trial starts clearly unstable: beyond the band that is too close to call."""

COARSE_SEGMENTS = 48
"""Corners of a circle while sampling: area error below 0.3 %, on the small side."""

MAX_ROUNDS = 500
"""Draws before giving up; a start is found within a few."""


def draw_offset(
    rng: np.random.Generator,
    face: Outline,
    bottom: Outline,
    count: int,
    min_overlap_mm2: float = MIN_OVERLAP_MM2,
) -> FloatArray:
    """Return (count, 2) offsets in mm, uniform over all with enough overlap.

    Raises ``InputError`` if the two faces can hardly overlap that much.
    """
    reach = np.add(face.half_extents_mm, bottom.half_extents_mm)
    found = np.empty((0, 2))
    for _ in range(MAX_ROUNDS):
        if len(found) >= count:
            return found[:count]
        tried = rng.uniform(-reach, reach, size=(max(8, min(count, 256)), 2))
        area = overlap_area_mm2(face, tried, bottom, segments=COARSE_SEGMENTS)
        found = np.concatenate([found, tried[area >= min_overlap_mm2]])
    raise InputError(
        f"The two faces hardly overlap by {min_overlap_mm2:g} mm².",
        "piece and bottom",
        "Choose larger faces.",
    )


def draw_start(
    rng: np.random.Generator,
    piece: Body,
    bottoms: Tower,
    min_overlap_mm2: float = MIN_OVERLAP_MM2,
    margin_mm: float = START_MARGIN_MM,
) -> tuple[float, float]:
    """Return an offset of ``piece`` from the topmost bottom at which the whole stack would fall.

    Uniform over offsets in mm (frame ``O``) with overlap of at least ``min_overlap_mm2`` and a
    margin of the stack of at most ``margin_mm``. Raises ``InputError`` if the bottoms carry
    nothing, do not stand by themselves, or no such offset is found.
    """
    carrier = bottoms.bodies[-1]
    where = f"{piece.name} on {carrier.name}"
    if carrier.upper is None:
        raise InputError(f"'{carrier.name}' carries nothing.", where, "Choose another bottom.")
    if not judge(bottoms).stands:
        raise InputError("The bottoms do not stand by themselves.", where, "Move them.")
    for _ in range(MAX_ROUNDS):
        x, y = draw_offset(rng, piece.lower, carrier.upper, 1, min_overlap_mm2)[0].tolist()
        at = (carrier.at_mm[0] + x, carrier.at_mm[1] + y)
        if judge(bottoms.with_top(replace(piece, at_mm=at))).margin_mm <= margin_mm:
            return x, y
    raise InputError("No unstable start was found.", where, "Choose another bottom.")

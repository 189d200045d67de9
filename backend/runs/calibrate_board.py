"""Touch the bottom in five places and feel its edges, each in two places if they are straight.

All of it once more where the residual is beyond its limit: of so few measurements noise alone is,
now and then.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from backend.calibration.board import Edge, YawOf, estimate_board
from backend.calibration.estimate import Estimate
from backend.core.facts import Progress, Said
from backend.core.faults import RefusedError
from backend.core.flow import FloatArray
from backend.objects.shapes import Outline
from backend.runs import words
from backend.runs.bench import Bench
from backend.runs.descents import middle_of_overlap
from backend.runs.jig import pick, put_back
from backend.runs.plan import Checkpoint, Plan
from backend.runs.requests import CalibrateRequest
from backend.runs.touching import BELOW_MM, FINE_MM, edge_mm, find_height, touched_mm

INSET_MM = 2.0
"""An edge is felt this far from its ends."""
CORNERS = ((0.0, 0.0), (1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0))
OUT = 0.6
"""The piece touches so far out, as a share of the half width of the bottom."""
EDGES = tuple((axis, side, way) for axis in range(2) for side in (-1.0, 1.0) for way in (-1.0, 1.0))
STEPS = len(CORNERS) + len(EDGES)
ROUNDS = 2


@dataclass(frozen=True, slots=True)
class Along:
    """How far off the middle each edge is felt (across x, across y), and whose yaw that tells."""

    mm: tuple[float, float]
    yaw_of: YawOf


def measure_board(bench: Bench, request: CalibrateRequest) -> Plan[Estimate]:
    """Return where the bottom is for the arm with the piece as it is held."""
    yield from pick(bench)
    centre = np.array(request.origin_mm)
    contact_mm = yield from find_height(bench, centre)
    start_mm = contact_mm + bench.settings.probe.start_height_mm
    along = along_edges(bench.piece.face, bench.outline)
    touches, edges = np.empty((0, 3)), list[Edge]()
    for before in range(ROUNDS):
        touches = np.vstack([touches, (yield from _touches(bench, centre, start_mm, before))])
        edges += yield from _edges(bench, centre, start_mm, along, before)
        found = estimate_board(touches, edges, along.yaw_of)
        if found.residual <= found.limit:
            break
        if before + 1 < ROUNDS:
            yield Said(bench.now_s(), words.felt_once_more(found.residual, found.limit))
    yield _progress(bench, before, STEPS, "back to the jig")
    yield from put_back(bench)
    return found


def _edges(
    bench: Bench, centre: FloatArray, start_mm: float, along: Along, before: int
) -> Plan[list[Edge]]:
    """Return all edges, felt round ``centre`` (2,) after ``before`` rounds."""
    edges = []
    for at, (axis, side, way) in enumerate(EDGES):
        yield Checkpoint()
        yield _progress(bench, before, len(CORNERS) + at, f"edge {at + 1} of {len(EDGES)}")
        off = along.mm[axis] * way
        edges.append((yield from felt_edge(bench, centre, (axis, side, off), start_mm)))
    return edges


def felt_edge(
    bench: Bench, centre: FloatArray, where: tuple[int, float, float], start_mm: float
) -> Plan[Edge]:
    """Feel one edge round ``centre`` (2,). ``where``: axis across, side, mm off along the edge."""
    axis, side, off_mm = where
    from_mm = centre.copy()
    from_mm[1 - axis] += off_mm
    reach = np.add(bench.piece.face.half_extents_mm, bench.outline.half_extents_mm)
    at = yield from edge_mm(bench, from_mm, axis, side * float(reach[axis]), start_mm, FINE_MM)
    return Edge(axis, side, off_mm, float(centre[axis]) + at)


def along_edges(face: Outline, bottom: Outline) -> Along:
    """Return where edges are felt so that one part of the piece, or of the bottom, stays in touch.

    A straight edge of the bottom tells its yaw along the stretch where a round face, or the corner
    of a shorter one, runs on it; a longer face on a smaller bottom tells its own.
    """
    longer, shorter = _half_lengths(bottom), _half_lengths(face)
    round_face, round_bottom = face.kind == "circle", bottom.kind == "circle"
    if longer is not None and (round_face or shorter is not None):
        least = (0.0, 0.0) if round_face or shorter is None else shorter
        room = tuple(longer[1 - k] - least[1 - k] - INSET_MM for k in range(2))
        if min(room) >= INSET_MM:
            return Along((room[0], room[1]), "board")
    if shorter is not None and (round_bottom or longer is not None):
        least = (0.0, 0.0) if round_bottom or longer is None else longer
        room = tuple(shorter[1 - k] - least[1 - k] - INSET_MM for k in range(2))
        if min(room) >= INSET_MM:
            return Along((room[0], room[1]), "piece")
    return Along((0.0, 0.0), "")


def _half_lengths(outline: Outline) -> tuple[float, float] | None:
    """Return the half sides of a rectangle along the axes, None for any other outline."""
    if outline.kind == "circle" or len(outline.vertices_mm) != 4:
        return None
    x_mm, y_mm = outline.half_extents_mm
    if all(math.isclose(abs(x), x_mm) and math.isclose(abs(y), y_mm) for x, y in
           outline.vertices_mm):  # fmt: skip
        return x_mm, y_mm
    return None


def _touches(bench: Bench, centre: FloatArray, start_mm: float, before: int) -> Plan[FloatArray]:
    """Return (5, 3): middle of the overlap and height of contact, for the arm."""
    out_mm = OUT * np.array(bench.outline.half_extents_mm)
    found = []
    for at, corner in enumerate(CORNERS):
        yield Checkpoint()
        yield _progress(bench, before, at, f"touch {at + 1} of {len(CORNERS)}")
        off = out_mm * corner
        height_mm = yield from touched_mm(bench, centre + off, start_mm, BELOW_MM)
        if height_mm is None:
            raise RefusedError("NO-TOUCH", "A touch on the bottom met nothing: check the origin.")
        middle = middle_of_overlap(bench.piece.face, bench.outline, off)
        found.append([*(centre + middle), height_mm])
    return np.array(found)


def _progress(bench: Bench, before: int, done: int, text: str) -> Progress:
    """Say how far it is after ``before`` rounds and ``done`` steps; a second one is as long."""
    steps = STEPS * (before + 1)
    return Progress(bench.now_s(), STEPS * before + done, steps, text)

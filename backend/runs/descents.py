"""Where descents begin, and which part of the bottom they meet."""

from __future__ import annotations

import numpy as np

from backend.core.flow import FloatArray, Pose
from backend.objects.shapes import Outline
from backend.objects.surface import overlap_polygon
from backend.runs.bench import Bench


def place_over(bench: Bench, at_mm: tuple[float, float]) -> Pose:
    """Return where descents to (x, y) begin: the usual way above where contact should be.

    The height of contact is that of the board, at the middle of what touches there, where it was
    felt with this piece on this bottom; else that of the file of the piece.
    """
    contact_mm = bench.piece.grip_height_mm or 0.0
    board = bench.placed.board
    if board is not None and board.is_of(bench.piece.name, bench.bottom):
        off_mm = np.array([at_mm[0] - board.place.x_mm, at_mm[1] - board.place.y_mm])
        contact_mm = board.contact_at(middle_of_overlap(bench.piece.face, bench.outline, off_mm))
    return Pose(*at_mm, contact_mm + bench.settings.probe.start_height_mm)


def middle_of_overlap(face: Outline, bottom: Outline, offset_mm: FloatArray) -> FloatArray:
    """Return the centroid (2,) of the overlap of ``face`` at ``offset_mm`` (2,) with ``bottom``.

    Faces that do not overlap have the middle of the bottom.
    """
    x_mm, y_mm = offset_mm.tolist()
    ring = overlap_polygon(face, (x_mm, y_mm), bottom)
    if len(ring) < 3:
        return np.zeros(2)
    after = np.roll(ring, -1, axis=0)
    cross = ring[:, 0] * after[:, 1] - after[:, 0] * ring[:, 1]
    return np.asarray(((ring + after) * cross[:, None]).sum(axis=0) / (3.0 * cross.sum()))

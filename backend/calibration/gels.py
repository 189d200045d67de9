"""The fingerprint of a gel: where its 63 dots rest, by which the same gel is known again.

Places are those of the raw picture, whatever the settings mirror. Five recordings of one real gel
lie 0.6 to 1.5 px (rms) apart although it holds a piece in each, two real gels 5.2 px and more.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from backend.calibration.kinds import MIRRORS
from backend.core.flow import GRID_COLS, GRID_ROWS, MARKERS, FloatArray
from backend.sensing.detector import HEIGHT_PX, WIDTH_PX

LIMIT_PX = 1.0
"""The same gel rests within this (rms) of its fingerprint."""
HELD_LIMIT_PX = 3.0
"""With a piece between the jaws the gel is pressed out of its rest, by 1.5 px at most."""
CREEP_PX = 2.0
"""By so much a gel may have moved as a whole: it creeps, and its housing warms."""
FEWEST_DOTS = 48
"""So many dots have to be seen to know a gel by them."""
NUMBERS = 2 * MARKERS


def apart_px(now_px: FloatArray, then_px: FloatArray) -> float:
    """Return how far dots (63, 2) lie from a fingerprint (63, 2), rms in px; NaN: not seen.

    Up to ``CREEP_PX`` of what all have moved alike is left out. Infinity where too few are seen.
    """
    seen = np.isfinite(now_px).all(axis=1)
    if np.count_nonzero(seen) < FEWEST_DOTS:
        return float("inf")
    moved = (now_px - then_px)[seen]
    whole = moved.mean(axis=0)
    length = float(np.linalg.norm(whole))
    crept = whole * min(1.0, CREEP_PX / length) if length > 0.0 else whole
    return float(np.sqrt(((moved - crept) ** 2).sum(axis=1).mean()))


def turned(position_px: FloatArray, mirror: str) -> FloatArray:
    """Return dots (63, 2) of a picture as they are, row by row, once it is mirrored."""
    code = MIRRORS.index(mirror)
    grid = position_px.reshape(GRID_ROWS, GRID_COLS, 2).copy()
    if code & 1:
        grid = grid[:, ::-1]
        grid[..., 0] = WIDTH_PX - 1 - grid[..., 0]
    if code & 2:
        grid = grid[::-1]
        grid[..., 1] = HEIGHT_PX - 1 - grid[..., 1]
    return grid.reshape(MARKERS, 2)


def as_numbers(position_px: FloatArray) -> tuple[float, ...]:
    """Return dots (63, 2) as a file has them: u, v of one after the other, to 0.001 px."""
    return tuple(np.round(position_px, 3).ravel().tolist())


def as_places(numbers: Sequence[float]) -> FloatArray:
    """Return the dots (63, 2) of a file."""
    return np.array(numbers, dtype=np.float64).reshape(MARKERS, 2)


def whose(
    now_px: FloatArray, known: Mapping[str, FloatArray], own: str, limit_px: float
) -> tuple[str, str]:
    """Return of whose fingerprint in ``known`` the dots are, and how the picture is mirrored then.

    Both "" where they fit none of them any way round. Two fingers may have gels that are mirror
    images: exchanged counts as likelier than mirrored, and both at once as the least likely.
    """
    names = sorted(known, key=lambda name: name != own)
    tries = [(name, "none") for name in names]
    tries += [(name, mirror) for name in names for mirror in MIRRORS[1:]]
    for name, mirror in tries:
        if apart_px(turned(now_px, mirror), known[name]) < limit_px:
            return name, mirror
    return "", ""

"""Marker tracking that rejects JPEG pictures damaged in transfer although they decode.

Damage to a JPEG changes blocks: a marker leaves its neighbours, looks different, and the picture
around it is not the previous one in motion. Each of these alone is no proof, since real gels slip
and real dots blur in fast motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core import (
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    Finger,
    FloatArray,
    ImageArray,
    MarkerField,
    MarkerState,
    TactileFrame,
)
from touchdown.backend.sensing.detector import HEIGHT_PX, WIDTH_PX
from touchdown.backend.sensing.tracker import MarkerTracker

# Largest motion of a dot between frames, absolute and relative to its neighbours. The maximum in
# 2,245 steps of real gels is 6.3 and 2.7 px; a JPEG that lost one block is shifted by 8 px.
JUMP_PX, TORN_PX = 7.0, 3.5
# A row is shifted if it moved along itself by ALONG_PX and bent by less than STIFF_SHARE of that.
# Real rows bend by 0.38 of it or more.
ALONG_PX, STIFF_SHARE = 0.8, 0.2
TINT_LEVELS = 1.0  # largest colour change with locked white balance and exposure; real frames: 0.3
# Change of brightness that starts at one row of blocks and continues below it, since JPEG levels
# are coded relative to the previous block. With a doubtful marker the first limit applies.
LINE_LEVELS, SURE_LINE_LEVELS = 3.0, 5.0
# A marker is doubtful if it leaves the affine motion of its eight neighbours by the first and its
# darkness changes by the second.
DOUBT_PX, DOUBT_LOOKS_SHARE = 0.2, 0.03
# Rms grey levels over 5 x 5 px that motion does not explain. Damage is above the first, or above
# the second if also LOCAL_RATIO times that of other markers. Real gels in fast slip reach 32 and
# 8.2 times.
CHANGED_LEVELS, LOCAL_LEVELS, LOCAL_RATIO = 35.0, 8.5, 8.5
STEADY_FRAMES = 3  # A marker seen in this many frames in a row does not vanish at once,
EDGE_PX = 20.0  # except this near to the border, where its dot is cut
_FAR_PX = np.array([WIDTH_PX, HEIGHT_PX])
_OTHERS = range(0, MARKERS, 4)
_PATCH, _WINDOW, _BLOCKS = (25, 25), (5, 5), (WIDTH_PX // 8, HEIGHT_PX // 8)


@dataclass(frozen=True, slots=True)
class _TrackedFrame:
    """One picture, the means of its blocks of 8 x 8 px (30, 40, 3), and its markers."""

    image: ImageArray
    blocks: NDArray[np.float32]
    position_px: FloatArray
    seen: NDArray[np.bool_]
    looks: FloatArray


class DamageCheckingTracker:
    """Tracker of one finger that rejects damaged pictures; ``refused`` counts them.

    Two pictures in a row are never rejected, so that unusual motion of a gel costs at most every
    other picture.
    """

    def __init__(self, finger: Finger) -> None:
        self.tracker = MarkerTracker(finger)
        self.refused = 0
        self._last: _TrackedFrame | None = None
        self._steady = np.zeros(MARKERS, dtype=np.intp)
        self._doubted = False

    def track(self, frame: TactileFrame) -> MarkerField | None:
        """Return the markers of ``frame`` as ``MarkerTracker.track``, None if it is damaged.

        Only pictures transferred as JPEG are checked.
        """
        if not frame.from_jpeg:
            return self.tracker.track(frame)
        before = self.tracker.remember()
        field = self.tracker.track(frame)
        if frame.image.shape != (HEIGHT_PX, WIDTH_PX, 3):
            return field
        blocks = cv2.resize(frame.image, _BLOCKS, interpolation=cv2.INTER_AREA).astype(np.float32)
        seen = np.asarray(field.state == MarkerState.SEEN)
        new = _TrackedFrame(frame.image, blocks, field.position_px, seen, self.tracker.looks)
        if not self._doubted and self._last is not None and self._impossible(self._last, new):
            self.tracker.recall(before)
            self.refused += 1
            self._doubted = True
            return None
        self._doubted = False
        self._last = new
        self._steady = np.where(new.seen, self._steady + 1, 0)
        return field

    def _impossible(self, last: _TrackedFrame, new: _TrackedFrame) -> bool:
        """Return True if no gel gets from ``last`` to ``new`` within one frame."""
        inside = (last.position_px > EDGE_PX) & (last.position_px < _FAR_PX - EDGE_PX)
        if (~new.seen & (self._steady >= STEADY_FRAMES) & inside.all(axis=1)).any():
            return True
        both = last.seen & new.seen
        step_px = new.position_px - last.position_px
        apart_px = np.where(both, neighbour_residual_px(step_px), 0.0)
        if np.abs(step_px[both]).max(initial=0.0) > JUMP_PX or apart_px.max() > TORN_PX:
            return True
        if shifted_along_rows(step_px) or tint_levels(last.blocks, new.blocks) > TINT_LEVELS:
            return True
        line_levels = float(
            np.abs(np.diff(np.median(new.blocks - last.blocks, axis=1), axis=0)).max()
        )
        if line_levels > SURE_LINE_LEVELS:
            return True
        # A marker without darkness in the last frame has an infinite ratio.
        dark = np.full_like(new.looks, np.inf)
        ratio = np.divide(new.looks, last.looks, out=dark, where=last.looks > 0.0)
        share = np.abs(ratio - 1.0).max(axis=1)
        doubtful = (apart_px > DOUBT_PX) & (share > DOUBT_LOOKS_SHARE)
        if not doubtful.any():
            return False
        usual = np.median([unexplained_levels(last, new, k) for k in _OTHERS])
        limit = max(LOCAL_LEVELS, LOCAL_RATIO * float(usual))
        found = max(unexplained_levels(last, new, k) for k in np.flatnonzero(doubtful).tolist())
        return line_levels > LINE_LEVELS or found > min(CHANGED_LEVELS, limit)


def neighbour_residual_px(step_px: FloatArray) -> FloatArray:
    """Return (63,) distance of steps (63, 2) from the affine fit of their eight neighbours."""
    apart = _NEIGHBOUR_RESIDUAL @ step_px
    return np.asarray(np.sqrt(np.einsum("ij,ij->i", apart, apart)), dtype=np.float64)


def shifted_along_rows(step_px: FloatArray) -> bool:
    """Return True if steps (63, 2) move a row of markers along itself without bending.

    A JPEG that lost or gained a block is shifted so from there on; a gel, fixed at its rim, is not.
    """
    rows = step_px.reshape(GRID_ROWS, GRID_COLS, 2)
    mean = rows.mean(axis=1)
    along = np.abs(mean[:, 0])
    spread = np.abs(rows - mean[:, None]).max(axis=(1, 2))
    stiff = (spread < STIFF_SHARE * along) & (np.abs(mean[:, 1]) < STIFF_SHARE * along)
    return bool((stiff & (along > ALONG_PX)).any())


def tint_levels(last: NDArray[np.float32], new: NDArray[np.float32]) -> float:
    """Return the change of the mean colour in levels, without changes of brightness.

    ``last``, ``new``: (30, 40, 3) means of blocks.
    """
    before, after = last.mean(axis=(0, 1)), new.mean(axis=(0, 1))
    gain = float(after.sum()) / max(float(before.sum()), 1.0)
    return float(np.abs(after - gain * before).max())


def unexplained_levels(last: _TrackedFrame, new: _TrackedFrame, marker: int) -> float:
    """Return the difference of the patch around ``marker`` from its previous one, in levels."""
    change = _patch(new, marker) - _patch(last, marker)
    change -= np.median(change[::3, ::3], axis=(0, 1))  # lamps may flicker
    square = np.einsum("ijk,ijk->ij", change, change) / change.shape[2]
    return float(np.sqrt(cv2.blur(square, _WINDOW).max()))


def _patch(seen: _TrackedFrame, marker: int) -> NDArray[np.float32]:
    u, v = seen.position_px[marker].tolist()
    return np.asarray(cv2.getRectSubPix(seen.image, _PATCH, (u, v)), dtype=np.float32)


def _neighbour_residual() -> FloatArray:
    """Return (63, 63): each marker minus the affine fit of its eight nearest neighbours."""
    rows = np.eye(MARKERS)
    for marker in range(MARKERS):
        row, col = divmod(marker, GRID_COLS)
        middle = min(max(row, 1), GRID_ROWS - 2), min(max(col, 1), GRID_COLS - 2)
        around = [
            (r, c)
            for r in range(middle[0] - 1, middle[0] + 2)
            for c in range(middle[1] - 1, middle[1] + 2)
            if (r, c) != (row, col)
        ]
        fit = np.linalg.pinv(np.array([[1.0, r - row, c - col] for r, c in around]))[0]
        for (r, c), weight in zip(around, fit, strict=True):
            rows[marker, r * GRID_COLS + c] -= weight
    return rows


_NEIGHBOUR_RESIDUAL = _neighbour_residual()
_NEIGHBOUR_RESIDUAL.flags.writeable = False

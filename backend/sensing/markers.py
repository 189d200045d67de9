"""Follows the 63 markers of one finger through its images.

Every frame: centre each marker's dot to a fraction of a pixel from where it was last. Unless all 63
are found so and look like themselves, find all dots of the image, give each marker its own, and
fill in what was not seen. Places come from the image alone, never from summed-up steps, so that no
error outlives its cause. If the known places lead nowhere, order is taken anew from the grid's
geometry.
"""

from __future__ import annotations

import copy
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import (
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
from backend.core.inference import misfit
from backend.sensing.assignment import assign_rest, nearest_dots, out_of_order
from backend.sensing.detector import HEIGHT_PX, WIDTH_PX, Blobs, Detector
from backend.sensing.grid import NO_GRID, GridReport, order_grid
from backend.sensing.hidden import HiddenMarkers
from backend.sensing.looks import UsualLooks
from backend.sensing.reference import Reference
from backend.sensing.slip import fit_rigid

LOST_AFTER_S = 2.0
REACH_PITCH = 0.4
STRAY_PX = 5.0
"""A step that differs this much from its neighbours' steps is not believed."""
SMOOTH_PX = 0.5
"""Frame-to-frame misfit (rms) up to which a field counts as smooth."""
_LARGEST_SHIFT_PX = 5.0
"""A centre further from where it was looked for belongs to something else."""
_FEWEST_SEEN = 32
_REORDER_EVERY = 5
_NO_BLOB = -1


class Memory(NamedTuple):
    """What a tracker knows from earlier frames; made by it and for it."""

    grid: GridReport
    locked: bool
    position_px: FloatArray
    looks: UsualLooks
    last_seen_s: FloatArray
    was_seen: NDArray[np.bool_]
    hidden: HiddenMarkers
    restless: int


class MarkerTracker:
    """The live tracker of one finger: frames in, marker fields out; deterministic.

    ``grid`` tells what the last look at the whole grid found. ``track`` never raises on an image,
    however bad: it answers with quality 0.
    """

    def __init__(self, finger: Finger, reference: Reference | None = None) -> None:
        self.finger = finger
        self.grid: GridReport = NO_GRID
        self._reference: Reference | None = None
        self._detector = Detector()
        self._locked = False
        self._position = _straight_grid()
        self._looks = UsualLooks()
        self._last_seen_s = np.full(MARKERS, -np.inf)
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        self._hidden = HiddenMarkers(self._position)
        self._restless = 0
        if reference is not None:
            self.set_reference(reference)

    @property
    def reference(self) -> Reference | None:
        """The rest places that displacements count from."""
        return self._reference

    def set_reference(self, reference: Reference) -> None:
        """Count displacements from ``reference`` from now on."""
        self._reference = reference
        self._hidden = HiddenMarkers(reference.position_px)
        if not self._locked:
            self._position = reference.position_px.copy()

    @property
    def looks(self) -> FloatArray:
        """(63, 2) darkness of each marker in its middle and in all, px², when it was last seen."""
        return self._looks.newest

    def remember(self) -> Memory:
        """Return where it stands now, to ``recall`` it after a picture that was none."""
        return Memory(
            self.grid,
            self._locked,
            self._position,
            copy.deepcopy(self._looks),
            self._last_seen_s.copy(),
            self._was_seen,
            copy.deepcopy(self._hidden),
            self._restless,
        )

    def recall(self, memory: Memory) -> None:
        """Go on from ``memory``, as if no picture had come since."""
        self.grid, self._locked, self._position = memory.grid, memory.locked, memory.position_px
        self._looks, self._hidden, self._restless = memory.looks, memory.hidden, memory.restless
        self._last_seen_s, self._was_seen = memory.last_seen_s, memory.was_seen

    def track(self, frame: TactileFrame) -> MarkerField:
        """Return the markers of ``frame``; frames must come in order of time."""
        if not _readable(frame.image):
            return self._blind(frame)
        self._detector.look(frame.image)
        position, seen = self._follow(frame.t_s), np.ones(MARKERS, dtype=bool)
        if position is None:
            blobs = self._detector.blobs()
            owner = self._own(blobs)
            if owner is None:
                return self._blind(frame)
            seen, position = self._centre(blobs, owner, frame.t_s)
        rough_px = self._reject_strays(position, seen)
        self._settle(position, seen, frame.t_s)
        share = float(np.count_nonzero(seen)) / MARKERS
        quality = share * min(1.0, SMOOTH_PX / max(rough_px, SMOOTH_PX))
        return self._field(frame, quality)

    def _follow(self, t_s: float) -> FloatArray | None:
        """Return the places (63, 2) if each marker is still near its last one, else None."""
        recent = t_s - self._last_seen_s[0] <= LOST_AFTER_S
        if not (recent and self._was_seen.all() and self._detector.border_clear):
            return None
        centres = self._detector.refine(self._position)
        place = centres.position_px
        near = np.abs(place - self._position).max() < _LARGEST_SHIFT_PX
        if not (near and self._looks.recognise_all(centres.looks)):
            return None
        self._restless = 0
        return place

    def _own(self, blobs: Blobs) -> NDArray[np.intp] | None:
        """Return the blob of each marker (-1: none), or None while the grid is unknown."""
        if not self._locked:
            return self._lock(blobs)
        whole = np.flatnonzero(blobs.whole)
        dots = blobs.centre_px[whole]
        reach_px = REACH_PITCH * self.grid.pitch_px
        found = nearest_dots(self._position, dots, reach_px)
        missing = int((found < 0).sum())
        if missing:
            found = self._second_look(found, dots, reach_px)
            missing = int((found < 0).sum())
        owner = np.where(found < 0, _NO_BLOB, whole[found] if len(whole) else _NO_BLOB)
        self._restless = self._restless + 1 if missing else 0
        if self._should_reorder(missing, len(whole)):
            return self._reordered(blobs, owner)
        return owner

    def _second_look(
        self, found: NDArray[np.intp], dots: FloatArray, reach_px: float
    ) -> NDArray[np.intp]:
        """Look for the rest where the neighbours' motion has taken them."""
        step = np.zeros((MARKERS, 2))
        hit = found >= 0
        step[hit] = dots[found[hit]] - self._position[hit]
        expected = self._position + self._hidden.carry(step, hit)
        return assign_rest(found, expected, dots, reach_px)

    def _should_reorder(self, missing: int, dots: int) -> bool:
        if not missing or self._restless % _REORDER_EVERY != 1:
            return False
        return MARKERS - missing < _FEWEST_SEEN or dots >= MARKERS

    def _lock(self, blobs: Blobs) -> NDArray[np.intp] | None:
        ordered = order_grid(blobs)
        self.grid = ordered.report
        if not ordered.report.usable:
            return None
        self._locked = True
        return self._adopt(blobs, ordered.index)

    def _reordered(self, blobs: Blobs, owner: NDArray[np.intp]) -> NDArray[np.intp]:
        """Take the order from geometry if it is certain, else keep ``owner``."""
        ordered = order_grid(blobs)
        few = int((owner >= 0).sum()) < _FEWEST_SEEN
        if not (ordered.report.complete or (few and ordered.report.usable)):
            return owner
        self.grid = ordered.report
        if (ordered.index == owner).all():
            return owner
        return self._adopt(blobs, ordered.index)

    def _adopt(self, blobs: Blobs, index: NDArray[np.intp]) -> NDArray[np.intp]:
        """Start anew from the dots at ``index``; returns it without those that are no markers."""
        self._looks = UsualLooks()
        found = np.flatnonzero(index >= 0)
        chosen = index[found]
        centres = self._detector.refine(blobs.centre_px[chosen])
        good = self._looks.recognise(found, centres.looks, np.ones(len(found), dtype=bool))
        place, seen = np.zeros((MARKERS, 2)), np.zeros(MARKERS, dtype=bool)
        place[found], seen[found] = centres.position_px, good
        rest = self._reference.position_px if self._reference else _straight_grid()
        self._position = rest + self._hidden.carry(place - rest, seen)
        if self._reference is None:
            self._hidden = HiddenMarkers(self._position)
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        return np.where(seen, index, _NO_BLOB)

    def _centre(
        self, blobs: Blobs, owner: NDArray[np.intp], t_s: float
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Return which markers are seen, and the places (63, 2) of those."""
        seen = owner >= 0
        position = self._position.copy()
        start = blobs.centre_px[owner[seen]]
        centres = self._detector.refine(start)
        stale = t_s - self._last_seen_s[seen] > LOST_AFTER_S
        good = self._looks.recognise(np.flatnonzero(seen), centres.looks, stale)
        good &= np.abs(centres.position_px - start).max(axis=1, initial=0.0) < _LARGEST_SHIFT_PX
        position[seen] = np.where(good[:, None], centres.position_px, position[seen])
        seen[seen] = good
        return seen, position

    def _reject_strays(self, position: FloatArray, seen: NDArray[np.bool_]) -> float:
        """Un-see markers that jumped away from their neighbours; return the field's roughness."""
        if not self._was_seen.any():
            return 0.0
        square = np.zeros(MARKERS)
        for _ in range(4):
            both = seen & self._was_seen
            bend = misfit(self._hidden.carry(position - self._position, both))
            square = np.einsum("ij,ij->i", bend, bend)
            worst = int((square * both).argmax())
            if not both[worst] or square[worst] <= STRAY_PX**2:
                break
            seen[worst] = False
        return math.sqrt(float(square.mean()))

    def _settle(self, position: FloatArray, seen: NDArray[np.bool_], t_s: float) -> None:
        """Fill in the unseen and remember the frame."""
        self._position = self._hidden.fill(position, seen)
        if not seen.all():
            self._hidden.forget(out_of_order(self._position) & ~seen)
        self._last_seen_s[seen] = t_s
        self._was_seen = seen

    def _field(self, frame: TactileFrame, quality: float) -> MarkerField:
        state = np.zeros(MARKERS, dtype=np.uint8)
        if not self._was_seen.all():
            gone = frame.t_s - self._last_seen_s > LOST_AFTER_S
            state[~self._was_seen] = MarkerState.INFERRED
            state[~self._was_seen & gone] = MarkerState.LOST
        displacement, residual = np.zeros((MARKERS, 2)), 0.0
        if self._reference is not None and self._locked:
            rest = self._reference.position_px
            displacement = self._position - rest
            residual = fit_rigid(rest, displacement).residual_px
        return MarkerField(
            finger=frame.finger,
            sequence=frame.sequence,
            t_s=frame.t_s,
            position_px=self._position.copy(),
            displacement_px=displacement,
            state=state,
            quality=quality,
            residual_px=residual,
        )

    def _blind(self, frame: TactileFrame) -> MarkerField:
        """Answer for a frame in which nothing can be said: the last places, none seen."""
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        return self._field(frame, 0.0)


def _readable(image: ImageArray) -> bool:
    return image.shape == (HEIGHT_PX, WIDTH_PX, 3) and image.dtype == np.uint8


def _straight_grid() -> FloatArray:
    """Return (63, 2) nominal places, for order only; real gels deviate by some px."""
    u, v = np.linspace(21, 287, GRID_COLS), np.linspace(20, 214, GRID_ROWS)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(MARKERS, 2)

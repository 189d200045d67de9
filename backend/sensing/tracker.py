"""Tracker of the 63 markers of one finger.

In each frame the dot of each marker is located with sub-pixel accuracy from its last position.
Unless all 63 are found with their usual appearance, all dots of the image are detected and assigned
to the markers one to one, and unseen markers are interpolated. Positions are measured in each
image, not accumulated, so that errors do not persist. If tracking fails, the order is determined
again from the geometry of the grid.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from touchdown.backend.core import (
    GRID_COLS,
    GRID_ROWS,
    MARKERS,
    Finger,
    FloatArray,
    MarkerField,
    MarkerState,
    TactileFrame,
    fill_unseen_markers,
    marker_misfit,
    read_only,
)
from touchdown.backend.sensing.detector import (
    HEIGHT_PX,
    NO_GRID,
    WIDTH_PX,
    Blobs,
    Detector,
    GridReport,
    order_grid,
)
from touchdown.backend.sensing.slip import fit_rigid
from touchdown.backend.sensing.zeroing import TactileReference

MIN_ORDER_PX = 4.0  # neighbours closer than this along their axis are out of order


def nearest_dots(expected_px: FloatArray, dots_px: FloatArray, reach_px: float) -> NDArray[np.intp]:
    """Return for each of n positions its mutually nearest dot within ``reach_px``, else -1.

    ``dots_px`` is (m, 2). The assignment is one to one.
    """
    owner = np.full(len(expected_px), -1, dtype=np.intp)
    if not len(dots_px):
        return owner
    gap = _distances(expected_px, dots_px)
    mine, theirs = gap.argmin(axis=1), gap.argmin(axis=0)
    places = np.arange(len(expected_px))
    mutual = (theirs[mine] == places) & (gap[places, mine] <= reach_px)
    owner[mutual] = mine[mutual]
    return owner


def assign_remaining(
    owner: NDArray[np.intp], expected_px: FloatArray, dots_px: FloatArray, reach_px: float
) -> NDArray[np.intp]:
    """Return ``owner`` with free dots assigned to the other markers at least total distance."""
    places = np.flatnonzero(owner < 0)
    free = np.setdiff1d(np.arange(len(dots_px)), owner)
    completed = owner.copy()
    if not len(places) or not len(free):
        return completed
    gap = _distances(expected_px[places], dots_px[free])
    rows, cols = linear_sum_assignment(np.minimum(gap, 2 * reach_px))
    near = gap[rows, cols] <= reach_px
    completed[places[rows[near]]] = free[cols[near]]
    return completed


def misordered_markers(position_px: FloatArray) -> NDArray[np.bool_]:
    """Return (63,) bool: True where the order to a neighbour on the grid is violated."""
    grid = position_px.reshape(GRID_ROWS, GRID_COLS, 2)
    wrong = np.zeros((GRID_ROWS, GRID_COLS), dtype=bool)
    across = np.diff(grid[:, :, 0], axis=1) < MIN_ORDER_PX
    wrong[:, :-1] |= across
    wrong[:, 1:] |= across
    down = np.diff(grid[:, :, 1], axis=0) < MIN_ORDER_PX
    wrong[:-1] |= down
    wrong[1:] |= down
    return wrong.ravel()


def _distances(expected_px: FloatArray, dots_px: FloatArray) -> FloatArray:
    across = expected_px[:, None, 0] - dots_px[None, :, 0]
    down = expected_px[:, None, 1] - dots_px[None, :, 1]
    # Six times as fast as hypot.
    return np.asarray(np.sqrt(across * across + down * down), dtype=np.float64)


MAX_CARRY_PX = 8.0


class HiddenMarkers:
    """Infers hidden markers from the seen ones and from their own last known deviation.

    A smooth interpolation alone would let a marker jump when it disappears, by its deviation from
    its neighbours. The deviation is kept while the marker is hidden, in proportion to the field
    around it.
    """

    def __init__(self, rest_px: FloatArray) -> None:
        self._rest: FloatArray = np.array(rest_px)
        self._known = np.zeros((MARKERS, 2))
        self._seen = np.ones(MARKERS, dtype=bool)
        self._deviation = np.zeros((MARKERS, 2))
        self._size = np.zeros(MARKERS)

    def carry(self, step: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
        """Return ``step`` (63, 2) with unseen markers interpolated."""
        if seen.all():
            return step
        filled: FloatArray = fill_unseen_markers(step[None], seen[None])[0]
        return filled

    def fill(self, position_px: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
        """Return the positions (63, 2): seen ones as given, hidden ones inferred."""
        displacement = position_px - self._rest
        if seen.all():
            self._known, self._seen = displacement, seen
            return position_px
        smooth = self.carry(displacement, seen)
        if (seen != self._seen).any():
            self._remember(seen)
        hidden = ~seen
        size = np.linalg.norm(smooth[hidden], axis=1)
        scale = np.minimum(1.0, size / np.maximum(self._size[hidden], 1e-3))
        smooth[hidden] += scale[:, None] * self._deviation[hidden]
        self._known, self._seen = smooth, seen
        return np.asarray(self._rest + smooth, dtype=np.float64)

    def forget(self, markers: NDArray[np.bool_]) -> None:
        """Reset the deviations of ``markers`` (63,)."""
        self._deviation[markers] = 0.0

    def _remember(self, seen: NDArray[np.bool_]) -> None:
        smooth = self.carry(self._known, seen)
        deviation = self._known - smooth
        length = np.maximum(np.linalg.norm(deviation, axis=1), 1e-9)
        self._deviation = deviation * np.minimum(1.0, MAX_CARRY_PX / length)[:, None]
        self._size = np.linalg.norm(smooth, axis=1)


# Allowed ratio of area (centre, total) and contrast to the usual look of the same marker.
OWN_RANGE = np.array([[0.6, 0.5, 0.3], [1.6, 2.0, 2.5]])
# Allowed ratio to the look of the others, for markers without a recent look of their own.
COMMON_RANGE = np.array([[0.5, 0.45, 0.25], [1.8, 2.2, 2.5]])
APPEARANCE_MEMORY = 0.05


class DotAppearance:
    """Running mean of area (centre, total) and contrast of each marker."""

    def __init__(self) -> None:
        self._usual = np.zeros((MARKERS, 3))
        # Of the last frame, of markers that looked like themselves.
        self.newest: FloatArray = np.zeros((MARKERS, 3))

    def recognise_all(self, looks: FloatArray) -> bool:
        """Return True if all 63 have their usual look, and update it then."""
        own = self._usual
        if not ((looks >= own * OWN_RANGE[0]).all() and (looks <= own * OWN_RANGE[1]).all()):
            return False
        own += APPEARANCE_MEMORY * (looks - own)
        self.newest = looks
        return True

    def recognise(
        self, markers: NDArray[np.intp], looks: FloatArray, stale: NDArray[np.bool_]
    ) -> NDArray[np.bool_]:
        """Return (n,) bool: ``markers`` with their usual look, which is updated for these.

        ``looks``: (n, 3) of the assigned dots; ``stale``: (n,) True for markers unseen for so long
        that their look may have changed.
        """
        if not len(markers):
            return np.zeros(0, dtype=bool)
        own = self._usual[markers]
        fresh = (own[:, 0] > 0) & ~stale
        expected = own
        if not fresh.all():
            known = self._usual[:, 0] > 0
            typical = np.median(self._usual[known] if known.any() else looks, axis=0)
            expected = np.where(fresh[:, None], own, np.maximum(typical, 1e-6))
        ratio = looks / expected
        lowest = np.where(fresh[:, None], OWN_RANGE[0], COMMON_RANGE[0])
        highest = np.where(fresh[:, None], OWN_RANGE[1], COMMON_RANGE[1])
        good = ((ratio >= lowest) & (ratio <= highest)).all(axis=1)
        blend = np.where(fresh, APPEARANCE_MEMORY, 1.0)[:, None]
        self._usual[markers[good]] = (own + blend * (looks - own))[good]
        self.newest = self.newest.copy()
        self.newest[markers[good]] = looks[good]
        return np.asarray(good)


LOST_AFTER_S = 2.0
REACH_PITCH = 0.4
STRAY_PX = 5.0  # A step that differs this much from those of its neighbours is rejected
SMOOTH_PX = 0.5  # A field with at most this frame-to-frame misfit (rms) has full quality
_MAX_SHIFT_PX = 5.0  # A centre farther from its start belongs to another dot
_WHOLE_PX = 8.0  # A dot nearer to the border than this is cut
_APART_PX = 12.0  # Two markers closer than this are one dot
_FAR_PX = np.array([WIDTH_PX - 1.0, HEIGHT_PX - 1.0])
_MIN_SEEN = 32
_REORDER_EVERY = 5
_NO_BLOB = -1
# Changes from which the shading of a dot may move its centre, and by which it surely does: of the
# contrast, as a logarithm, and of the slope around it over the contrast.
_SHADED = (0.3, 0.4)
_SHADING_EVERY = 4  # frames between two measurements
# A contrast this far from the median, as a logarithm, is not that of a dot at rest.
_UNUSUAL = 0.35


# Attributes of a tracker that change from frame to frame.
_STATE = (
    "grid", "_locked", "_position", "_looks", "_last_seen_s", "_was_seen", "_hidden", "_restless",
    "_shading", "_since_shading",
)  # fmt: skip


class MarkerTracker:
    """Tracker of one finger: frames in, marker fields out; deterministic.

    ``grid``: result of the last detection of the whole grid. ``track`` never raises on a bad image;
    its field has quality 0.
    """

    def __init__(self, finger: Finger, reference: TactileReference | None = None) -> None:
        self.finger = finger
        self.grid: GridReport = NO_GRID
        # Rest positions from which displacements are measured.
        self.reference: TactileReference | None = None
        self._detector = Detector()
        self._locked = False
        self._position = _straight_grid()
        self._looks = DotAppearance()
        self._last_seen_s = np.full(MARKERS, -np.inf)
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        self._hidden = HiddenMarkers(self._position)
        self._restless = 0
        # Outlines (63, 32), contrast (63,) and slope (63, 2) when the grid was found, else NaN.
        self._outline_px = np.full((MARKERS, 32), np.nan)
        self._rest_contrast, self._rest_slope = np.full(MARKERS, np.nan), np.zeros((MARKERS, 2))
        self._shading, self._since_shading = np.zeros(MARKERS), 0
        if reference is not None:
            self.set_reference(reference)

    def set_reference(self, reference: TactileReference) -> None:
        """Measure displacements from ``reference`` from now on."""
        self.reference = reference
        self._hidden = HiddenMarkers(reference.position_px)
        if not self._locked:
            self._position = reference.position_px.copy()

    @property
    def looks(self) -> FloatArray:
        """(63, 2) darkness of each marker (centre, total), px², when last seen."""
        newest = self._looks.newest
        return newest[:, :2] * newest[:, 2:]

    def remember(self) -> dict[str, Any]:
        """Return the present state, to be restored with ``recall`` after a damaged picture."""
        return copy.deepcopy({name: getattr(self, name) for name in _STATE})

    def recall(self, memory: dict[str, Any]) -> None:
        """Restore the state ``memory``."""
        for name in _STATE:
            setattr(self, name, memory[name])

    def track(self, frame: TactileFrame) -> MarkerField:
        """Return the markers of ``frame``; frames must come in order of time."""
        if frame.image.shape != (HEIGHT_PX, WIDTH_PX, 3) or frame.image.dtype != np.uint8:
            return self._blind(frame)
        self._detector.look(frame.image)
        position, seen = self._follow(frame.t_s), np.ones(MARKERS, dtype=bool)
        if position is None:
            blobs = self._detector.blobs()
            owner = self._own(blobs)
            if owner is None:
                return self._blind(frame)
            seen, position = self._centre(blobs, owner, frame.t_s)
        self._correct_shaded(position, seen)
        rough_px = self._reject_strays(position, seen)
        self._settle(position, seen, frame.t_s)
        share = float(np.count_nonzero(seen)) / MARKERS
        quality = share * min(1.0, SMOOTH_PX / max(rough_px, SMOOTH_PX))
        return self._field(frame, quality)

    def _follow(self, t_s: float) -> FloatArray | None:
        """Return the positions (63, 2) if each marker is near its last one, else None."""
        recent = t_s - self._last_seen_s[0] <= LOST_AFTER_S
        if not (recent and self._was_seen.all() and self._detector.border_clear):
            return None
        centres = self._detector.refine(self._position)
        place = centres.position_px
        near = np.abs(place - self._position).max() < _MAX_SHIFT_PX
        if not (near and self._looks.recognise_all(centres.looks)):
            return None
        self._restless = 0
        return place

    def _own(self, blobs: Blobs) -> NDArray[np.intp] | None:
        """Return the blob of each marker (-1: none), None while the grid is unknown."""
        if not self._locked:
            return self._lock(blobs)
        whole = np.flatnonzero(blobs.whole)
        dots = blobs.centre_px[whole]
        reach_px = REACH_PITCH * self.grid.pitch_px
        found = nearest_dots(self._position, dots, reach_px)
        if (found < 0).any():
            # Search the remaining markers at positions predicted from their neighbours.
            step, hit = np.zeros((MARKERS, 2)), found >= 0
            step[hit] = dots[found[hit]] - self._position[hit]
            expected = self._position + self._hidden.carry(step, hit)
            found = assign_remaining(found, expected, dots, reach_px)
        missing = int((found < 0).sum())
        owner = np.where(found < 0, _NO_BLOB, whole[found] if len(whole) else _NO_BLOB)
        self._restless = self._restless + 1 if missing else 0
        doubtful = MARKERS - missing < _MIN_SEEN or len(whole) >= MARKERS
        if missing and doubtful and self._restless % _REORDER_EVERY == 1:
            return self._reordered(blobs, owner)
        return owner

    def _lock(self, blobs: Blobs) -> NDArray[np.intp] | None:
        ordered = order_grid(blobs)
        self.grid = ordered.report
        if not ordered.report.usable:
            return None
        self._locked = True
        owner = self._adopt(blobs, ordered.index)
        seen, found = owner >= 0, self._looks.newest[:, 2]
        self._outline_px, self._rest_contrast = self._detector.outlines(self._position)[0], found
        self._rest_slope = self._detector.slopes(self._position)
        usual = float(np.median(found[seen])) if seen.any() else 1.0
        known = seen & (np.abs(np.log(np.maximum(found, 1e-6) / usual)) < _UNUSUAL)
        # A dot that is shaded already is compared with the others.
        if known.any():
            self._outline_px[~known] = np.median(self._outline_px[known], axis=0)
        self._rest_contrast = np.where(known, found, usual)
        self._rest_slope[~known] = 0.0
        self._since_shading = _SHADING_EVERY
        return owner

    def _correct_shaded(self, position: FloatArray, seen: NDArray[np.bool_]) -> None:
        """Centre seen markers by their outlines where the light has changed since the start."""
        self._since_shading += 1
        if self._since_shading >= _SHADING_EVERY:
            self._since_shading, self._shading = 0, self._measure_shading(position)
        rows = np.flatnonzero((self._shading > _SHADED[0]) & seen)
        if len(rows):
            start = position[rows]
            found = self._detector.refine_by_outline(start, self._outline_px[rows])
            share = (self._shading[rows] - _SHADED[0]) / (_SHADED[1] - _SHADED[0])
            position[rows] = start + np.minimum(share, 1.0)[:, None] * (found - start)

    def _measure_shading(self, position: FloatArray) -> FloatArray:
        """Return the change (63,) of the light on each dot since the grid was found."""
        contrast = np.maximum(self._looks.newest[:, 2], 1e-6)
        slope = (self._detector.slopes(position) - self._rest_slope) / contrast[:, None]
        return np.asarray(np.abs(np.log(contrast / self._rest_contrast)) + np.hypot(*slope.T))

    def _reordered(self, blobs: Blobs, owner: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the order from the grid geometry if certain, else ``owner``."""
        ordered = order_grid(blobs)
        few = int((owner >= 0).sum()) < _MIN_SEEN
        if not (ordered.report.complete or (few and ordered.report.usable)):
            return owner
        self.grid = ordered.report
        if (ordered.index == owner).all():
            return owner
        return self._adopt(blobs, ordered.index)

    def _adopt(self, blobs: Blobs, index: NDArray[np.intp]) -> NDArray[np.intp]:
        """Restart from the dots ``index``; return it without those that are not markers."""
        self._looks = DotAppearance()
        found = np.flatnonzero(index >= 0)
        chosen = index[found]
        centres = self._detector.refine(blobs.centre_px[chosen])
        good = self._looks.recognise(found, centres.looks, np.ones(len(found), dtype=bool))
        place, seen = np.zeros((MARKERS, 2)), np.zeros(MARKERS, dtype=bool)
        place[found], seen[found] = centres.position_px, good
        rest = self.reference.position_px if self.reference else _straight_grid()
        self._position = rest + self._hidden.carry(place - rest, seen)
        if self.reference is None:
            self._hidden = HiddenMarkers(self._position)
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        return np.where(seen, index, _NO_BLOB)

    def _centre(
        self, blobs: Blobs, owner: NDArray[np.intp], t_s: float
    ) -> tuple[NDArray[np.bool_], FloatArray]:
        """Return (63,) seen, and the positions (63, 2) of those."""
        seen = owner >= 0
        position = self._position.copy()
        self._measure(np.flatnonzero(seen), blobs.centre_px[owner[seen]], position, seen, t_s)
        if seen.any() and not seen.all():
            # A dot that is no blob of its own, beside a shadow or in glare, still has a centre.
            step = self._hidden.carry(position - self._position, seen)
            missing = np.flatnonzero(~seen)
            self._measure(missing, (self._position + step)[missing], position, seen, t_s)
        return seen, position

    def _measure(
        self,
        markers: NDArray[np.intp],
        start: FloatArray,
        position: FloatArray,
        seen: NDArray[np.bool_],
        t_s: float,
    ) -> None:
        """Centre ``markers`` near ``start`` (n, 2), and update ``seen`` and ``position``."""
        centres = self._detector.refine(start)
        place, sought = centres.position_px, ~seen[markers]
        good = np.abs(place - start).max(axis=1, initial=0.0) < _MAX_SHIFT_PX
        if sought.any():
            inside = (place >= _WHOLE_PX) & (place <= _FAR_PX - _WHOLE_PX)
            others = np.concatenate([position[seen], place])
            gap = np.sort(_distances(place, others), axis=1)
            good &= inside.all(axis=1) & (gap[:, 1] > _APART_PX)
        stale = t_s - self._last_seen_s[markers] > LOST_AFTER_S
        good[good] = self._looks.recognise(markers[good], centres.looks[good], stale[good])
        seen[markers] = good
        position[markers[good]] = place[good]

    def _reject_strays(self, position: FloatArray, seen: NDArray[np.bool_]) -> float:
        """Mark markers that left their neighbours as unseen; return the rms misfit in px."""
        if not self._was_seen.any():
            return 0.0
        square = np.zeros(MARKERS)
        for _ in range(4):
            both = seen & self._was_seen
            bend = marker_misfit(self._hidden.carry(position - self._position, both))
            square = np.einsum("ij,ij->i", bend, bend)
            worst = int((square * both).argmax())
            if not both[worst] or square[worst] <= STRAY_PX**2:
                break
            seen[worst] = False
        return math.sqrt(float(square.mean()))

    def _settle(self, position: FloatArray, seen: NDArray[np.bool_], t_s: float) -> None:
        self._position = self._hidden.fill(position, seen)
        if not seen.all():
            self._hidden.forget(misordered_markers(self._position) & ~seen)
        self._last_seen_s[seen] = t_s
        self._was_seen = seen

    def _field(self, frame: TactileFrame, quality: float) -> MarkerField:
        state = np.zeros(MARKERS, dtype=np.uint8)
        if not self._was_seen.all():
            gone = frame.t_s - self._last_seen_s > LOST_AFTER_S
            state[~self._was_seen] = MarkerState.INFERRED
            state[~self._was_seen & gone] = MarkerState.LOST
        displacement, residual = np.zeros((MARKERS, 2)), 0.0
        if self.reference is not None and self._locked:
            rest = self.reference.position_px
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
        """Return the field of an unusable frame: the last positions, none seen."""
        self._was_seen = np.zeros(MARKERS, dtype=bool)
        return self._field(frame, 0.0)


def _straight_grid() -> FloatArray:
    """Return (63, 2) nominal positions, used for the order; real gels deviate by some px."""
    u, v = np.linspace(21, 287, GRID_COLS), np.linspace(20, 214, GRID_ROWS)
    return np.stack(np.meshgrid(u, v), axis=-1).reshape(MARKERS, 2)


@dataclass(frozen=True, slots=True)
class GelRest:
    """Gel at rest: ``grid`` in the best of several frames, ``position_px`` (63, 2) the median.

    NaN for dots not seen in every frame with a usable grid. ``motion_px``: rms motion of the others
    between frames.
    """

    grid: GridReport
    position_px: FloatArray
    motion_px: float

    def __post_init__(self) -> None:
        read_only(self.position_px)


def measure_rest(frames: Sequence[TactileFrame]) -> GelRest:
    """Return the rest state of the gel in ``frames`` (one finger, oldest first, at least one)."""
    tracker = MarkerTracker(frames[0].finger)
    grids: list[GridReport] = []
    places = []
    for frame in frames:
        field = tracker.track(frame)
        grids.append(tracker.grid)
        if field.quality > 0.0:
            seen = field.state == MarkerState.SEEN
            places.append(np.where(seen[:, None], field.position_px, np.nan))
    best = max(grids, key=lambda grid: (grid.usable, grid.complete, grid.rows * grid.cols))
    if not places:
        return GelRest(best, np.full((MARKERS, 2), np.nan), 0.0)
    stacked = np.stack(places)
    position_px = np.asarray(np.median(stacked, axis=0))
    whole = np.isfinite(position_px).all(axis=1)
    spread = stacked[:, whole] - stacked[:, whole].mean(axis=0)
    motion_px = float(np.sqrt((spread**2).sum(axis=2).mean())) if whole.any() else 0.0
    return GelRest(best, position_px, motion_px)

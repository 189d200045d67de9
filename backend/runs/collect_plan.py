"""Where the probes of a campaign go: at random as in the paper, on a grid, or into the holes.

Item k of a plan depends on the seed and on k alone (adaptive: on the coverage as well), so that a
campaign goes on after a restart as if it had never ended.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import numpy as np

from backend.core.faults import InputError
from backend.core.flow import FloatArray, read_only
from backend.dataset.coverage import Coverage
from backend.objects.shapes import Outline
from backend.objects.starts import COARSE_SEGMENTS, MIN_OVERLAP_MM2, draw_offset
from backend.objects.surface import overlap_area_mm2

Pattern = Literal["random", "grid", "adaptive"]
PATTERNS: tuple[Pattern, ...] = ("random", "grid", "adaptive")
TRIES = 2000
FINEST_MM, HALVINGS = 0.05, 12
_ITEM = 88


@dataclass(frozen=True, slots=True)
class Target:
    """What is probed: two faces, and the largest displacement wanted along x and y (mm)."""

    face: Outline
    bottom: Outline
    within_mm: float | None = None

    def allows(self, offsets_mm: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Return (n,) which of ``offsets_mm`` (n, 2) overlap enough and lie within the range."""
        area = overlap_area_mm2(self.face, offsets_mm, self.bottom, segments=COARSE_SEGMENTS)
        enough = area >= MIN_OVERLAP_MM2
        if self.within_mm is not None:
            enough &= (np.abs(offsets_mm) <= self.within_mm).all(axis=1)
        return np.asarray(enough)

    @property
    def reach_mm(self) -> float:
        """Largest displacement along x or y that could count."""
        reach = float(max(np.add(self.face.half_extents_mm, self.bottom.half_extents_mm)))
        return reach if self.within_mm is None else min(reach, self.within_mm)


def planned_mm(
    pattern: Pattern, target: Target, seed: int, item: int, count: int, seen: Coverage
) -> tuple[float, float]:
    """Return the displacement of item 0, 1, ... of ``count``; raises ``InputError`` if none fits.

    ``seen``: what has been recorded so far; only the adaptive pattern looks at it.
    """
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence([seed, _ITEM, item])))
    if pattern == "grid":
        return _pair(grid_mm(target, count)[item])
    if pattern == "adaptive":
        return _into_a_hole(rng, target, seen)
    for _ in range(TRIES):
        tried = draw_offset(rng, target.face, target.bottom, 8)
        fitting = tried[target.allows(tried)]
        if len(fitting):
            return _pair(fitting[0])
    raise _nothing_fits(target)


@lru_cache(maxsize=4)
def grid_mm(target: Target, count: int) -> FloatArray:
    """Return (count, 2) places on the widest square lattice that holds so many, there and back."""
    coarse_mm = target.reach_mm / 40
    pitch_mm = coarse_mm * float(np.sqrt(len(_lattice(target, coarse_mm)) / count))
    if not pitch_mm >= FINEST_MM:
        raise _nothing_fits(target)
    fine, wide = 0.5 * pitch_mm, 2.0 * pitch_mm
    for _ in range(HALVINGS):
        middle = 0.5 * (fine + wide)
        if len(_lattice(target, middle)) >= count:
            fine = middle
        else:
            wide = middle
    places = _lattice(target, fine)
    chosen = np.asarray(places[np.linspace(0, len(places) - 1, count).round().astype(int)])
    read_only(chosen)
    return chosen


def _lattice(target: Target, pitch_mm: float) -> FloatArray:
    """Return the lattice points (n, 2) that the target allows, row by row, to and fro."""
    count = int(target.reach_mm / pitch_mm)
    steps = pitch_mm * np.arange(-count, count + 1)
    rows = [
        np.stack([steps[:: 1 if k % 2 == 0 else -1], np.full(len(steps), y)], axis=1)
        for k, y in enumerate(steps)
    ]
    places = np.concatenate(rows)
    return np.asarray(places[target.allows(places)])


def _into_a_hole(rng: np.random.Generator, target: Target, seen: Coverage) -> tuple[float, float]:
    """Draw a place in one of the emptiest bins that can be reached."""
    rows, columns = np.nonzero(seen.possible)
    order = np.lexsort((rng.random(len(rows)), seen.counts[rows, columns]))
    for k in order:
        centre = np.array(seen.centre_mm(int(rows[k]), int(columns[k])))
        tried = centre + seen.bin_mm * (rng.random((16, 2)) - 0.5)
        fitting = tried[target.allows(tried)]
        if len(fitting):
            return _pair(fitting[0])
    raise _nothing_fits(target)


def _pair(place: FloatArray) -> tuple[float, float]:
    return float(place[0]), float(place[1])


def _nothing_fits(target: Target) -> InputError:
    within = "" if target.within_mm is None else f" within {target.within_mm:g} mm"
    return InputError(
        f"Not enough displacements{within} overlap by {MIN_OVERLAP_MM2:g} mm².",
        "piece, bottom, range and count",
        "Choose larger faces, a wider range or fewer probes.",
    )

"""How well the displacements of a pair are covered: counts in square bins around the bottom."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import FloatArray, read_only
from backend.objects.shapes import Outline
from backend.objects.starts import MIN_OVERLAP_MM2
from backend.objects.surface import overlap_area_mm2

BIN_MM = 2.0


@dataclass(frozen=True, slots=True)
class Coverage:
    """Bins of ``bin_mm`` in frame ``O``, one of them centred on it.

    ``counts`` (ny, nx) episodes; ``possible`` (ny, nx): at the centre of the bin the faces overlap
    enough. Bin (i, j) is centred at ``bin_mm * (j - nx // 2, i - ny // 2)``.
    """

    counts: NDArray[np.intp]
    possible: NDArray[np.bool_]
    bin_mm: float = BIN_MM

    def __post_init__(self) -> None:
        read_only(self.counts)
        read_only(self.possible)

    def centre_mm(self, row: int, column: int) -> tuple[float, float]:
        """Return the centre of a bin."""
        rows, columns = self.counts.shape
        return self.bin_mm * (column - columns // 2), self.bin_mm * (row - rows // 2)

    @property
    def holes(self) -> int:
        """Number of possible bins without an episode."""
        return int((self.possible & (self.counts == 0)).sum())

    @property
    def covered(self) -> float:
        """Share of the possible bins that hold an episode."""
        possible = int(self.possible.sum())
        return 1.0 - self.holes / possible if possible else 0.0

    def with_offset(self, offset_mm: tuple[float, float]) -> Coverage:
        """Return the coverage with one more episode (one beyond the bins counts nowhere)."""
        counts = self.counts + bin_counts(np.array([offset_mm]), self.counts.shape, self.bin_mm)
        return Coverage(counts, self.possible, self.bin_mm)


def coverage(
    offsets_mm: FloatArray,
    face: Outline,
    bottom: Outline,
    bin_mm: float = BIN_MM,
    min_overlap_mm2: float = MIN_OVERLAP_MM2,
) -> Coverage:
    """Count ``offsets_mm`` (n, 2) of ``face`` over ``bottom`` per bin."""
    reach = np.add(face.half_extents_mm, bottom.half_extents_mm)
    columns, rows = (2 * np.ceil(reach / bin_mm).astype(int) + 1).tolist()
    x = bin_mm * (np.arange(columns) - columns // 2)
    y = bin_mm * (np.arange(rows) - rows // 2)
    centres = np.stack(np.meshgrid(x, y), axis=-1)
    possible = overlap_area_mm2(face, centres, bottom) >= min_overlap_mm2
    return Coverage(bin_counts(offsets_mm, (rows, columns), bin_mm), possible, bin_mm)


def bin_counts(offsets_mm: FloatArray, shape: tuple[int, ...], bin_mm: float) -> NDArray[np.intp]:
    """Return (ny, nx) how many of ``offsets_mm`` (n, 2) fall into each bin."""
    counts = np.zeros(shape, dtype=np.intp)
    offsets = np.asarray(offsets_mm, dtype=np.float64).reshape(-1, 2)
    offsets = offsets[np.isfinite(offsets).all(axis=1)]
    index = np.rint(offsets[:, ::-1] / bin_mm).astype(np.intp) + np.array(shape) // 2
    inside = ((index >= 0) & (index < shape)).all(axis=1)
    np.add.at(counts, tuple(index[inside].T), 1)
    return counts

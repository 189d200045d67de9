"""The support as one displaced outline: its probability given a belief map and where it pressed.

A bottom is one of a family of outlines somewhere under the map. The paper's map gives each its
likelihood (the sum of the log odds of the cells that it would support, of which only a share counts
because neighbouring cells err together). A flat contact can only push, so each measured centre of
pressure must lie within it. All families here are convex: what lies within the face and the outline
lies within the hull of their overlap.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from math import erf, sqrt

import numpy as np
from numpy.typing import NDArray

from backend.core.flow import BeliefMap, FloatArray
from backend.objects.shapes import Outline
from backend.placement.below import Below
from backend.placement.coverage import CellGrid
from backend.placement.outline_family import family, inset_mm

XY = tuple[float, float]
LEAST_CELLS = 3
"""An outline that the first face would hardly touch is none that was felt."""
STRAY = 0.02
"""Share of presses whose centre of pressure says nothing, whatever the outline."""
NEGLIGIBLE = 1e-9


@dataclass(frozen=True, slots=True)
class OutlineBelief:
    """Weight (k, ny, nx) of each outline of the family centred at each cell; they sum to 1."""

    grid: CellGrid
    weight: FloatArray

    @classmethod
    def given(
        cls, belief: BeliefMap, share: float, pressed: FloatArray | float = 0.0
    ) -> OutlineBelief:
        """Weigh all outlines by ``share`` of the map's log odds and by what presses say of them.

        ``pressed`` (k, ny, nx): sum of ``pressed_within`` over the presses.
        """
        grid = CellGrid.of(belief)
        spectra = _spectra(grid.shape, grid.pitch_mm)
        log_weight = pressed + _correlated(share * belief.log_odds, spectra)
        touched = _correlated(belief.covered.astype(np.float64), spectra) >= LEAST_CELLS
        log_weight[~touched] = -np.inf
        weight = np.exp(log_weight - log_weight.max())
        return cls(grid, weight / weight.sum())

    def support(self) -> FloatArray:
        """Return (ny, nx): probability that each cell supports."""
        rows, columns = self.grid.shape
        wide = _padded(self.grid.shape)
        spectra = _spectra(self.grid.shape, self.grid.pitch_mm)
        there = np.fft.rfft2(self.weight, wide) * spectra
        summed = np.fft.irfft2(there.sum(axis=0), wide)[:rows, :columns]
        return np.asarray(np.clip(summed, 0.0, 1.0), dtype=np.float64)

    def centre_mm(self) -> XY:
        """Return the mean centre of the outlines."""
        mass = self.weight.sum(axis=0)
        rows, columns = np.arange(mass.shape[0]), np.arange(mass.shape[1])
        cell = np.array([mass.sum(axis=0) @ columns, mass.sum(axis=1) @ rows])
        x, y = self.grid.to_mm(cell)
        return float(x), float(y)

    def spread_mm(self) -> float:
        """Return the standard deviation of the centre, that of x and y together, per axis."""
        mass = self.weight.sum(axis=0)
        squared = (_relative(self.grid, self.centre_mm()) ** 2).sum(axis=-1)
        return float(np.sqrt(0.5 * (mass * squared).sum()))

    def margin_mm(self, point: XY, risk: float, below: Below | None = None) -> float:
        """Return the inset of ``point`` that is not reached with probability ``risk``.

        With a tower ``below``: the least one of all interfaces.
        """
        weight = self.weight.ravel()
        kept = np.flatnonzero(weight > NEGLIGIBLE * weight.max())
        inset, weight = _insets(self.grid, point).ravel()[kept], weight[kept]
        if below is not None:
            cells = self.weight[0].size
            lower = below.insets_mm(_relative(self.grid, point)).reshape(-1, cells)
            inset = np.minimum(inset, lower[:, kept % cells]).ravel()
            weight = np.tile(weight, len(lower))
        order = np.argsort(inset)
        sums = np.cumsum(weight[order])
        return float(inset[order[int(np.searchsorted(sums, risk * sums[-1]))]])

    def drawn(self, count: int) -> list[tuple[Outline, XY]]:
        """Return ``count`` outlines with their centres, each as often as it is likely.

        Evenly along the sum of the weights, outline by outline: the same ones every time.
        """
        sums = np.cumsum(self.weight.ravel())
        marks = (np.arange(count) + 0.5) / count * sums[-1]
        found = []
        for place in np.minimum(np.searchsorted(sums, marks), len(sums) - 1):
            k, i, j = np.unravel_index(int(place), self.weight.shape)
            x, y = self.grid.to_mm(np.array([float(j), float(i)]))
            found.append((family()[int(k)], (float(x), float(y))))
        return found

    def likeliest_mm(self) -> FloatArray:
        """Return (n, 2) the corners of the likeliest outline, counter-clockwise."""
        k, i, j = np.unravel_index(int(self.weight.argmax()), self.weight.shape)
        x, y = self.grid.to_mm(np.array([float(j), float(i)]))
        return family()[int(k)].placed((float(x), float(y)), segments=48)


def pressed_within(grid: CellGrid, point: XY, sd_mm: float) -> FloatArray:
    """Return (k, ny, nx) log likelihood of each outline at each cell, given a press at ``point``.

    The centre of pressure lies within the outline; it is known with error ``sd_mm``.
    """
    within = _normal(_insets(grid, point) / sd_mm)
    return np.asarray(np.log(STRAY + (1.0 - STRAY) * within), dtype=np.float64)


def _insets(grid: CellGrid, point: XY) -> FloatArray:
    """Return (k, ny, nx): how far ``point`` lies within each outline at each cell."""
    relative = _relative(grid, point)
    return np.stack([inset_mm(outline, relative) for outline in family()])


def _relative(grid: CellGrid, point: XY) -> FloatArray:
    """Return (ny, nx, 2): ``point`` from the centre of each cell."""
    rows, columns = grid.shape
    centres = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return np.asarray(point) - grid.to_mm(centres.astype(np.float64))


def _correlated(cells: FloatArray, spectra: NDArray[np.complex128]) -> FloatArray:
    """Return (k, ny, nx): sum of ``cells`` (ny, nx) under each outline at each cell."""
    rows, columns = cells.shape
    wide = _padded(cells.shape)
    there = np.fft.rfft2(cells, wide) * spectra
    return np.asarray(np.fft.irfft2(there, wide)[:, :rows, :columns], dtype=np.float64)


def _padded(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return a size at which an outline leaves on one side without entering on the other."""
    return 2 * shape[0], 2 * shape[1]


@lru_cache(maxsize=4)
def _spectra(shape: tuple[int, int], pitch_mm: float) -> NDArray[np.complex128]:
    """Return the transforms of the cells that each outline covers, centred on cell (0, 0).

    All outlines are the same turned by half, so that correlation and convolution agree.
    """
    wide = _padded(shape)
    y = pitch_mm * wide[0] * np.fft.fftfreq(wide[0])
    x = pitch_mm * wide[1] * np.fft.fftfreq(wide[1])
    places = np.stack(np.meshgrid(x, y), axis=-1)
    masks = np.stack([_mask(outline, places) for outline in family()])
    return np.asarray(np.fft.rfft2(masks), dtype=np.complex128)


def _mask(outline: Outline, places: FloatArray) -> FloatArray:
    return np.asarray(outline.contains(places), dtype=np.float64)


def _normal(z: FloatArray) -> FloatArray:
    """Return the distribution function of the standard normal distribution."""
    steps = np.linspace(-8.0, 8.0, 1601)
    return np.asarray(np.interp(z, steps, _NORMAL), dtype=np.float64)


_NORMAL = np.array([0.5 * (1.0 + erf(z / sqrt(2.0))) for z in np.linspace(-8.0, 8.0, 1601)])

"""Thin-plate interpolation of markers that were not seen.

The displacement field of a gel is smooth, so an unseen marker takes the value that bends the field
least: the thin-plate energy on the marker grid (squared second differences along rows, along
columns and mixed) is minimised with the seen markers held fixed. Affine fields are reproduced, so
gradients continue beyond the last seen marker. Where too few markers are seen to fix a gradient,
small first- and zeroth-order terms yield the value of the neighbour, and zero without any marker.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from touchdown.backend.core.values import GRID_COLS, GRID_ROWS, MARKERS, FloatArray

_SLOPE_WEIGHT = 1e-6
_VALUE_WEIGHT = 1e-9
_CHUNK = 8192


def _energy() -> FloatArray:
    """Return the (63, 63) positive definite matrix of the bending energy."""
    total = _VALUE_WEIGHT * np.eye(MARKERS)
    for order_row, order_col, weight in (
        (2, 0, 1.0),
        (0, 2, 1.0),
        (1, 1, 2.0),
        (1, 0, _SLOPE_WEIGHT),
        (0, 1, _SLOPE_WEIGHT),
    ):
        along_rows = np.diff(np.eye(GRID_ROWS), n=order_row, axis=0)
        along_cols = np.diff(np.eye(GRID_COLS), n=order_col, axis=0)
        operator = np.kron(along_rows, along_cols)  # mixed differences on the grid, (m, 63)
        total += weight * operator.T @ operator
    return total


_ENERGY = _energy()
_ENERGY.flags.writeable = False
_MISFIT = _ENERGY / np.diag(_ENERGY)[:, None]
_MISFIT.flags.writeable = False


def fill_unseen_markers(displacement: FloatArray, seen: NDArray[np.bool_]) -> FloatArray:
    """Return ``displacement`` with the unseen markers filled from the seen ones.

    ``displacement``: (n, 63, 2) in any unit (values of unseen markers are ignored, NaN included);
    ``seen``: (n, 63) bool. Seen markers are unchanged. Raises ValueError on other
    shapes. Vectorised over n: frames are grouped by the number of unseen markers.
    """
    if displacement.shape[1:] != (MARKERS, 2) or seen.shape != displacement.shape[:2]:
        raise ValueError(f"fields {displacement.shape} with marks {seen.shape} are not (n, 63, 2)")
    filled = np.where(seen[:, :, None], displacement, 0.0)
    unseen_count = MARKERS - seen.sum(axis=1)
    for count in np.unique(unseen_count[unseen_count > 0]):
        frames = np.flatnonzero(unseen_count == count)
        for start in range(0, len(frames), _CHUNK):
            chunk = frames[start : start + _CHUNK]
            unseen = np.nonzero(~seen[chunk])[1].reshape(len(chunk), count)
            matrix = _ENERGY[unseen[:, :, None], unseen[:, None, :]]
            pull = -_ENERGY[unseen] @ filled[chunk]
            filled[chunk[:, None], unseen] = np.linalg.solve(matrix, pull)
    return filled


def marker_misfit(field: FloatArray) -> FloatArray:
    """Return the deviation of each marker from its interpolation from all others.

    ``field``: (63, 2), complete; the result has the same shape and unit. It is the residual of
    leave-one-out filling, zero for affine fields.
    """
    return np.asarray(_MISFIT @ field, dtype=np.float64)

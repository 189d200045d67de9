from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize

from touchdown.backend.core.marker_interpolation import fill_unseen_markers, marker_misfit

ROW, COL = np.divmod(np.arange(63), 9)


def affine(rng: np.random.Generator) -> np.ndarray:
    a = rng.normal(size=(3, 2))
    return np.stack([np.ones(63), COL, ROW], axis=1) @ a


def test_affine_fields_are_continued_exactly_even_beyond_the_border() -> None:
    rng = np.random.default_rng(1)
    truth = np.stack([affine(rng) for _ in range(200)])
    seen = rng.random((200, 63)) > rng.uniform(0.02, 0.6, (200, 1))
    seen[0, :9] = False
    seen[1, 54:] = False
    broken = np.where(seen[:, :, None], truth, np.nan)
    filled = fill_unseen_markers(broken, seen)
    np.testing.assert_allclose(filled, truth, atol=2e-3)
    assert (filled[seen] == truth[seen]).all()


def test_filling_bends_the_field_least() -> None:
    """Independent truth: direct minimisation of the bending energy written out as differences."""
    rng = np.random.default_rng(2)
    seen = np.ones(63, dtype=bool)
    hidden = np.array([0, 13, 14, 31, 44, 62])
    seen[hidden] = False
    values = np.sin(0.5 * COL) + 0.3 * np.cos(0.8 * ROW) + 0.05 * rng.normal(size=63)

    def energy(guess: np.ndarray) -> float:
        field = values.copy()
        field[hidden] = guess
        grid = field.reshape(7, 9)
        mixed = np.diff(np.diff(grid, axis=0), axis=1)
        bends = [np.diff(grid, 2, axis=0), np.diff(grid, 2, axis=1), np.sqrt(2) * mixed]
        return float(sum((b**2).sum() for b in bends))

    best = minimize(energy, np.zeros(6), method="BFGS", options={"gtol": 1e-9}).x
    filled = fill_unseen_markers(np.stack([values, 2 * values], axis=-1)[None], seen[None])[0]
    np.testing.assert_allclose(filled[hidden, 0], best, atol=1e-4)
    np.testing.assert_allclose(filled[:, 1], 2 * filled[:, 0], atol=1e-9)


def test_too_few_markers_give_the_neighbour_value_and_none_gives_zero() -> None:
    seen = np.zeros((2, 63), dtype=bool)
    seen[0, 30] = True
    field = np.full((2, 63, 2), 4.0)
    filled = fill_unseen_markers(field, seen)
    np.testing.assert_allclose(filled[0], 4.0, rtol=5e-2)
    assert (filled[1] == 0.0).all()


def test_each_frame_is_filled_by_itself() -> None:
    rng = np.random.default_rng(3)
    field = rng.normal(size=(40, 63, 2))
    seen = rng.random((40, 63)) > 0.1
    together = fill_unseen_markers(field, seen)
    alone = np.concatenate(
        [fill_unseen_markers(f[None], s[None]) for f, s in zip(field, seen, strict=True)]
    )
    np.testing.assert_allclose(together, alone, atol=1e-9)


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(ValueError, match="63"):
        fill_unseen_markers(np.zeros((1, 62, 2)), np.ones((1, 62), dtype=bool))


def test_misfit_is_the_error_of_leaving_one_marker_out() -> None:
    rng = np.random.default_rng(4)
    field = rng.normal(size=(63, 2))
    left_out = fill_unseen_markers(np.repeat(field[None], 63, axis=0), ~np.eye(63, dtype=bool))
    expected = field - left_out[np.arange(63), np.arange(63)]
    np.testing.assert_allclose(marker_misfit(field), expected, atol=1e-9)
    np.testing.assert_allclose(marker_misfit(affine(rng)), 0.0, atol=1e-3)

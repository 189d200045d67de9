from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchdown.backend.sensing.detector import Blobs, order_grid
from touchdown.backend.sensing.tracker import assign_remaining, misordered_markers, nearest_dots


def lattice(rows: int, cols: int, pitch: float = 32.0) -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(cols), np.arange(rows)), axis=-1).reshape(-1, 2)
    return 20.0 + pitch * grid


def blobs(dots: np.ndarray, whole: np.ndarray | None = None) -> Blobs:
    whole = np.ones(len(dots), dtype=bool) if whole is None else whole
    return Blobs(dots, whole)


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1))
def test_order_is_geometry_alone(seed: int) -> None:
    rng = np.random.default_rng(seed)
    turn = rng.uniform(-0.08, 0.08)
    bend = 6 * np.sin(lattice(7, 9) / rng.uniform(60, 120) + rng.uniform(0, 6, 2))[:, ::-1]
    turned = lattice(7, 9) @ np.array([[1, turn], [-turn, 1]]) + bend
    shuffle = rng.permutation(63)
    ordered = order_grid(blobs(turned[shuffle]))
    assert ordered.report.complete
    np.testing.assert_array_equal(shuffle[ordered.index], np.arange(63))


def test_decoys_between_the_dots_are_left_over() -> None:
    rng = np.random.default_rng(3)
    dots = lattice(7, 9) + rng.normal(0, 1, (63, 2))
    decoys = lattice(6, 8) + 16.0
    ordered = order_grid(blobs(np.concatenate([decoys, dots])))
    np.testing.assert_array_equal(ordered.index, 48 + np.arange(63))


def test_missing_cells_are_named() -> None:
    dots = np.delete(lattice(7, 9), [0, 9 * 3 + 4], axis=0)
    ordered = order_grid(blobs(dots))
    assert ordered.report.missing == ((0, 0), (3, 4))
    assert ordered.report.usable
    assert not ordered.report.complete
    assert "(0, 0), (3, 4)" in ordered.report.message
    assert (ordered.index == -1).sum() == 2


@pytest.mark.promise("C7")
@pytest.mark.parametrize(
    ("rows", "cols", "words"),
    [(8, 10, "8x10 small-dot"), (6, 9, "6 rows x 9"), (7, 8, "7 rows x 8"), (3, 3, "3 rows x 3")],
)
def test_other_grids_are_named_and_not_used(rows: int, cols: int, words: str) -> None:
    ordered = order_grid(blobs(lattice(rows, cols, 29.0)))
    assert not ordered.report.usable
    assert (ordered.index == -1).all()
    assert words in ordered.report.message


def test_cut_dots_give_the_grid_its_size_but_are_not_whole() -> None:
    dots = lattice(7, 9)
    whole = dots[:, 1] > dots[:, 1].min()
    ordered = order_grid(blobs(dots, whole))
    assert ordered.report.missing == tuple((0, col) for col in range(9))
    assert (ordered.index[:9] == -1).all()


def test_nothing_found_is_no_grid() -> None:
    assert order_grid(blobs(np.zeros((0, 2)))).report.rows == 0


def test_nearest_both_ways_is_one_to_one() -> None:
    rng = np.random.default_rng(5)
    places, dots = rng.uniform(0, 100, (63, 2)), rng.uniform(0, 100, (80, 2))
    owner = nearest_dots(places, dots, 8.0)
    taken = owner[owner >= 0]
    assert len(taken) == len(set(taken))
    for place, dot in zip(places, owner, strict=True):
        if dot >= 0:
            gaps = np.linalg.norm(dots - place, axis=1)
            assert gaps[dot] == gaps.min() <= 8.0
    assert (nearest_dots(places, np.zeros((0, 2)), 8.0) == -1).all()


def test_the_rest_is_shared_out_at_least_total_distance() -> None:
    places = np.array([[0.0, 0.0], [10.0, 0.0], [50.0, 50.0]])
    dots = np.array([[9.0, 0.0], [18.0, 0.0], [90.0, 90.0]])
    none = np.full(3, -1)
    np.testing.assert_array_equal(assign_remaining(none, places, dots, 12.0), [0, 1, -1])
    held = np.array([1, -1, -1])
    np.testing.assert_array_equal(assign_remaining(held, places, dots, 12.0), [1, 0, -1])


def test_exchanged_neighbours_are_out_of_order() -> None:
    dots = lattice(7, 9)
    assert not misordered_markers(dots).any()
    dots[[30, 31]] = dots[[31, 30]]
    assert misordered_markers(dots)[[30, 31]].all()
    assert not misordered_markers(dots)[:18].any()

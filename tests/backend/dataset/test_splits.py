"""Splits: whole series on one side, the requested share, and errors."""

from __future__ import annotations

import numpy as np
import pytest

from touchdown.backend.core.faults import InputError
from touchdown.backend.episodes.training_rows import divided_indices, split_series

SERIES = [(f"m{m}", f"pot/{bottom}") for m in range(6) for bottom in ("short", "long")]
MOUNTING = [m for m, _ in SERIES for _ in range(10)]
PAIR = [pair for _, pair in SERIES for _ in range(10)]


@pytest.mark.parametrize("seed", range(5))
def test_no_pair_of_a_series_is_divided(seed: int) -> None:
    split = split_series(MOUNTING, PAIR, 0.25, seed)
    assert split.kept_together == "series"
    assert sorted([*split.train, *split.held_out]) == list(range(120))
    assert len(split.held_out) == 30
    groups = list(zip(MOUNTING, PAIR, strict=True))
    held_out = {groups[k] for k in split.held_out.tolist()}
    assert not held_out & {groups[k] for k in split.train.tolist()}


def test_many_mountings_are_held_out_whole() -> None:
    mountings = [f"m{k // 4}" for k in range(160)]
    pairs = [("pot/short", "pot/long")[k % 2] for k in range(160)]
    split = split_series(mountings, pairs, 0.1, 1)
    assert split.kept_together == "mounting"
    held_out = {mountings[k] for k in split.held_out.tolist()}
    assert len(held_out) == 4
    assert not held_out & {mountings[k] for k in split.train.tolist()}


@pytest.mark.parametrize(
    ("mountings", "pairs", "named"),
    [
        (["m"] * 8, ["pot on short"] * 8, "one series only of pot on short"),
        (["m", "n"] * 4, ["pot on short", "pot on long"] * 4, "one series only of each pair"),
    ],
)
def test_a_pair_with_one_series_cannot_be_split(
    mountings: list[str], pairs: list[str], named: str
) -> None:
    with pytest.raises(InputError, match=named) as refused:
        split_series(mountings, pairs, 0.25, 0)
    assert "Collect another campaign" in refused.value.fix
    assert "--divide-series" in refused.value.fix


@pytest.mark.parametrize("seed", range(8))
def test_every_pair_keeps_a_series_to_train_on(seed: int) -> None:
    mountings = ["a"] * 5 + ["b"] * 5 + ["c"] * 5 + ["d"] * 5
    pairs = ["pot on short"] * 10 + ["pot on long"] * 5 + ["pot on hex20"] * 5
    split = split_series(mountings, pairs, 0.9, seed)
    assert {pairs[k] for k in split.train.tolist()} == set(pairs)
    assert {pairs[k] for k in split.held_out.tolist()} == {"pot on short"}


def test_a_short_series_is_held_out_rather_than_most_of_the_data() -> None:
    mountings = ["long"] * 98 + ["short"] * 2
    for seed in range(4):
        split = split_series(mountings, ["pot on short"] * 100, 0.1, seed)
        assert split.held_out.tolist() == [98, 99]


def test_the_episodes_of_divided_groups_are_found() -> None:
    sides = ["train", "train", "held_out", "held_out", "train"]
    groups = ["a", "b", "b", "c", "a"]
    np.testing.assert_array_equal(divided_indices(sides, groups), [1, 2])
    assert len(divided_indices(["train"] * 5, groups)) == 0
    assert len(divided_indices([], [])) == 0
